//! What a plan costs before it runs: operations, bytes, memory and time, and the channels that fit into memory together.

mod advice;
mod estimate;
mod groups;
mod model_plans;
mod rates;

pub use advice::MemoryAdvice;
pub use estimate::{ChannelCost, Cost, RankCost, Segment};
pub(super) use groups::groups_of;
pub use groups::{GroupSize, MapGroup, RunGroups};
