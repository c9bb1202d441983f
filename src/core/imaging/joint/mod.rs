//! Joint maps of several channels, in which neighbouring frequencies fill in modes that one frequency does not measure.
//!
//! The structure of the sky changes slowly with frequency. [`solve_jointly`] takes the sums of each channel, estimates the correlation
//! between channels by degree ([`Correlation`]), and solves for all channels together. It returns maps at every channel and at frequencies between
//! them, and the spectral index of every pixel, each with errors. Total powers of the daughters, if there are any, take part as rows beside the
//! visibilities (`powers`). No visibility is read again.

mod config;
mod correlation;
mod disc;
mod evidence;
mod posterior;
mod powers;
mod prior;
mod solve;
mod spectrum;
mod sums;
#[cfg(test)]
mod tests;

pub use config::{JointConfig, PRIOR_PERCENT_MAX, SAMPLES_MAX};
pub use correlation::Correlation;
pub use posterior::{Agreement, JointMap, JointRequest};
pub use powers::{PowerAgreement, PowerPriors, PowerSample};
pub use solve::{JointChannel, JointSolution, solve_jointly};
pub use spectrum::SpectralMaps;
