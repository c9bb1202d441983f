//! Identifiers, mission time, constants, three-vectors and keyed random streams.
//!
//! Uses nothing else of the crate.

pub mod constants;
mod ids;
mod interval_set;
mod per_channel;
mod random;
mod time;
pub mod vector;

pub use ids::{ChannelId, MAX_SATELLITES, Pair, PairError, all_pairs};
pub use interval_set::IntervalSet;
pub use per_channel::PerChannel;
pub use random::{StreamKind, random_stream};
pub use time::{MissionTime, TICKS_PER_SECOND};
