//! The ground segment: turns the bytes of a downlink into sums. It uses every packet once, in any order, over any number of sessions.
//!
//! [`Ground`] is one stage: the [`Collector`] finds packets and delivers each once, calibration adds positions and
//! corrects visibilities, the accumulator adds them up. An [`archive`] keeps its state from one session to the next.
//!
//! Uses [`crate::downlink`], [`crate::calibration`] and [`crate::imaging`]; does not depend on the spacecraft,
//! on solvers, or on the pipeline.

#[doc(hidden)]
pub mod archive;
mod burst_watch;
mod collector;
mod collector_state;
mod config;
mod core;
mod error;
mod live_view;
mod outcome;
mod pass_gate;
mod pass_line;
mod placed_files;
mod power_waterfall;
mod promises;
mod reception;
mod sessions;
mod sky_hits;
mod uvw_density;

pub use self::core::Ground;
#[doc(hidden)]
pub use crate::downlink::receive::{HeldPacket, HoldBuffer, IsDue};
#[doc(hidden)]
pub use archive::{ARCHIVE_BYTES_MAX, packets_folder};
#[doc(hidden)]
pub use collector::{Collector, CollectorStep, DeliveredPacket, Delivery};
#[doc(hidden)]
pub use collector_state::{CollectorState, CollectorView};
#[doc(hidden)]
pub use config::GroundConfig;
pub use config::WAIT_BYTES;
pub use error::GroundError;
#[doc(hidden)]
pub use live_view::{ArrayGeometry, LiveView};
#[doc(hidden)]
pub use outcome::{GroundOutcome, SavingReport, SharedSaving};
#[doc(hidden)]
pub use pass_gate::{PassGateState, PassObserver};
#[doc(hidden)]
pub use pass_line::{KindLine, MissingRange, PassLine};
#[doc(hidden)]
pub use placed_files::{read_passes, read_placed};
#[doc(hidden)]
pub use power_waterfall::PowerWaterfall;
#[doc(hidden)]
pub use reception::Reception;
#[doc(hidden)]
pub use sessions::{Recalibrated, RefusedPacket, Retracted};
#[doc(hidden)]
pub use sky_hits::{HitsMap, SkyHits};
#[doc(hidden)]
pub use uvw_density::UvwDensity;
