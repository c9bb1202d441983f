//! The raw archive: accepted packets as they came, on disk before their sender is told that they are taken.
//!
//! An archive is a folder of segments, `packets-00000001.ccsds`, each a downlink file that any version of the program replays. Every
//! packet has its own checksum, so a flipped bit costs one packet and a torn end costs what was never answered. A segment is
//! never written again once it is closed. `marks` says up to where checkpoints hold the packets, so that a ground that is
//! started again reads only what came after its checkpoint; without it everything is read, which is slow and does no harm.
//! `retracted` names packets that were removed from the state: what came before stays out when a state is made anew.

use std::collections::{BTreeMap, VecDeque};
use std::fs::{self, File};
use std::io::{self, Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use crc_fast::{CrcAlgorithm, checksum};
use serde::Serialize;

use crate::downlink::error::{DownlinkError, io_error};
use crate::downlink::receive::{ByteFeed, DownlinkReceiver, Event, ReceivedSet};
use crate::downlink::wire::{CucTime, PacketHeader, PacketKind};
use crate::files::{FolderLock, read_folder, write_atomically};

/// Greatest size of a segment, bytes: a new one begins beyond.
const SEGMENT_BYTES: u64 = 64 << 20;

/// Data reach the disk at least this often, even if no sender waits for it.
const SYNC_EVERY: Duration = Duration::from_secs(5);

/// Distance between remembered places in the stream, bytes.
const BATCH_STEP: u64 = 1 << 20;

/// Bytes of packets that are read at a time.
const PIECE_BYTES: usize = 1 << 18;

const PREFIX: &str = "packets-";
const SUFFIX: &str = ".ccsds";
const MARKS: &str = "marks";
const RETRACTED: &str = "retracted";
const LOCK: &str = "lock";

/// A packet by kind, count and creation time.
pub type PacketName = (PacketKind, u64, CucTime);

/// A place in an archive: between two packets.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord)]
pub struct ArchivePosition {
    /// Number of the segment, from 1.
    pub segment: u64,
    /// Bytes before it in the segment.
    pub offset: u64,
}

/// What a sender's packets need to be on disk.
#[derive(Clone, Copy, Debug)]
pub(super) struct Ticket {
    generation: u64,
    bytes: u64,
}

/// State of an archive, for status and metrics.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize)]
pub struct ArchiveReport {
    /// Bytes of packets in it.
    pub bytes: u64,
    /// Its segments.
    pub segments: u64,
    /// Whether it reaches back to the first packet: older segments go when it is full.
    pub is_whole: bool,
    /// Pieces that could not be written.
    pub failed: u64,
    /// Why the last piece could not be written; `None` if it could.
    pub unwritten: Option<String>,
}

/// Keeps accepted packets; clones share it.
#[derive(Clone)]
pub struct PacketArchive(Arc<Shared>);

impl std::fmt::Debug for PacketArchive {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_tuple("PacketArchive").field(&self.report()).finish()
    }
}

struct Shared {
    writer: Mutex<Writer>,
    /// Held by the one waiter that synchronises the disk for all others.
    turn: Mutex<()>,
}

struct Writer {
    folder: PathBuf,
    _lock: FolderLock,
    /// Closed segments and their bytes, oldest first.
    closed: VecDeque<(u64, u64)>,
    /// The segment being written, and its length.
    open: Option<(File, u64)>,
    /// Number of the segment that is written, or will be.
    number: u64,
    bytes_max: u64,
    seen: [ReceivedSet; PacketKind::ALL.len()],
    /// Packets that may not have reached the disk.
    recent: Vec<PacketName>,
    /// Counts failures: packets that were not on disk by then may never be.
    generation: u64,
    appended: u64,
    synced: u64,
    synced_at: Instant,
    /// Bytes of the session's stream, and the place where packets that arrive later begin.
    batches: VecDeque<(u64, ArchivePosition)>,
    /// By number of a checkpoint: the place before which it holds everything.
    marks: BTreeMap<u64, ArchivePosition>,
    retracted: BTreeMap<PacketName, ArchivePosition>,
    failed: u64,
    failure: Option<String>,
}

