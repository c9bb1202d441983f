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
//! sums as soon as positions over its whole time are known; gaps make nothing wait. Until then it waits, or until more
//! than `wait_bytes` do: then those that were sent first go on, and are flagged for want of positions, for good.
//!
//! Unless that happens, doubles and disorder leave no trace, however late: sums, journal and accounts are a function
//! of the set of packets that have come, bit for bit, not of their order. The sums are exact, and snapshots on the way
//! are no part of a state. What the spacecraft has sent twice under different counts is not covered: of such
//! blocks the one that comes first is used.
//!
//! The maps at the end of a session hold what waits as well; the checkpoint keeps it waiting.
//!
//! # Merging
//! Packets that one state has read and that still wait in the other are taken once; visibilities that both have summed
//! are refused. Packets whose positions another state knows wait no longer. The sums are the same in whichever order
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
//! `wait_bytes` in either. The set of packets that have come grows with the number of times at which they were made; positions of
//! 8192 windows, more than two years, take 72 MB.
//!
//! # A checkpoint
//! Magic `LNRSTA04`; length of the head (u64 LE); head (bincode); the channels' engines as they write
//! themselves; CRC-64/NVME of all that (u64 LE). It is written under another name, put on the disk and renamed; the
//! one before is kept, and used, with a message, if the newest does not hold.

mod checkpoint;
mod error;
mod folder;
mod gaps;
mod journal;
mod keeper;
mod packet_order;
mod retract;
mod settings;
mod survey;

pub use error::StateError;
pub use gaps::{
    ChannelCoverage, GapReport, Gaps, LostStream, Positions, Reading, Received, RestartReport, find_gaps,
};
pub use journal::JournalEntry;
pub use keeper::Keeper;
pub use retract::{Refused, Retracted};
pub use survey::Survey;
