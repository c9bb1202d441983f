//! Sums as integers: the scale of their quanta, how terms are rounded, and rows that hold them.
//!
//! Each term is rounded once, by a rule that looks at its own visibility alone, to a multiple of a quantum that was
//! fixed before any data arrived. Integers add up to the same bits in any order, batch, number of threads or tree of
//! merges, and what was added can be removed without a trace.

pub(in crate::imaging) mod parts;
pub(in crate::imaging) mod rounding;
pub(in crate::imaging) mod rows;
pub(in crate::imaging) mod scale;

pub use scale::{Direction, Totals, WeightScale, automatic_weight_max};