impl PacketArchive {
    /// Opens the archive in a folder, which is created if need be. Beyond `bytes_max` the oldest segments go, once all
    /// checkpoints hold what is in them.
    ///
    /// # Errors
    /// A folder that cannot be used or is in use; a list of retracted packets that is damaged.
    pub fn open(folder: &Path, bytes_max: u64) -> Result<Self, DownlinkError> {
        let lock = FolderLock::acquire(folder, LOCK, false).map_err(io_error(folder, "lock the folder"))?;
        let closed: VecDeque<(u64, u64)> = segments(folder)?.into();
        let number = closed.back().map_or(1, |(number, _)| number + 1);
        let place = ArchivePosition { segment: number, offset: 0 };
        Ok(Self(Arc::new(Shared {
            writer: Mutex::new(Writer {
                folder: folder.to_owned(),
                _lock: lock,
                closed,
                open: None,
                number,
                bytes_max,
                seen: Default::default(),
                recent: Vec::new(),
                generation: 0,
                appended: 0,
                synced: 0,
                synced_at: Instant::now(),
                batches: VecDeque::from([(0, place)]),
                marks: read_marks(folder),
                retracted: read_retracted(folder)?,
                failed: 0,
                failure: None,
            }),
            turn: Mutex::new(()),
        })))
    }

    /// Sets the most bytes to keep, as far as checkpoints allow.
    pub fn limit(&self, bytes_max: u64) {
        self.writer().bytes_max = bytes_max;
    }

    /// Leaves out packets that are known already.
    pub fn know<'a>(&self, received: impl Iterator<Item = (PacketKind, &'a ReceivedSet)>) {
        let mut writer = self.writer();
        for (kind, set) in received {
            writer.seen[kind.index()] = set.clone();
        }
    }

    /// Appends whole packets, each once; the stream has `passed` bytes with them.
    pub(super) fn append(&self, packets: &[u8], passed: u64) -> Result<Ticket, String> {
        let mut writer = self.writer();
        let written = writer.append(packets);
        match written {
            Ok(()) => {
                writer.note_batch(passed);
                writer.failure = None;
                Ok(Ticket { generation: writer.generation, bytes: writer.appended })
            }
            Err(error) => Err(writer.fail(&error)),
        }
    }

    /// Waits until the packets of a ticket are on disk.
    pub(super) fn sync(&self, ticket: Ticket) -> Result<(), String> {
        let _turn = self.0.turn.lock().unwrap_or_else(PoisonError::into_inner);
        let (file, upto) = {
            let writer = self.writer();
            if ticket.generation != writer.generation {
                let reason = writer.failure.clone();
                return Err(reason.unwrap_or_else(|| "a piece before could not be written".to_owned()));
            }
            if ticket.bytes <= writer.synced {
                return Ok(());
            }
            (writer.open.as_ref().map(|(file, _)| file.try_clone()), writer.appended)
        };
        // Others go on appending meanwhile.
        let synced = file.transpose().and_then(|file| file.map_or(Ok(()), |file| file.sync_data()));
        let mut writer = self.writer();
        match synced {
            Ok(()) => {
                writer.note_synced(upto);
                Ok(())
            }
            Err(error) => Err(writer.fail(&error)),
        }
    }

    /// A checkpoint holds the first `passed` bytes of the session's stream, and these checkpoints are kept.
    ///
    /// # Errors
    /// The system's; what came is then read once more after a restart.
    pub fn mark(&self, checkpoint: u64, passed: u64, kept: &[u64]) -> io::Result<()> {
        let mut writer = self.writer();
        while writer.batches.len() > 1 && writer.batches[1].0 <= passed {
            writer.batches.pop_front();
        }
        let place = writer.batches.front().map(|(_, place)| *place).unwrap_or_default();
        writer.marks.insert(checkpoint, place);
        writer.marks.retain(|number, _| kept.contains(number));
        let text: String = writer
            .marks
            .iter()
            .map(|(number, place)| format!("{number} {} {}\n", place.segment, place.offset))
            .collect();
        write_sealed(&writer.folder.join(MARKS), text)?;
        let over = writer.bytes().saturating_sub(writer.bytes_max);
        writer.make_room(over);
        Ok(())
    }

    /// Notes retracted packets: copies that the archive holds by now are ignored.
    ///
    /// # Errors
    /// The system's.
    pub fn retract(&self, packets: &[PacketName]) -> io::Result<()> {
        let mut writer = self.writer();
        let place = writer.end();
        for name in packets {
            writer.retracted.insert(*name, place);
            writer.seen[name.0.index()].remove(name.1, name.2);
        }
        let line = |((kind, count, time), place): (&PacketName, &ArchivePosition)| {
            format!("{} {count} {} {} {}\n", kind.apid(), time.0, place.segment, place.offset)
        };
        let text: String = writer.retracted.iter().map(line).collect();
        write_sealed(&writer.folder.join(RETRACTED), text)
    }

    /// Its state, for status and metrics.
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

