//! Sample-level simulation of the daughters, up to their link to the mother.
//!
//! [`Sampler`] is the source. For each channel it draws complex Gaussian samples of all daughters at once, at the
//! channel's own width (8 kHz). Their covariance is that of a [`crate::response::model::VisibilityModel`] as the
//! array moves, plus receiver noise (`covariance`, `synthesis`). Each daughter then applies its instrumental errors
//! ([`InstrumentErrors`], for both fidelities), [`Tones`], level control and quantiser. [`SampleLink`] carries the
//! blocks to the mother at a limited rate.
//!
//! Samples depend on the seed alone, not on the number of threads or the size of queues.

mod bins;
mod colour;
mod config;
mod covariance;
mod disturbances;
mod epochs;
mod errors;
mod link;
mod nodes;
mod normal;
mod quantiser;
mod repair;
mod sampler;
mod synthesis;
mod tile;

pub use config::{DaughtersConfig, DropPolicy, FLOAT_BITS, Tones};
pub use errors::{
    AntennaErrors, BeaconSchedule, ChannelAntennas, ErrorTerms, InstrumentConfig, InstrumentErrors,
    NavigationConfig, OrbitAntennas, PassErrors, truth_csv,
};
pub use link::{LinkCounts, SampleLink};
pub use repair::Repairs;
pub(crate) use sampler::sample_ticks;
pub use sampler::{Sampler, SamplerCounts, Scene};
