//! Quanta of the gridded sums, and the sums of one node as integers.

use super::grid::Grids;
use super::tori::NodeSums;
use crate::imaging::exact::fixed_point::rows::IntegerRow;
use crate::imaging::exact::fixed_point::{Direction, WeightScale};

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
    /// Pairs of right-hand sides of draws of the errors by gains, each as `right`.
    pub(super) gain_errors: Vec<Vec<IntegerRow>>,
}

/// Right-hand sides as floating-point numbers, (K sr)^-1.
pub(super) fn right_values(rows: &[IntegerRow], grids: &Grids, quanta: Quanta) -> Vec<f32> {
    let (layout, mut right) = (grids.data_row(), vec![0.0; grids.right_len()]);
    let held = (0..).zip(rows).filter(|(alpha, _)| grids.holds(*alpha)).map(|(_, row)| row);
    for (row, out) in held.zip(right.chunks_exact_mut(layout.len())) {
        row.write_values(layout, quanta.right, out);
    }
    right
}

impl ExactNode {
    pub(super) fn zeros(grids: &Grids) -> Self {
        Self {
            weights: vec![IntegerRow::default(); grids.points],
            right: vec![IntegerRow::default(); grids.data_points()],
            gain_errors: Vec::new(),
        }
    }

    /// All rows, with the layout of each kind.
    fn rows(&self) -> impl Iterator<Item = &IntegerRow> {
        self.weights.iter().chain(&self.right).chain(self.gain_errors.iter().flatten())
    }

    /// Number of pairs of draws with sums.
    pub(super) fn error_pairs(&self) -> usize {
        let has_sums = |pair: &Vec<IntegerRow>| !pair.iter().all(IntegerRow::is_empty);
        self.gain_errors.iter().rposition(has_sums).map_or(0, |last| last + 1)
    }

    /// Adds other sums or removes them, depending on the direction.
    pub(super) fn combine(&mut self, grids: &Grids, other: &Self, direction: Direction) {
        let pairs = self.gain_errors.len().max(other.gain_errors.len());
        self.gain_errors.resize_with(pairs, || vec![IntegerRow::default(); grids.data_points()]);
        let ours =
            self.weights.iter_mut().chain(&mut self.right).chain(self.gain_errors.iter_mut().flatten());
        ours.zip(other.rows()).for_each(|(row, other)| row.combine(other, direction));
    }

    /// Whether both have sums of an alpha.
    pub(super) fn overlaps(&self, other: &Self) -> bool {
        self.rows().zip(other.rows()).any(|(row, other)| !row.is_empty() && !other.is_empty())
    }

    pub(super) fn values(&self, grids: &Grids, quanta: Quanta) -> NodeSums {
        let (layout, mut weights) = (grids.weight_row(), vec![0.0; grids.weights_len()]);
        let held = (0..).zip(&self.weights).filter(|(alpha, _)| grids.holds(*alpha)).map(|(_, row)| row);
        for (row, out) in held.zip(weights.chunks_exact_mut(layout.len())) {
            row.write_values(layout, quanta.weight, out);
        }
        NodeSums { weights, right: right_values(&self.right, grids, quanta) }
    }

    /// Whether all sums are zero, because nothing was added or everything was removed.
    pub(super) fn is_empty(&self) -> bool {
        self.rows().all(IntegerRow::is_empty)
    }
}