impl Writer {
    fn bytes(&self) -> u64 {
        self.closed.iter().map(|(_, bytes)| bytes).sum::<u64>()
            + self.open.as_ref().map_or(0, |(_, bytes)| *bytes)
    }

    fn end(&self) -> ArchivePosition {
        ArchivePosition { segment: self.number, offset: self.open.as_ref().map_or(0, |(_, bytes)| *bytes) }
    }

    fn append(&mut self, packets: &[u8]) -> io::Result<()> {
        let (mut new, mut names, mut rest) = (Vec::new(), Vec::new(), packets);
        while let Some(header) = PacketHeader::parse(rest) {
            let (packet, behind) = rest.split_at(header.bytes.min(rest.len()));
            if self.seen[header.kind.index()].insert(header.count, header.time) {
                new.extend_from_slice(packet);
                names.push((header.kind, header.count, header.time));
            }
            rest = behind;
        }
        let written = if new.is_empty() { Ok(()) } else { self.write(&new) };
        self.recent.append(&mut names);
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
        match self.write_here(bytes) {
            // Segments that all checkpoints hold are deleted first.
            Err(error) if is_full(&error) && self.make_room(SEGMENT_BYTES.max(bytes.len() as u64)) => {
                self.write_here(bytes)
            }
            written => written,
        }
    }

