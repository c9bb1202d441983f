//! What the ground knows, kept from one session to the next.
//!
//! One stage, the [`Keeper`], goes from bytes to sums and owns all that a later session needs: so a checkpoint, written
//! between two packets, is of one moment without a word between stages. It holds the sums of all channels, the set of
//! packets that have come, those of them that wait, the instrument, the ephemeris, the ledger's and the reception's
//! counts, and the journal: a line on every packet that has been read.
//!
//! # Order
//! Every packet is applied once. The description of the instrument comes first; until it has come, everything waits.
//! Positions and the spacecraft's own counts are read as soon as they are there. A packet of visibilities goes into the
//! sums at once if all visibilities that were sent before it are there, and positions over its whole time are known.
//! Otherwise it waits, and those behind it: so gaps alone make packets wait, until what is missing comes, or until more
//! than `wait_bytes` wait. Then the first goes on as it is, with those behind it up to the next gap; visibilities
//! without positions are then flagged, for good.
//!
//! Within that reach, doubles and disorder leave no trace: sums, journal and accounts are a function of the set of
//! packets that have come, bit for bit, not of their order. A packet that comes later still is applied when it
//! comes: the sums are exact and do not tell, the journal's order does. After a restart of the spacecraft's counts, the
//! packets after it do not wait for those before it.
//!
//! The maps at the end of a session hold what waits as well; the checkpoint keeps it waiting.
//!
//! # Merging
//! Packets that one state has read and that still wait in the other are taken once; visibilities that both have summed
//! are refused. Gaps that another state fills make packets wait no longer. The sums are the same in whichever order
//! states are named.
//!
//! # Taking out again
//! [`Keeper::retract`] takes packets out of the sums, the set of packets that have come, the journal and all accounts,
//! as if they had never come: in the ledger they are lost on the way down until they come again. The journal has the
//! check of every packet and a digest of what it brought into the sums; a packet that differs from the one that was
//! read, or whose positions have changed since, stays, and is told. Positions by which other visibilities were placed
//! stay as well, and parts of payloads. A block that was flagged as a double of one that is taken out stays flagged. The
//! sums forget an addition to the bit. Both checkpoints of the folder are
//! written anew, so that a damaged one does not bring the packets back.
//!
//! # Size
//! The journal takes some 80 bytes a packet of visibilities in a checkpoint and 250 in memory: of 26 million, in packets
//! of 215 as windows give them, 10 MB and 30 MB a channel, of 550 MB that came down. Waiting packets take up to
//! `wait_bytes` in either. The set of packets that have come grows with the number of gaps alone; positions of
//! 8192 windows, more than two years, take 72 MB.
//!
//! # A checkpoint
//! Magic `LNRSTA03`; length of the head (u64 LE); head (bincode); the channels' engines as they write
//! themselves; CRC-64/NVME of all that (u64 LE). It is written under another name, put on the disk and renamed; the
//! one before is kept, and used, with a message, if the newest does not hold.

mod error;
mod file;
mod folder;
mod gaps;
mod journal;
mod keeper;
mod retract;
mod settings;
mod survey;

pub use error::StateError;
pub use gaps::{ChannelCoverage, GapReport, Gaps, LostStream, find_gaps};
pub use journal::JournalEntry;
pub use keeper::{Keeper, WAIT_BYTES};
pub use retract::{Refused, Retracted};
pub use survey::Survey;
