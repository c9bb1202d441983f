//! Quanta of the gridded sums, and the sums of one node as integers.

use super::grid::Grids;
use super::tori::NodeSums;
use crate::imaging::exact::fixed_point::WeightScale;
use crate::imaging::exact::fixed_point::rows::IntegerRow;

/// Quanta of the maximum weight; expected weights are 2^-10 of it and keep 20 bits.
const WEIGHT_QUANTA: f64 = 1_073_741_824.0; // 2^30
/// Quanta of a right-hand side of the maximum weight at a signal-to-noise ratio of one.
const RIGHT_QUANTA: f64 = 16_777_216.0; // 2^24

/// Rounds a term to a whole number when it is added; even, so that a term and its negative are rounded alike.
pub(super) const BIAS: f32 = 12_582_912.0; // 1.5 2^23
/// Maximum term, in its own quanta.
pub(super) const TERM_MAX: f64 = 2_097_152.0; // 2^21

/// The sum of the biases of `terms` rounded terms.
#[inline(always)]
pub(super) fn biases(terms: usize) -> i32 {
    (BIAS.to_bits() as i32).wrapping_mul(terms as i32)
}

/// Quanta of weights and of right-hand sides.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Quanta {
    /// Quantum of weights, (K sr)^-2.
    pub(super) weight: f64,
    /// Quantum of right-hand sides, (K sr)^-1.
    pub(super) right: f64,
}

impl Quanta {
    pub(super) fn new(scale: WeightScale) -> Self {
        Self { weight: scale.weight / WEIGHT_QUANTA, right: scale.root / RIGHT_QUANTA }
    }
}

/// The integer sums at one node.
#[derive(Clone, Debug)]
pub(super) struct ExactNode {
    /// Weights by alpha: `[diagonal][gamma]`.
    pub(super) weights: Vec<IntegerRow>,
    /// Right-hand sides by alpha: `[data re, data im, noise re, noise im][gamma]`.
    pub(super) right: Vec<IntegerRow>,
}

impl ExactNode {
    pub(super) fn zeros(grids: &Grids) -> Self {
        Self {
            weights: vec![IntegerRow::default(); grids.points],
            right: vec![IntegerRow::default(); grids.data_points()],
        }
    }

    pub(super) fn values(&self, grids: &Grids, quanta: Quanta) -> NodeSums {
        let mut node = NodeSums::zeros(grids);
        let parts = [
            (&self.weights, &mut node.weights, grids.weight_row(), quanta.weight),
            (&self.right, &mut node.right, grids.data_row(), quanta.right),
        ];
        for (rows, out, layout, quantum) in parts {
            let held = (0..).zip(rows).filter(|(alpha, _)| grids.holds(*alpha)).map(|(_, row)| row);
            for (row, out) in held.zip(out.chunks_exact_mut(layout.len())) {
                row.write_values(layout, quantum, out);
            }
        }
        node
    }

    /// Whether all sums are zero, because nothing was added or everything was removed.
    pub(super) fn is_empty(&self) -> bool {
        self.weights.iter().chain(&self.right).all(IntegerRow::is_empty)
    }
}
