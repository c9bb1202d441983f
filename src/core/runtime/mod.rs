//! Runs stages on named threads, connected by bounded channels, under one supervisor. Uses [`crate::units`].
//!
//! A [`Graph`] consists of chains source -> stages -> sink. Every link is a bounded channel that keeps the order of its
//! items. So a fast source waits for a slow sink, and the items in flight are at most the sum of the capacities plus a few
//! for each stage. The runtime does receiving, timing and thread names, and catches panics. A [`Stage`] can be tested
//! alone with [`Outlet::collect`].
//!
//! A run ends in one of two ways:
//! - The source is done, or [`Cancel`] stops it. Every stage drains its queue, every `finish` runs, and the run returns a
//!   [`Report`]. A cancelled run may have a time limit, [`Graph::cut_after`].
//! - A stage fails or panics. The supervisor keeps the first error with the name and position of the stage, and wakes all
//!   other stages, which stop without `finish`. The error names the stages that have not ended by the deadline.
//!
//! A [`Ledger`] counts samples that were accumulated, flagged or lost; it must balance at the end of a run.

mod cancel;
mod config;
mod error;
mod graph;
mod ledger;
mod live_timing;
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
#[doc(hidden)]
pub use config::RuntimeConfig;
pub use error::RuntimeError;
#[doc(hidden)]
pub use error::{BoxError, Moment, UnfinishedStages};
pub use graph::{Graph, Link};
#[doc(hidden)]
pub use ledger::LedgerImbalance;
pub use ledger::{Ledger, LedgerReport};
#[doc(hidden)]
pub use live_timing::DurationCounts;
#[doc(hidden)]
pub use metrics::StageProgress;
pub use metrics::{Metrics, Units};
pub use outlet::Outlet;
#[doc(hidden)]
pub use report::QueueReport;
pub use report::{Report, StageReport};
pub use stage::{Flow, Sink, Source, Stage};
#[doc(hidden)]
pub use timing::TimingSummary;
