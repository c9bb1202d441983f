//! Writes an archive: segments, their size, and what is on disk.

use std::collections::{BTreeMap, VecDeque};
use std::fs::{self, File};
use std::io::{self, Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use super::folder::{ArchivePosition, PacketName, read_marks, read_retracted, segment_name, segments};
use crate::downlink::error::{DownlinkError, io_error};
use crate::downlink::receive::ReceivedSet;
use crate::downlink::wire::{PacketHeader, PacketKind};
use crate::files::FolderLock;

const LOCK: &str = "lock";

/// Size of a segment beyond which a new one begins, bytes.
const SEGMENT_BYTES: u64 = 64 << 20;

/// Interval at which data are synchronised to disk, even if no sender waits.
const SYNC_EVERY: Duration = Duration::from_secs(5);

/// Minimum distance between kept positions in the stream, bytes.
pub(super) const BATCH_STEP: u64 = 1 << 20;

pub(super) struct Writer {
    pub(super) folder: PathBuf,
    _lock: FolderLock,
    /// Closed segments and their bytes, oldest first.
    pub(super) closed: VecDeque<(u64, u64)>,
    /// The segment being written, and its length.
    pub(super) open: Option<(File, u64)>,
    /// Number of the open segment or, without one, of the next.
    pub(super) number: u64,
    pub(super) bytes_max: u64,
    /// Packets that are not appended again.
    pub(super) seen: [ReceivedSet; PacketKind::ALL.len()],
    /// Packets that may not be on disk yet.
    pub(super) unsynced: Vec<PacketName>,
    /// Number of failures. Packets of a ticket of an earlier generation may never reach the disk.
    pub(super) generation: u64,
    /// Number of bytes appended in this session, and how many of them are on disk.
    pub(super) appended: u64,
    pub(super) synced: u64,
    pub(super) synced_at: Instant,
    /// Numbers of bytes of the session's stream, and the archive positions at which later packets begin.
    pub(super) batches: VecDeque<(u64, ArchivePosition)>,
    /// For each checkpoint, by number: the position up to which it contains the packets.
    pub(super) marks: BTreeMap<u64, ArchivePosition>,
    /// Retracted packets, and the end of the archive at their retraction.
    pub(super) retracted: BTreeMap<PacketName, ArchivePosition>,
    pub(super) failed: u64,
    pub(super) failure: Option<String>,
}

impl Writer {
    /// Opens the archive in a folder, which is created if necessary.
    pub(super) fn open(folder: &Path, bytes_max: u64) -> Result<Self, DownlinkError> {
        let lock = FolderLock::acquire(folder, LOCK, false).map_err(io_error(folder, "lock the folder"))?;
        let closed: VecDeque<(u64, u64)> = segments(folder)?.into();
        let number = closed.back().map_or(1, |(number, _)| number + 1);
        let end = ArchivePosition { segment: number, offset: 0 };
        Ok(Self {
            folder: folder.to_owned(),
            _lock: lock,
            closed,
            open: None,
            number,
            bytes_max,
            seen: Default::default(),
            unsynced: Vec::new(),
            generation: 0,
            appended: 0,
            synced: 0,
            synced_at: Instant::now(),
            batches: VecDeque::from([(0, end)]),
            marks: read_marks(folder),
            retracted: read_retracted(folder)?,
            failed: 0,
            failure: None,
        })
    }

    pub(super) fn bytes(&self) -> u64 {
        self.closed.iter().map(|(_, bytes)| bytes).sum::<u64>()
            + self.open.as_ref().map_or(0, |(_, bytes)| *bytes)
    }

    pub(super) fn end(&self) -> ArchivePosition {
        ArchivePosition { segment: self.number, offset: self.open.as_ref().map_or(0, |(_, bytes)| *bytes) }
    }

    pub(super) fn append(&mut self, packets: &[u8]) -> io::Result<()> {
        let (mut new, mut names, mut rest) = (Vec::new(), Vec::new(), packets);
        while let Some(header) = PacketHeader::parse(rest) {
            let (packet, after) = rest.split_at(header.bytes.min(rest.len()));
            if self.seen[header.kind.index()].insert(header.count, header.time) {
                new.extend_from_slice(packet);
                names.push((header.kind, header.count, header.time));
            }
            rest = after;
        }
        let written = if new.is_empty() { Ok(()) } else { self.write(&new) };
        self.unsynced.append(&mut names);
        written?;
        self.appended += new.len() as u64;
        if self.synced_at.elapsed() >= SYNC_EVERY && self.synced < self.appended {
            self.sync_now()?;
        }
        Ok(())
    }

    fn write(&mut self, bytes: &[u8]) -> io::Result<()> {
        if self.open.as_ref().is_some_and(|(_, length)| *length >= SEGMENT_BYTES) {
            self.sync_now()?;
            self.close();
        }
        match self.write_to_segment(bytes) {
            Err(error) if is_full(&error) && self.delete_oldest(SEGMENT_BYTES.max(bytes.len() as u64)) => {
                self.write_to_segment(bytes)
            }
            written => written,
        }
    }

    /// Writes to the open segment, or to a new one.
    fn write_to_segment(&mut self, bytes: &[u8]) -> io::Result<()> {
        if self.open.is_none() {
            let path = self.folder.join(segment_name(self.number));
            let file = File::options().write(true).create_new(true).open(path)?;
            // Brings the file's name to disk.
            File::open(&self.folder)?.sync_all()?;
            self.open = Some((file, 0));
        }
        let Some((file, length)) = &mut self.open else { return Ok(()) };
        let written = file.write_all(bytes);
        match written {
            Ok(()) => *length += bytes.len() as u64,
            Err(_) => {
                // Otherwise a reader would find a damaged packet.
                file.set_len(*length)?;
                file.seek(SeekFrom::Start(*length))?;
            }
        }
        written
    }

    fn sync_now(&mut self) -> io::Result<()> {
        if let Some((file, _)) = &self.open {
            file.sync_data()?;
        }
        self.record_sync(self.appended);
        Ok(())
    }

    /// Records that the first `bytes` appended bytes are on disk.
    pub(super) fn record_sync(&mut self, bytes: u64) {
        self.synced = self.synced.max(bytes);
        self.synced_at = Instant::now();
        if self.synced == self.appended {
            self.unsynced.clear();
        }
    }

    /// Closes the segment, so that the next packets go into a new one. An empty segment is deleted.
    fn close(&mut self) {
        let Some((_, bytes)) = self.open.take() else { return };
        if bytes == 0 && fs::remove_file(self.folder.join(segment_name(self.number))).is_ok() {
            return;
        }
        self.closed.push_back((self.number, bytes));
        self.number += 1;
    }

    /// Records a failure; returns its reason. Packets that may not be on disk are accepted when they are sent again.
    pub(super) fn record_failure(&mut self, error: &io::Error) -> String {
        for (kind, count, time) in std::mem::take(&mut self.unsynced) {
            self.seen[kind.index()].remove(count, time);
        }
        self.close();
        self.generation += 1;
        self.failed += 1;
        self.synced = self.appended;
        let reason = format!("{}: {error}", self.folder.display());
        self.failure = Some(reason.clone());
        reason
    }

    /// Records the position that corresponds to the first `passed` bytes of the stream. The latest position is exact, and the
    /// ones before it are at least [`BATCH_STEP`] apart.
    pub(super) fn record_batch(&mut self, passed: u64) {
        let end = self.end();
        let before = self.batches.len().checked_sub(2).map(|at| self.batches[at].0);
        match (before, self.batches.back_mut()) {
            (Some(before), Some(last)) if passed - before < BATCH_STEP => *last = (passed, end),
            _ => self.batches.push_back((passed, end)),
        }
    }

    /// Deletes the oldest segments whose packets are in all checkpoints, until `bytes` are free; returns whether any was deleted.
    pub(super) fn delete_oldest(&mut self, bytes: u64) -> bool {
        let end = self.marks.values().min().map_or(0, |position| position.segment);
        let mut freed = 0;
        while freed < bytes
            && let Some((number, length)) = self.closed.front().copied().filter(|(number, _)| *number < end)
        {
            if fs::remove_file(self.folder.join(segment_name(number))).is_err() {
                break;
            }
            self.closed.pop_front();
            freed += length;
        }
        freed > 0
    }
}

fn is_full(error: &io::Error) -> bool {
    use io::ErrorKind::{FileTooLarge, QuotaExceeded, StorageFull};
    matches!(error.kind(), StorageFull | QuotaExceeded | FileTooLarge)
}
