//! The daughters: sampling of up to 30 channels, level control, quantisers, clocks, and the link to the mother.
//!
//! A channel of complex samples at its own width (8 kHz) is drawn for all daughters at once, with the
//! covariance that a [`crate::response::model::VisibilityModel`] gives over the channel as the array moves, and noise
//! of the receivers: [`Covariances`], [`Synthesis`]. Each daughter then does to its samples what it does
//! wrong ([`Disturbances`]), sets its level and quantises ([`Quantiser`]), and sends blocks over its link
//! ([`SampleLink`]). All of it is noise with a seed: [`Sampler`] gives the same samples whatever the threads.

mod colour;
mod config;
mod covariance;
mod disturbances;
mod epochs;
mod link;
mod nodes;
mod normal;
mod quantiser;
mod repair;
mod sampler;
mod synthesis;

pub use config::{DaughtersConfig, Disturbances, DropPolicy, FLOAT_BITS};
pub use covariance::{Covariances, Epochs, Request, Tables};
pub use link::{LinkCounts, SampleLink};
pub use quantiser::Quantiser;
pub use repair::Repairs;
pub(crate) use sampler::sample_ticks;
pub use sampler::{Sampler, SamplerCounts, Scene};
pub use synthesis::{BINS, Draft, DrawKey, HOP, Planes, Response, Synthesis};
