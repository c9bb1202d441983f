//! Identifiers, mission time, constants, three-vectors, keyed random streams, and arithmetic for vectorised loops.
//!
//! Uses nothing else of the crate.

pub(crate) mod arithmetic;
pub mod constants;
mod ids;
mod per_channel;
mod random;
mod time;
pub mod vector;

pub use ids::{ChannelId, MAX_SATELLITES, Pair, PairError, all_pairs};
pub use per_channel::PerChannel;
pub use random::{StreamKind, random_stream};
pub use time::{MissionTime, TICKS_PER_SECOND};
