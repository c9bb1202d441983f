//! Estimated cost of a plan before it runs: operations, bytes, memory and time; groups of channels that fit into memory.

mod advice;
mod baselines;
mod estimate;
mod groups;
mod model_plans;
mod rates;

pub use advice::MemoryAdvice;
pub use estimate::{ChannelCost, Cost, RankCost, Segment};
pub(super) use groups::map_groups;
pub use groups::{GroupSize, MapGroup, RunGroups};
