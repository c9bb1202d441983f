//! Sums of visibilities as integers, which depend only on the visibilities in them, and their checkpoints.

pub(super) mod checkpoint;
mod deferred;
pub(super) mod engine;
pub(super) mod fixed_point;
pub(super) mod noise;

pub use engine::ExactEngine;
pub use fixed_point::automatic_weight_max;
