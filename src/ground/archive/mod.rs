//! The archive: everything that the ground knows, kept from one session to the next.
//!
//! An archive is a folder of checkpoints. A checkpoint holds data and a journal. Data: the sums, auto-correlations,
//! positions, the instrument, packets in the hold buffer. The journal has a record of every packet that was applied.
//! Everything else follows from the journal and is not stored: the ledger, the reception counters, the received set,
//! the blocks that were used, the spans of the maps. The [`crate::ground::Ground`] stage owns all of it, so a
//! checkpoint between two packets is consistent.
//!
//! # Order
//! Every packet is applied once. The description of the instrument comes first; until it arrives, everything is held.
//! Positions and the spacecraft's reports are applied at once. Visibilities are applied as soon as positions are known
//! over their whole span; gaps do not delay them. Beyond `wait_bytes` of held visibilities, those that were sent first
//! are applied, and permanently flagged as without positions.
//!
//! Unless that happens, sums and journal are a function of the set of packets received, bit for bit, not of their order.
//! Snapshots are not part of an archive. Blocks that the spacecraft sent twice, in different packets, are an exception:
//! the one that arrives first is used.
//!
//! The maps at the end of a session include held packets; the checkpoint keeps them held.
//!
//! # Merging
//! The journals are united, the sums added. Visibilities that are in both journals are an error. Held packets that the
//! other journal has are dropped; those whose positions the other archive knows are applied. The result does not depend
//! on the order.
//!
//! # Retraction
//! [`crate::ground::Ground::retract`] subtracts packets from the sums, exactly, and deletes their records: in the ledger
//! they are lost on the way down until they are received again. A record has the packet's checksum and a digest of what
//! was offered to the sums; a packet that differs from the one applied, or whose positions have changed since, stays and
//! is reported. Positions by which other visibilities were placed stay as well, and parts of payloads. A block that was
//! flagged as a duplicate of one that is removed stays flagged. Both checkpoints of the folder are written again, so
//! that a damaged one does not bring the packets back.
//!
//! # Other gains
//! [`crate::ground::Ground::recalibrate`] subtracts packets under the gains that they were added with, and adds them under
//! others. All packets whose gains change have to be there. The gains of a state have a number, from 1. With gains that are
//! found while the data arrive, packets of a pass are held until it is closed; a checkpoint has the solutions of closed passes and
//! the spans of open ones.
//!
//! # Size
//! The journal takes some 95 bytes a packet of visibilities in a checkpoint and 300 in memory: 12 and 36 MB a channel of 26
//! million visibilities, in packets of 215. Held packets take up to `wait_bytes` in either. With or without an archive, memory
//! holds positions, 9 kB a window for at most 8192 windows (72 MB, more than two years), and some 100 bytes a packet of
//! visibilities: 60 in the received set and 20 to 40 in the set of blocks.
//!
//! # The raw archive
//! A ground that listens keeps every packet that it accepts in `archive/` beside its checkpoints before it answers `taken`
//! ([`crate::downlink::transport::packet_archive`]). What came after the checkpoint is applied when the state is opened; a state of
//! another version is made from it by [`crate::ground::Ground::rebuild`].
//!
//! # A checkpoint
//! Magic `LNRSTA06`; length of the head (u64 LE); head (bincode); the channels' engines as they write
//! themselves; CRC-64/NVME of all that (u64 LE). It is written under another name, synced and renamed; the previous one
//! is kept, and used, with a note, if the newest is damaged. A checkpoint is damaged if its checksum or contents are wrong. If
//! the system fails to read it, that is an error, and the folder stays as it was.
//!
//! With `map.refine` the visibilities themselves are kept: in segment files beside the checkpoint, which names each with its checksum. A
//! segment never changes, is stored twice, and is deleted once no checkpoint names it. If both copies are damaged or missing, so is the checkpoint.
//!
//! Ranks of a job (`--mpi`) write a file each, `checkpoint-00000007.2-of-4.lunarray`: the whole head, and of the sums those that the
//! rank holds. The heads of a set are equal, or it is damaged. Any number of ranks reads a set, and so does a process alone.
//!
//! If a checkpoint cannot be written, the ground goes on and tries again: after an eighth of the interval, then after twice as long each
//! time, and three times at the end of the session; then it makes its maps and says what the state lacks. A job of ranks ends instead: a
//! set that lacks a part is not used. Room for two checkpoints is enough: when there is none for a third, the older one is deleted first.

mod calibration_state;
mod checkpoint;
mod draft;
mod entry;
mod folder;
mod gap_report;
mod gaps;
mod journal;
mod names;
mod open_archive;
mod packet_order;
mod recalibrate;
mod recovery;
mod retract;
mod sessions;
mod settings;
mod store;
mod survey;
mod views;

pub(super) use draft::RecordDraft;
pub use entry::JournalEntry;
pub use gap_report::{GapReport, LostStream, VisibilityPacket};
pub use gaps::{ChannelCoverage, Gaps, PositionsPacket, ReceivedPackets, RestartReport, find_gaps};
pub use recalibrate::Recalibrated;
pub use recovery::{ARCHIVE_BYTES_MAX, packets_folder};
pub use retract::{RefusedPacket, Retracted};
pub(super) use store::Archive;
pub use survey::CoverageSurvey;
