//! Normal equations over pixels, ready to be solved.

use super::tiles::SymmetricTiles;
use crate::imaging::{Accuracy, NormalSums, SumCounts};

/// Terms are rounded to 2^-42 of the maximum weight, which is a thousand times an expected weight: to 1e-9 of that, at random in at least some
/// hundred terms.
const ACCURACY: Accuracy = Accuracy { relative: 1e-8, absolute: 1e-11 };

/// Normal equations over pixels.
#[derive(Clone, Debug, PartialEq)]
pub struct PixelSums {
    /// HEALPix nside.
    pub nside: usize,
    /// The matrix BtN^-1B, K^-2.
    pub normal: SymmetricTiles,
    /// The right-hand side BtN^-1V, K^-1.
    pub right: Vec<f64>,
    /// The right-hand side of the noise-only map, BtN^-1n, K^-1.
    pub noise: Vec<f64>,
    /// Number, weight and power of the visibilities.
    pub counts: SumCounts,
}

impl NormalSums for PixelSums {
    fn unknowns(&self) -> usize {
        self.right.len()
    }

    fn apply(&self, x: &[f64], y: &mut [f64]) {
        self.normal.multiply(x, y);
    }

    fn right_hand_side(&self) -> &[f64] {
        &self.right
    }

    fn noise_right_hand_side(&self) -> &[f64] {
        &self.noise
    }

    fn counts(&self) -> SumCounts {
        self.counts
    }

    fn accuracy(&self) -> Accuracy {
        ACCURACY
    }
}