    fn write_here(&mut self, bytes: &[u8]) -> io::Result<()> {
        if self.open.is_none() {
            let path = self.folder.join(segment_name(self.number));
            let file = File::options().write(true).create_new(true).open(path)?;
            // Synchronises its name, too.
            File::open(&self.folder)?.sync_all()?;
            self.open = Some((file, 0));
        }
        let Some((file, length)) = &mut self.open else { return Ok(()) };
        let written = file.write_all(bytes);
        match written {
            Ok(()) => *length += bytes.len() as u64,
            Err(_) => {
                // The part that was written would be read as a damaged packet.
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
        self.note_synced(self.appended);
        Ok(())
    }

    fn note_synced(&mut self, upto: u64) {
        self.synced = self.synced.max(upto);
        self.synced_at = Instant::now();
        if self.synced == self.appended {
            self.recent.clear();
        }
    }

    /// Closes the segment: the next packets go into a new one. An empty segment is deleted.
    fn close(&mut self) {
        let Some((_, bytes)) = self.open.take() else { return };
        if bytes == 0 && fs::remove_file(self.folder.join(segment_name(self.number))).is_ok() {
            return;
        }
        self.closed.push_back((self.number, bytes));
        self.number += 1;
    }

    /// Packets that may not be on disk are accepted again when they are sent again.
    fn fail(&mut self, error: &io::Error) -> String {
        for (kind, count, time) in std::mem::take(&mut self.recent) {
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

    fn note_batch(&mut self, passed: u64) {
        let end = self.end();
        let is_near = |step: &(u64, ArchivePosition)| passed - step.0 < BATCH_STEP;
        // The last one is exact; those before it are apart.
        let before = self.batches.len().checked_sub(2).map(|at| self.batches[at]);
        match (before, self.batches.back_mut()) {
            (Some(before), Some(last)) if is_near(&before) => *last = (passed, end),
            _ => self.batches.push_back((passed, end)),
        }
    }

    /// Removes the oldest segments until so many bytes are free; only those that all checkpoints hold. Returns whether any went.
    fn make_room(&mut self, bytes: u64) -> bool {
        let held = self.marks.values().min().map_or(0, |place| place.segment);
        let mut freed = 0;
        while freed < bytes
            && let Some((number, length)) = self.closed.front().copied().filter(|(number, _)| *number < held)
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

/// What was found when an archive was read.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct ArchiveScan {
    /// Sound packets.
    pub packets: u64,
    /// Their bytes.
    pub bytes: u64,
    /// Stretches of bytes that are no sound packet: flipped bits, and ends that were never answered.
    pub damaged: u64,
    /// Number of the first segment that is there; above 1 if older ones have gone.
    pub first_segment: u64,
}

/// Gives `take` all packets of the archive in a folder that were not retracted. Nothing is locked or
/// written.
///
/// # Errors
/// A folder or segment that cannot be read; a list of retracted packets that is damaged; the first error of `take`.
pub fn read_archive<E: From<DownlinkError>>(
    folder: &Path,
    take: impl FnMut(Vec<u8>) -> Result<(), E>,
) -> Result<ArchiveScan, E> {
    let retracted = read_retracted(folder)?;
    read_segments(folder, ArchivePosition::default(), &retracted, take)
}

/// As [`read_archive`], only packets that no checkpoint holds yet.
///
/// # Errors
/// Likewise.
pub fn read_unsaved<E: From<DownlinkError>>(
    folder: &Path,
    checkpoint: Option<u64>,
    take: impl FnMut(Vec<u8>) -> Result<(), E>,
) -> Result<ArchiveScan, E> {
    let retracted = read_retracted(folder)?;
    read_segments(folder, place_in(&read_marks(folder), checkpoint), &retracted, take)
}

/// Bytes in the archive of a folder that no checkpoint holds yet. Nothing is locked or written.
///
/// # Errors
/// A folder that cannot be read.
pub fn unsaved_bytes(folder: &Path, checkpoint: Option<u64>) -> Result<u64, DownlinkError> {
    let from = place_in(&read_marks(folder), checkpoint);
    let behind = segments(folder)?.into_iter().filter(|(number, _)| *number >= from.segment);
    let before = |number: u64| if number == from.segment { from.offset } else { 0 };
    Ok(behind.map(|(number, bytes)| bytes.saturating_sub(before(number))).sum())
}

fn read_segments<E: From<DownlinkError>>(
    folder: &Path,
    from: ArchivePosition,
    retracted: &BTreeMap<PacketName, ArchivePosition>,
    mut take: impl FnMut(Vec<u8>) -> Result<(), E>,
) -> Result<ArchiveScan, E> {
    let segments = segments(folder)?;
    let first_segment = segments.first().map_or(1, |(number, _)| *number);
    let mut reading = ArchiveScan { first_segment, ..ArchiveScan::default() };
    for (number, _) in segments.into_iter().filter(|(number, _)| *number >= from.segment) {
        let path = folder.join(segment_name(number));
        let start = if number == from.segment { from.offset } else { 0 };
        let mut file = File::open(&path).map_err(io_error(&path, "open the segment"))?;
        file.seek(SeekFrom::Start(start)).map_err(io_error(&path, "read"))?;
        let (mut feed, mut intake) = (ByteFeed::new(file, &path), DownlinkReceiver::unfiltered());
        let mut piece = Vec::new();
        while feed.feed(&mut intake)? {
            while let Some(event) = intake.next_event() {
                let Event::Packet(packet) = event else {
                    reading.damaged += 1;
                    continue;
                };
                let header = packet.header;
                let place = ArchivePosition { segment: number, offset: start + packet.offset };
                let name = (header.kind, header.count, header.time);
                if retracted.get(&name).is_some_and(|until| place < *until) {
                    continue;
                }
                packet.append_to(&mut piece);
                reading.packets += 1;
                reading.bytes += header.bytes as u64;
                if piece.len() >= PIECE_BYTES {
                    take(std::mem::take(&mut piece))?;
                }
            }
        }
        if !piece.is_empty() {
            take(piece)?;
        }
    }
    Ok(reading)
}

fn place_in(marks: &BTreeMap<u64, ArchivePosition>, checkpoint: Option<u64>) -> ArchivePosition {
    // Later checkpoints hold what earlier ones do.
    let mark = checkpoint.and_then(|number| marks.range(..=number).next_back());
    mark.map(|(_, place)| *place).unwrap_or_default()
}

fn segment_name(number: u64) -> String {
    format!("{PREFIX}{number:08}{SUFFIX}")
}

/// Segments and their lengths, oldest first; none if there is no folder.
fn segments(folder: &Path) -> Result<Vec<(u64, u64)>, DownlinkError> {
    let failed = || io_error(folder, "read the folder");
    let entries = match read_folder(folder) {
        Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(Vec::new()),
        entries => entries.map_err(failed())?,
    };
    let mut found = Vec::new();
    for entry in entries {
        let entry = entry.map_err(failed())?;
        let name = entry.file_name();
        let name = name.to_string_lossy();
        let number = name.strip_prefix(PREFIX).and_then(|name| name.strip_suffix(SUFFIX));
        if let Some(number) = number.and_then(|number| number.parse().ok()) {
            found.push((number, entry.metadata().map_err(failed())?.len()));
        }
    }
    found.sort_unstable();
    Ok(found)
}

/// Writes lines with their checksum as the last one.
fn write_sealed(path: &Path, text: String) -> io::Result<()> {
    // A vanished archive is not replaced by a new one: its disk may come back.
    if path.parent().is_some_and(|folder| !folder.is_dir()) {
        return Err(io::ErrorKind::NotFound.into());
    }
    let sum = checksum(CrcAlgorithm::Crc64Nvme, text.as_bytes());
    write_atomically(path, format!("{text}checksum {sum:016x}\n").as_bytes())
}

/// The numbers in the lines of a file; `None` if its checksum is wrong.
fn read_sealed(path: &Path) -> io::Result<Option<Vec<Vec<u64>>>> {
    let text = match fs::read_to_string(path) {
        Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(Some(Vec::new())),
        Err(error) if error.kind() == io::ErrorKind::InvalidData => return Ok(None),
        text => text?,
    };
    let Some((body, sum)) = text.rsplit_once("checksum ") else { return Ok(None) };
    if u64::from_str_radix(sum.trim(), 16) != Ok(checksum(CrcAlgorithm::Crc64Nvme, body.as_bytes())) {
        return Ok(None);
    }
    let numbers = |line: &str| line.split(' ').filter_map(|word| word.parse().ok()).collect();
    Ok(Some(body.lines().map(numbers).collect()))
}

/// Ignores damaged marks: more is read than necessary.
fn read_marks(folder: &Path) -> BTreeMap<u64, ArchivePosition> {
    let lines = read_sealed(&folder.join(MARKS)).ok().flatten().unwrap_or_default();
    let mark = |line: &Vec<u64>| match line[..] {
        [number, segment, offset] => Some((number, ArchivePosition { segment, offset })),
        _ => None,
    };
    lines.iter().filter_map(mark).collect()
}

fn read_retracted(folder: &Path) -> Result<BTreeMap<PacketName, ArchivePosition>, DownlinkError> {
    let path = folder.join(RETRACTED);
    let read = read_sealed(&path).and_then(|lines| {
        let reason = "its checksum does not hold: without it packets that were retracted would come back; restore it, or remove \
                      it to have them back";
        lines.ok_or_else(|| io::Error::new(io::ErrorKind::InvalidData, reason))
    });
    let lines = read.map_err(io_error(&path, "read the list of retracted packets"))?;
    let entry = |line: &Vec<u64>| match line[..] {
        [apid, count, time, segment, offset] => {
            let kind = PacketKind::of_apid(u16::try_from(apid).ok()?)?;
            Some(((kind, count, CucTime(time)), ArchivePosition { segment, offset }))
        }
        _ => None,
    };
    Ok(lines.iter().filter_map(entry).collect())
}

/// Whether the disk or a quota is full.
fn is_full(error: &io::Error) -> bool {
    use io::ErrorKind::{FileTooLarge, QuotaExceeded, StorageFull};
    matches!(error.kind(), StorageFull | QuotaExceeded | FileTooLarge)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::downlink::wire::{PacketSegment, packet_checksum};

    /// A packet of visibilities with a payload that nobody decodes.
    fn packet(count: u64) -> Vec<u8> {
        let payload = [count as u8; 100];
        let (kind, segment, time) = (PacketKind::Visibilities, PacketSegment::Whole, CucTime(1 << 40));
        let bytes = crate::downlink::wire::HEADER_BYTES + payload.len() + 4;
        let header =
            PacketHeader { kind, segment, count, time, version: crate::downlink::FORMAT_VERSION, bytes };
        let mut packet = [header.to_bytes().as_slice(), &payload].concat();
        packet.extend(packet_checksum(&packet));
        packet
    }

    fn packets(counts: std::ops::Range<u64>) -> Vec<u8> {
        counts.flat_map(packet).collect()
    }

    fn all_of(folder: &Path) -> (Vec<u8>, ArchiveScan) {
        let mut found = Vec::new();
        let take = |piece: Vec<u8>| -> Result<(), DownlinkError> {
            found.extend(piece);
            Ok(())
        };
        let reading = read_archive(folder, take).unwrap();
        (found, reading)
    }

    fn behind(folder: &Path, checkpoint: u64) -> u64 {
        let none = |_: Vec<u8>| -> Result<(), DownlinkError> { Ok(()) };
        read_unsaved(folder, Some(checkpoint), none).unwrap().packets
    }

    #[test]
    fn every_packet_is_kept_once_and_marks_say_which_a_checkpoint_lacks() {
        let place = tempfile::tempdir().unwrap();
        let archive = PacketArchive::open(place.path(), u64::MAX).unwrap();
        // The last two come again, as from a second station. Places are kept a step apart: a checkpoint between two has those of the first.
        let ticket = archive.append(&packets(0..5), BATCH_STEP).unwrap();
        archive.append(&packets(3..8), 2 * BATCH_STEP).unwrap();
        archive.sync(ticket).unwrap();
        assert_eq!(all_of(place.path()).0, packets(0..8));
        // Checkpoint 7 holds the first piece, 8 both.
        archive.mark(7, BATCH_STEP, &[7]).unwrap();
        archive.mark(8, 2 * BATCH_STEP, &[7, 8]).unwrap();
        assert_eq!([behind(place.path(), 6), behind(place.path(), 7), behind(place.path(), 8)], [8, 3, 0]);
        drop(archive);
        // Another session begins a segment of its own, and goes on.
        let archive = PacketArchive::open(place.path(), u64::MAX).unwrap();
        assert_eq!([behind(place.path(), 7), behind(place.path(), 8)], [3, 0]);
        archive.append(&packets(8..9), 130).unwrap();
        assert_eq!([behind(place.path(), 8), archive.report().segments], [1, 2]);
        // Damaged marks are ignored: everything is read.
        let marks = std::fs::read_to_string(place.path().join(MARKS)).unwrap();
        std::fs::write(place.path().join(MARKS), marks.replacen('8', "9", 1)).unwrap();
        assert_eq!(unsaved_bytes(place.path(), Some(8)).unwrap(), packets(0..9).len() as u64);
    }

    #[test]
    fn a_flipped_bit_costs_a_packet_and_a_torn_end_what_was_never_answered() {
        let place = tempfile::tempdir().unwrap();
        let archive = PacketArchive::open(place.path(), u64::MAX).unwrap();
        archive.append(&packets(0..4), 1).unwrap();
        drop(archive);
        let path = place.path().join(segment_name(1));
        let mut bytes = std::fs::read(&path).unwrap();
        let length = packet(0).len();
        bytes[length + 50] ^= 4;
        bytes.truncate(4 * length - 30);
        std::fs::write(&path, bytes).unwrap();
        // What follows in the next segment is not taken for the rest of the torn one.
        let archive = PacketArchive::open(place.path(), u64::MAX).unwrap();
        archive.append(&packets(4..6), 1).unwrap();
        let (found, reading) = all_of(place.path());
        assert_eq!(found, [packets(0..1), packets(2..3), packets(4..6)].concat());
        assert_eq!((reading.packets, reading.damaged > 1), (4, true));
    }

    #[test]
    fn retracted_packets_stay_out_until_they_come_again() {
        let place = tempfile::tempdir().unwrap();
        let archive = PacketArchive::open(place.path(), u64::MAX).unwrap();
        archive.append(&packets(0..3), 1).unwrap();
        archive.retract(&[(PacketKind::Visibilities, 1, CucTime(1 << 40))]).unwrap();
        assert_eq!(all_of(place.path()).0, [packet(0), packet(2)].concat());
        archive.append(&packets(0..3), 2).unwrap();
        assert_eq!(all_of(place.path()).0, [packet(0), packet(2), packet(1)].concat());
        drop(archive);
        // A list that is damaged would bring them back without a word.
        let list = place.path().join(RETRACTED);
        let text = std::fs::read_to_string(&list).unwrap();
        std::fs::write(&list, text.replacen("259", "258", 1)).unwrap();
        assert!(PacketArchive::open(place.path(), u64::MAX).is_err());
    }

    #[test]
    fn what_could_not_be_written_is_not_taken_and_is_written_when_it_comes_again() {
        let place = tempfile::tempdir().unwrap();
        let folder = place.path().join("archive");
        let archive = PacketArchive::open(&folder, u64::MAX).unwrap();
        std::fs::rename(&folder, place.path().join("gone")).unwrap();
        assert!(archive.append(&packets(0..3), 1).is_err());
        assert_eq!((archive.report().failed, archive.report().unwritten.is_some()), (1, true));
        std::fs::rename(place.path().join("gone"), &folder).unwrap();
        let ticket = archive.append(&packets(0..3), 2).unwrap();
        archive.sync(ticket).unwrap();
        assert_eq!(all_of(&folder).0, packets(0..3));
        assert_eq!(archive.report().unwritten, None);
    }

    #[test]
    fn beyond_its_size_the_oldest_segments_go_that_all_checkpoints_hold() {
        let place = tempfile::tempdir().unwrap();
        // Three sessions, a segment each.
        for count in 0..3 {
            let archive = PacketArchive::open(place.path(), 1).unwrap();
            archive.append(&packets(count..count + 1), 1).unwrap();
            // A checkpoint of nothing of it, and one of the first two segments.
            archive.mark(1 + count, 0, &[count, 1 + count]).unwrap();
        }
        let archive = PacketArchive::open(place.path(), 1).unwrap();
        assert!(!archive.report().is_whole);
        let left = all_of(place.path());
        // Checkpoint 2 holds the first, checkpoint 3 the first two: only the first may go.
        assert_eq!((left.0, left.1.first_segment), (packets(1..3), 2));
    }
}
