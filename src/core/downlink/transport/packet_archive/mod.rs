//! The raw archive: accepted packets as received, on disk before they are acknowledged to their sender.
//!
//! An archive is a folder of segments such as `packets-00000001.ccsds`, each a downlink file that any version of the program
//! can replay. Every packet has its own checksum, so a flipped bit costs one packet, and a torn end costs only packets that
//! were never acknowledged. A closed segment is never changed.
//!
//! The list `marks` has the position up to which each checkpoint contains the packets, so that a restarted ground reads only
//! later packets. Without it, everything is read, which is slower but correct. The list `retracted` has packets that were
//! removed from the state: copies before the recorded position are left out when a state is rebuilt.

mod folder;
mod scan;
#[cfg(test)]
mod tests;
mod writer;

use std::io;
use std::path::Path;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use serde::Serialize;

pub use folder::{ArchivePosition, PacketName};
use folder::{MARKS, RETRACTED, write_sealed};
pub use scan::{ArchiveScan, read_archive, read_unsaved, unsaved_bytes};
use writer::Writer;

use crate::downlink::error::DownlinkError;
use crate::downlink::receive::ReceivedSet;
use crate::downlink::wire::PacketKind;

/// A receipt for appended packets, with which a sender waits until they are on disk.
#[derive(Clone, Copy, Debug)]
pub(super) struct Ticket {
    generation: u64,
    /// Number of bytes appended up to the last of the packets.
    bytes: u64,
}

/// The state of an archive, for status and metrics.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize)]
pub struct ArchiveReport {
    /// Bytes of packets in the archive.
    pub bytes: u64,
    /// Number of segments.
    pub segments: u64,
    /// Whether the archive reaches back to the first packet, as a full archive deletes its oldest segments.
    pub is_whole: bool,
    /// Number of batches that could not be written.
    pub failed: u64,
    /// Why the last batch could not be written; `None` if it was written.
    pub unwritten: Option<String>,
}

/// An open archive, which keeps accepted packets. Clones share it.
#[derive(Clone)]
pub struct PacketArchive(Arc<Shared>);

impl std::fmt::Debug for PacketArchive {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_tuple("PacketArchive").field(&self.report()).finish()
    }
}

struct Shared {
    writer: Mutex<Writer>,
    /// Locked by the waiter that synchronises the disk for all others.
    sync_lock: Mutex<()>,
}

impl PacketArchive {
    /// Opens the archive in a folder, which is created if necessary. Beyond `bytes_max` it deletes the oldest segments whose
    /// packets are in all checkpoints.
    ///
    /// # Errors
    /// The folder cannot be used or is in use; the list of retracted packets is damaged.
    pub fn open(folder: &Path, bytes_max: u64) -> Result<Self, DownlinkError> {
        let writer = Mutex::new(Writer::open(folder, bytes_max)?);
        Ok(Self(Arc::new(Shared { writer, sync_lock: Mutex::new(()) })))
    }

    /// Sets the maximum size of the archive.
    pub fn set_bytes_max(&self, bytes_max: u64) {
        self.writer().bytes_max = bytes_max;
    }

    /// Sets the packets that the ground has received, which are not appended again.
    pub fn set_received<'a>(&self, received: impl Iterator<Item = (PacketKind, &'a ReceivedSet)>) {
        let mut writer = self.writer();
        for (kind, set) in received {
            writer.seen[kind.index()] = set.clone();
        }
    }

    /// Appends complete packets, each once. `passed` is the number of bytes of the session's stream with them.
    pub(super) fn append(&self, packets: &[u8], passed: u64) -> Result<Ticket, String> {
        let mut writer = self.writer();
        let written = writer.append(packets);
        match written {
            Ok(()) => {
                writer.record_batch(passed);
                writer.failure = None;
                Ok(Ticket { generation: writer.generation, bytes: writer.appended })
            }
            Err(error) => Err(writer.record_failure(&error)),
        }
    }

    /// Waits until the packets of a ticket are on disk.
    pub(super) fn sync(&self, ticket: Ticket) -> Result<(), String> {
        let _guard = self.0.sync_lock.lock().unwrap_or_else(PoisonError::into_inner);
        let (file, appended) = {
            let writer = self.writer();
            if ticket.generation != writer.generation {
                let reason = writer.failure.clone();
                return Err(reason.unwrap_or_else(|| "an earlier batch could not be written".to_owned()));
            }
            if ticket.bytes <= writer.synced {
                return Ok(());
            }
            (writer.open.as_ref().map(|(file, _)| file.try_clone()), writer.appended)
        };
        // Other senders append meanwhile, as the writer is not locked.
        let synced = file.transpose().and_then(|file| file.map_or(Ok(()), |file| file.sync_data()));
        let mut writer = self.writer();
        match synced {
            Ok(()) => {
                writer.record_sync(appended);
                Ok(())
            }
            Err(error) => Err(writer.record_failure(&error)),
        }
    }

    /// Records that a checkpoint contains the first `passed` bytes of the session's stream, and forgets the checkpoints that
    /// are not in `kept`.
    ///
    /// # Errors
    /// The list cannot be written; more packets are then read after a restart.
    pub fn record_checkpoint(&self, checkpoint: u64, passed: u64, kept: &[u64]) -> io::Result<()> {
        let mut writer = self.writer();
        while writer.batches.len() > 1 && writer.batches[1].0 <= passed {
            writer.batches.pop_front();
        }
        let position = writer.batches.front().map(|(_, position)| *position).unwrap_or_default();
        writer.marks.insert(checkpoint, position);
        writer.marks.retain(|number, _| kept.contains(number));
        let text: String = writer
            .marks
            .iter()
            .map(|(number, position)| format!("{number} {} {}\n", position.segment, position.offset))
            .collect();
        write_sealed(&writer.folder.join(MARKS), text)?;
        let excess = writer.bytes().saturating_sub(writer.bytes_max);
        writer.delete_oldest(excess);
        Ok(())
    }

    /// Records retracted packets: their copies in the archive are ignored from now on, later copies are not.
    ///
    /// # Errors
    /// The list cannot be written.
    pub fn retract(&self, packets: &[PacketName]) -> io::Result<()> {
        let mut writer = self.writer();
        let end = writer.end();
        for name in packets {
            writer.retracted.insert(*name, end);
            writer.seen[name.0.index()].remove(name.1, name.2);
        }
        let line = |((kind, count, time), end): (&PacketName, &ArchivePosition)| {
            format!("{} {count} {} {} {}\n", kind.apid(), time.0, end.segment, end.offset)
        };
        let text: String = writer.retracted.iter().map(line).collect();
        write_sealed(&writer.folder.join(RETRACTED), text)
    }

    /// The state of the archive, for status and metrics.
    #[must_use]
    pub fn report(&self) -> ArchiveReport {
        let writer = self.writer();
        let first = writer.closed.front().map_or(writer.number, |(number, _)| *number);
        ArchiveReport {
            bytes: writer.bytes(),
            segments: writer.closed.len() as u64 + u64::from(writer.open.is_some()),
            is_whole: first == 1,
            failed: writer.failed,
            unwritten: writer.failure.clone(),
        }
    }

    fn writer(&self) -> MutexGuard<'_, Writer> {
        self.0.writer.lock().unwrap_or_else(PoisonError::into_inner)
    }
}
