//! The archive, which keeps the state of the ground stage from one session to the next.
//!
//! An archive is a folder of checkpoints. A checkpoint holds data and a journal. The data are the sums, auto-correlations,
//! ephemeris, instrument, and packets in the hold buffer. The journal has a record of every applied packet.
//! The ledger, the reception counters, the received set, the blocks used and the time spans of the maps are derived
//! from the journal and not stored. The [`crate::ground::Ground`] stage owns all of it, so a checkpoint between two
//! packets is consistent.
//!
//! # Order
//! Every packet is applied once. The description of the instrument comes first; until it arrives, all packets are held.
//! The ephemeris and the spacecraft's reports are applied at once. Visibilities are applied as soon as the ephemeris covers
//! their whole span; gaps do not delay them. Beyond `wait_bytes` of held visibilities, those that were sent first
//! are applied and permanently flagged as without positions.
//!
//! Unless that happens, sums and journal depend on the set of packets received, bit for bit, not on their order. Blocks
//! that the spacecraft sent twice, in different packets, are an exception: the first to arrive is used. Snapshots are
//! not part of an archive.
//!
//! The maps at the end of a session include held packets; the checkpoint keeps them held.
//!
//! # Merging
//! The journals are united and the sums added. Visibilities in both journals are an error. Held packets that are in the
//! other journal are dropped; those covered by the other ephemeris are applied. The result does not depend
//! on the order.
//!
//! # Retraction
//! [`crate::ground::Ground::retract`] subtracts packets from the sums, exactly, and deletes their records. The ledger then
//! counts them as lost on the downlink until they are received again. A record has the packet's checksum and a digest of
//! the data offered to the sums. A packet that differs from the applied one, or whose positions have changed since, stays
//! and is reported. Ephemeris packets that other visibilities need stay as well, and incomplete payloads. A block that was
//! flagged as a duplicate of a removed one stays flagged. Both checkpoints of the folder are written again, so that
//! falling back to the older one does not bring the packets back.
//!
//! # Recalibration
//! [`crate::ground::Ground::recalibrate`] subtracts packets with the gains that they were added with, and adds them with
//! new ones. All packets whose gains change have to be given. The calibrations of a state are numbered from 1. If gains
//! are solved for while the data arrive, packets of a pass are held until it is closed; a checkpoint has the solutions of closed
//! passes and the spans of open ones.
//!
//! # Size
//! The journal takes some 95 bytes per packet of visibilities in a checkpoint and 300 in memory: 12 and 36 MB for a channel of
//! 26 million visibilities in packets of 215. Held packets take up to `wait_bytes` in both. With or without an archive, memory
//! holds the ephemeris, 9 kB per window for at most 8192 windows (72 MB, more than two years), and some 100 bytes per packet
//! of visibilities: 60 in the received set and 20 to 40 in the set of blocks.
//!
//! # The raw archive
//! A ground stage that listens stores every accepted packet in `archive/` beside its checkpoints before it answers `taken`
//! ([`crate::downlink::transport::packet_archive`]). Packets newer than the checkpoint are applied when the state is opened.
//! [`crate::ground::Ground::rebuild`] makes a new state from the raw archive alone.
//!
//! # A checkpoint
//! The format is: magic `LNRSTA13`; length of the head (u64 LE); head (bincode); the sums of the channels in the format of
//! their engine; CRC-64/NVME of all that (u64 LE). It is written under another name, synced and renamed. The previous
//! checkpoint is kept, and used with a note if the newest is damaged, that is, if its checksum or contents are wrong. A
//! read error of the system is an error, and the folder stays unchanged.
//!
//! With `map.refine` the visibilities themselves are kept in segment files beside the checkpoint, which names each with its
//! checksum. A segment never changes, is stored twice, and is deleted once no checkpoint names it. If both copies are damaged
//! or missing, the checkpoint counts as damaged.
//!
//! Each rank of a job (`--mpi`) writes a file, such as `checkpoint-00000007.2-of-4.lunarray`, with the whole head and its part
//! of the sums. If the heads of a set differ, it is damaged. Any number of ranks, or a single process, can read a set.
//!
//! If a checkpoint cannot be written, the stage tries again after an eighth of the interval, then after twice as long each
//! time, and three times at the end of the session. Then it makes its maps and reports the unsaved data. A job of ranks
//! ends instead, as a set that lacks a part is not used. Disk space for two checkpoints is enough: if there is none for a
//! third, the older one is deleted first.

pub(super) mod calibration_state;
pub(super) mod checkpoint;
pub(super) mod draft;
mod entry;
pub(super) mod folder;
mod gap_report;
mod gaps;
pub(super) mod journal;
pub(super) mod names;
mod packet_order;
pub(super) mod raw_archive;
pub(super) mod settings;
pub(super) mod store;
mod survey;
mod views;

pub(super) use draft::RecordDraft;
pub use entry::JournalEntry;
pub use gap_report::{GapReport, LostStream, VisibilityPacket};
pub use gaps::{ChannelCoverage, EphemerisPacket, Gaps, ReceivedPackets, RestartReport, find_gaps};
pub use raw_archive::{ARCHIVE_BYTES_MAX, packets_folder};
pub use settings::REMEMBERED;
pub(super) use store::Archive;
pub use survey::CoverageSurvey;
