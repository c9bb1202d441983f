//! The fit of a map to its data, from which epsilon is chosen.
//!
//! The residual follows from the sums,
//!
//! ```text
//! |V - B T|^2 = V'N^-1V - 2 T'b + T'A T,   A = BtN^-1B,  b = BtN^-1V
//! ```
//!
//! as a difference of numbers that exceed it by the square of the signal-to-noise ratio. Its error from the accuracy of A is stated with it.

use super::traces::Estimate;
use super::vectors::dot;
use crate::imaging::{Accuracy, SumCounts};

/// The fit of a map to its data.
#[derive(
    Clone, Copy, Debug, PartialEq, serde::Serialize, serde::Deserialize, bincode::Encode, bincode::Decode,
)]
pub struct Fit {
    /// Number of real data: two per visibility.
    pub numbers: u64,
    /// `V'N^-1V`, the square of the data in units of their noise.
    pub data_power: f64,
    /// `|V - B T|^2`, the squared residual in units of the noise, with its error from the accuracy of BtN^-1B.
    pub residual: Estimate,
    /// `|T - T_p|^2` summed over pixels, K^2.
    pub solution_k2: f64,
}

/// The vectors from which the fit of a map is computed.
pub(in crate::imaging) struct FitInputs<'a> {
    pub(in crate::imaging) counts: SumCounts,
    pub(in crate::imaging) accuracy: Accuracy,
    /// Largest eigenvalue of `BtN^-1B`.
    pub(in crate::imaging) w_max: f64,
    /// `BtN^-1V`, without a prior.
    pub(in crate::imaging) right: &'a [f64],
    /// Unknowns of the map with the prior, T.
    pub(in crate::imaging) whole: &'a [f64],
    /// `BtN^-1B` times `whole`.
    pub(in crate::imaging) product: &'a [f64],
    /// Unknowns without the prior, T - T_p.
    pub(in crate::imaging) solved: &'a [f64],
}

impl FitInputs<'_> {
    /// Computes the fit. `per_area_sr` converts unknowns to pixel units: a pixel's area for harmonics, 1 for pixels.
    pub(in crate::imaging) fn fit(self, per_area_sr: f64) -> Fit {
        let Self { counts, accuracy, w_max, right, whole, product, solved } = self;
        let Accuracy { relative, absolute } = accuracy;
        let square = dot(whole, product);
        Fit {
            numbers: 2 * counts.visibilities,
            data_power: counts.power,
            residual: Estimate {
                value: counts.power - 2.0 * dot(whole, right) + square,
                error: relative * square.abs() + absolute * w_max * dot(whole, whole),
            },
            solution_k2: dot(solved, solved) / per_area_sr,
        }
    }
}
