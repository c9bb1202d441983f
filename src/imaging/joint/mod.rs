//! Maps of several channels at once: scales that one frequency does not see come from its neighbours.
//!
//! The sky's structure changes slowly with frequency. [`solve_jointly`] takes the sums of each channel as they are, estimates how alike the
//! channels are ([`Likeness`]) with the map, and solves for all of them together: maps at every channel and at frequencies between, the
//! spectral index of every pixel, each with errors. No visibility is read again.

mod amplitude;
mod prior;
mod solve;
mod spectrum;
mod sums;
#[cfg(test)]
mod tests;

pub use amplitude::RelativeAmplitude;
pub use prior::Likeness;
pub use solve::{Agreement, JointChannel, JointMap, JointRequest, JointSolution, solve_jointly};
pub use spectrum::SpectralMaps;
