//! The two pipeline stages that make maps: one accumulates the sums of each channel, the other solves them.

mod accumulate;
mod snapshot;
mod solve;

pub use accumulate::{Accumulator, AccumulatorState};
pub use snapshot::Snapshot;
pub use solve::{Solution, Solver};
