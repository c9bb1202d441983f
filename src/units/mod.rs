//! Identifiers, mission time, constants, three-vectors, keyed random streams, ledger reasons, checks of configuration
//! values, and arithmetic for vectorised loops.
//!
//! Uses nothing else of the crate.

pub(crate) mod arithmetic;
pub mod calendar;
mod checks;
pub mod constants;
mod echo;
mod ids;
mod interval_set;
mod per_channel;
mod quantity;
mod random;
mod reason;
mod text;
mod time;
pub mod time_scales;
pub mod vector;

pub use checks::{Checks, InvalidValue};
pub use echo::{echo, shortened};
pub use ids::{ChannelId, MAX_SATELLITES, Pair, PairError, all_pairs};
pub use interval_set::IntervalSet;
pub use per_channel::PerChannel;
pub use quantity::Dimension;
pub use random::{StreamKind, random_stream};
pub use reason::Reason;
pub use text::printable;
pub use time::{MissionTime, TICKS_PER_SECOND};
