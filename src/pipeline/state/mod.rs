//! What the ground knows, kept from one session to the next.
//!
//! One stage, the [`Keeper`], goes from bytes to sums and owns all that a later session needs: so a checkpoint, written
//! between two packets, is of one moment without a word between stages. It holds the sums of all channels, the set of
//! packets that are in them, the packets that wait for others sent before them, the instrument, the ephemeris, the
//! ledger's and the reception's counts, and a line on every block of visibilities.
//!
//! # Order
//! Every packet is applied once, in the order of sending as long as it comes before others of `wait_bytes` that
//! were sent later. Within that reach, doubles and disorder leave no trace: what a session leaves is the same, bit
//! for bit, as if all had come in order and once. A packet that comes later still is applied when it comes: the sums
//! are exact and do not tell. Visibilities whose ephemeris comes
//! later than that are flagged, as without a state.
//!
//! States that are merged add up to the same sums in any order. Of two, packets that one has decoded and
//! that still wait in the other are taken once; visibilities that both have summed are refused.
//!
//! # A checkpoint
//! Magic `LNRSTA01`; length of the head (u64 LE); head (bincode); the channels' engines as they write
//! themselves; CRC-64/NVME of all that (u64 LE). It is written under another name, put on the disk and renamed; the
//! one before is kept, and used, with a message, if the newest does not hold.

mod error;
mod file;
mod folder;
mod gaps;
mod journal;
mod keeper;
mod survey;

pub use error::StateError;
pub use gaps::{ChannelCoverage, GapReport, Gaps, LostStream, find_gaps};
pub use journal::JournalEntry;
pub use keeper::Keeper;
pub use survey::Survey;
