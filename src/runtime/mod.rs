//! Stages on named threads over bounded channels, with one supervisor; knows no physics.
//!
//! A [`Graph`] is built of one or more chains source -> stages -> sink. Every link is a bounded
//! channel that keeps order, so a fast source waits for a slow sink, and what is in flight is at most
//! the sum of the capacities and a few items a stage. The runner owns receiving, timing, thread
//! names and panics; a [`Stage`] holds nothing but its own work and is tested alone with
//! [`Outlet::collect`].
//!
//! How a run ends:
//! - The source is done, or [`Cancel`] stops it: every stage works off its queue, every `finish`
//!   runs, and the run returns a [`Report`].
//! - A stage fails or panics: the first error is kept with the stage's name and place, everybody is
//!   woken and stops without `finish`, and whoever does not end by the deadline is named in the error.
//!
//! [`Ledger`] is the account that a run closes with.

mod cancel;
mod config;
mod error;
mod graph;
mod ledger;
mod metrics;
mod outlet;
mod report;
mod stage;
mod supervisor;
mod timing;
mod worker;

#[cfg(test)]
mod tests;

pub use cancel::Cancel;
pub use config::RuntimeConfig;
pub use error::{BoxError, Laggards, Moment, RuntimeError};
pub use graph::{Graph, Link};
pub use ledger::{Ledger, LedgerImbalance, LedgerReport};
pub use metrics::{Metrics, StageProgress};
pub use outlet::Outlet;
pub use report::{QueueReport, Report, StageReport};
pub use stage::{Flow, Sink, Source, Stage, Units};
pub use timing::Summary;
