//! How well a map fits the data that it is made from: what the choice of epsilon is made by.
//!
//! The residual follows from sums alone,
//!
//! ```text
//! |V - B T|^2 = V'N^-1V - 2 T'b + T'A T,   A = BtN^-1B,  b = BtN^-1V
//! ```
//!
//! as a difference of numbers that are as many times larger as the data are brighter than their noise. What the accuracy of A
//! leaves open of it is stated beside it.

use super::traces::Estimate;
use super::vectors::dot;
use crate::imaging::{Accuracy, SumCounts};

/// A map against its data.
#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize, bincode::Encode, bincode::Decode)]
pub struct Fit {
    /// Real numbers in the data: two a visibility.
    pub numbers: u64,
    /// `V'N^-1V`, the square of the data in units of their noise.
    pub data_power: f64,
    /// `|V - B T|^2`, the square of what the map leaves of them, likewise. The error is what the accuracy of BtN^-1B leaves open.
    pub residual: Estimate,
    /// `|T - T_p|^2` over the pixels, K^2.
    pub solution_k2: f64,
}

/// What is multiplied to tell the fit of a map.
pub(in crate::imaging) struct FitInputs<'a> {
    pub(in crate::imaging) counts: SumCounts,
    pub(in crate::imaging) accuracy: Accuracy,
    /// Largest eigenvalue of `BtN^-1B`.
    pub(in crate::imaging) w_max: f64,
    /// `BtN^-1V`, without a prior.
    pub(in crate::imaging) right: &'a [f64],
    /// Unknowns of the whole map, T.
    pub(in crate::imaging) whole: &'a [f64],
    /// `BtN^-1B` times them.
    pub(in crate::imaging) product: &'a [f64],
    /// Unknowns without the prior, T - T_p.
    pub(in crate::imaging) solved: &'a [f64],
}

impl FitInputs<'_> {
    /// Of a map whose unknowns have the area `per_area_sr` that those of a map of pixels are without.
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
