//! Sums as integers: the scale of their quanta, the rounding of terms, and rows of integers.
//!
//! Each term is rounded once, by a rule that depends only on its own visibility, to a multiple of a quantum that was
//! fixed before any data arrived. Sums of integers have the same bits for any order, batches, threads and merges, and
//! removal is the exact inverse of addition.

pub(in crate::imaging) mod parts;
pub(in crate::imaging) mod rounding;
pub(in crate::imaging) mod rows;
pub(in crate::imaging) mod scale;

pub use scale::{Direction, Totals, WeightScale, automatic_weight_max};
