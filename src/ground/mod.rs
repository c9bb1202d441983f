//! The ground, from the bytes of a downlink to sums: every packet once, in any order, over any number of sessions.
//!
//! [`Ground`] is one stage: the [`Collector`] finds packets and delivers each once, calibration places and corrects
//! visibilities, the accumulator adds them up. An [`archive`] keeps all of it from one session to the next.
//!
//! Uses [`crate::downlink`], [`crate::calibration`] and [`crate::imaging`]; knows nothing of the spacecraft, of
//! solving, or of the pipeline.

pub mod archive;
mod collector;
mod config;
mod core;
mod error;
mod hold_buffer;
mod lookout;
mod outcome;
mod pass_gate;
mod pass_line;
mod power_waterfall;
mod promises;
mod reception;
mod sky_hits;
mod uvw_density;

pub use self::core::Ground;
pub use collector::{Collector, CollectorState, CollectorStep, CollectorView, DeliveredPacket, Delivery};
pub use config::{GroundConfig, WAIT_BYTES};
pub use error::GroundError;
pub use hold_buffer::{Due, HeldPacket, HoldBuffer};
pub use lookout::{ArrayNow, Lookout};
pub use outcome::{GroundOutcome, SavingReport, SharedSaving};
pub use pass_gate::{PassGateState, PassObserver};
pub use pass_line::{KindLine, MissingRange, PassLine};
pub use power_waterfall::PowerWaterfall;
pub use reception::Reception;
pub use sky_hits::{HitsMap, SkyHits};
pub use uvw_density::UvwDensity;
