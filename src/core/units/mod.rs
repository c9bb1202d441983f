//! Identifiers, mission time, constants, three-vectors, keyed random streams, ledger reasons, checks of configuration
//! values, and arithmetic for vectorised loops.
//!
//! Uses no other module of the crate.

pub(crate) mod arithmetic;
#[doc(hidden)]
pub mod calendar;
mod checks;
pub mod constants;
mod echo;
mod ids;
mod interval_set;
mod keys;
mod per_channel;
mod quantity;
mod random;
mod reason;
mod text;
mod time;
#[doc(hidden)]
pub mod time_scales;
pub mod vector;

#[doc(hidden)]
pub use checks::{Checks, InvalidValue};
#[doc(hidden)]
pub use echo::{echo, shortened};
pub use ids::{ChannelId, Pair, all_pairs};
#[doc(hidden)]
pub use ids::{MAX_SATELLITES, PairError};
#[doc(hidden)]
pub use interval_set::IntervalSet;
#[doc(hidden)]
pub use keys::{Key, Level, keys};
#[doc(hidden)]
pub use per_channel::PerChannel;
#[doc(hidden)]
pub use quantity::{Dimension, bytes_text, frequency_folder};
#[doc(hidden)]
pub use random::{StreamKind, random_stream};
#[doc(hidden)]
pub use reason::Reason;
#[doc(hidden)]
pub use text::printable;
pub use time::MissionTime;
#[doc(hidden)]
pub use time::TICKS_PER_SECOND;
