//! Reads the packets of an archive.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::{Seek, SeekFrom};
use std::path::Path;

use super::folder::{
    ArchivePosition, PacketName, checkpoint_position, read_marks, read_retracted, segment_name, segments,
};
use crate::downlink::error::{DownlinkError, io_error};
use crate::downlink::receive::{ByteFeed, DownlinkReceiver, Event};

/// Number of bytes of packets that a reader delivers at a time.
const PIECE_BYTES: usize = 1 << 18;

/// The result of reading an archive.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct ArchiveScan {
    /// Number of valid packets.
    pub packets: u64,
    /// Bytes of these packets.
    pub bytes: u64,
    /// Number of damaged parts: flipped bits, and ends that were never acknowledged.
    pub damaged: u64,
    /// Number of the first segment; above 1 if older segments were deleted.
    pub first_segment: u64,
}

/// Calls `take` with all packets of an archive that were not retracted. Neither locks nor writes anything.
///
/// # Errors
/// The folder or a segment cannot be read; the list of retracted packets is damaged; the first error of `take`.
pub fn read_archive<E: From<DownlinkError>>(
    folder: &Path,
    take: impl FnMut(Vec<u8>) -> Result<(), E>,
) -> Result<ArchiveScan, E> {
    let retracted = read_retracted(folder)?;
    read_segments(folder, ArchivePosition::default(), &retracted, take)
}

/// Calls `take` with the packets of an archive that are not in a checkpoint and were not retracted.
///
/// # Errors
/// The errors of [`read_archive`].
pub fn read_unsaved<E: From<DownlinkError>>(
    folder: &Path,
    checkpoint: Option<u64>,
    take: impl FnMut(Vec<u8>) -> Result<(), E>,
) -> Result<ArchiveScan, E> {
    let retracted = read_retracted(folder)?;
    read_segments(folder, checkpoint_position(&read_marks(folder), checkpoint), &retracted, take)
}

/// Number of bytes in an archive that are not in a checkpoint. Neither locks nor writes anything.
///
/// # Errors
/// The folder cannot be read.
pub fn unsaved_bytes(folder: &Path, checkpoint: Option<u64>) -> Result<u64, DownlinkError> {
    let from = checkpoint_position(&read_marks(folder), checkpoint);
    let unsaved = segments(folder)?.into_iter().filter(|(number, _)| *number >= from.segment);
    let saved_bytes = |number: u64| if number == from.segment { from.offset } else { 0 };
    Ok(unsaved.map(|(number, bytes)| bytes.saturating_sub(saved_bytes(number))).sum())
}

fn read_segments<E: From<DownlinkError>>(
    folder: &Path,
    from: ArchivePosition,
    retracted: &BTreeMap<PacketName, ArchivePosition>,
    mut take: impl FnMut(Vec<u8>) -> Result<(), E>,
) -> Result<ArchiveScan, E> {
    let segments = segments(folder)?;
    let first_segment = segments.first().map_or(1, |(number, _)| *number);
    let mut scan = ArchiveScan { first_segment, ..ArchiveScan::default() };
    for (number, _) in segments.into_iter().filter(|(number, _)| *number >= from.segment) {
        let path = folder.join(segment_name(number));
        let start = if number == from.segment { from.offset } else { 0 };
        let mut file = File::open(&path).map_err(io_error(&path, "open the segment"))?;
        file.seek(SeekFrom::Start(start)).map_err(io_error(&path, "read"))?;
        let (mut feed, mut receiver) = (ByteFeed::new(file, &path), DownlinkReceiver::unfiltered());
        let mut piece = Vec::new();
        while feed.feed(&mut receiver)? {
            while let Some(event) = receiver.next_event() {
                let Event::Packet(packet) = event else {
                    scan.damaged += 1;
                    continue;
                };
                let header = packet.header;
                let position = ArchivePosition { segment: number, offset: start + packet.offset };
                let name = (header.kind, header.count, header.time);
                if retracted.get(&name).is_some_and(|end| position < *end) {
                    continue;
                }
                packet.append_to(&mut piece);
                scan.packets += 1;
                scan.bytes += header.bytes as u64;
                if piece.len() >= PIECE_BYTES {
                    take(std::mem::take(&mut piece))?;
                }
            }
        }
        if !piece.is_empty() {
            take(piece)?;
        }
    }
    Ok(scan)
}
