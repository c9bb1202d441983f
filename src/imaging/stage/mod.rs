//! The stages of the pipeline that make maps: one that keeps the sums of each channel, one that solves them.

mod accumulate;
mod solve;

pub use accumulate::{Accumulator, AccumulatorState, Snapshot, SnapshotSums};
pub use solve::{Solution, Solver, SolverSetup};
