//! The files in the folder of an archive: segments, and the lists `marks` and `retracted`.

use std::collections::BTreeMap;
use std::fs;
use std::io;
use std::path::Path;

use crc_fast::{CrcAlgorithm, checksum};

use crate::downlink::error::{DownlinkError, io_error};
use crate::downlink::wire::{CucTime, PacketKind};
use crate::files::{read_folder, write_atomically};

const PREFIX: &str = "packets-";
const SUFFIX: &str = ".ccsds";
pub(super) const MARKS: &str = "marks";
pub(super) const RETRACTED: &str = "retracted";

/// Identity of a packet: kind, count and creation time.
pub type PacketName = (PacketKind, u64, CucTime);

/// A position in an archive, between two packets.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord)]
pub struct ArchivePosition {
    /// Number of the segment, from 1.
    pub segment: u64,
    /// Offset in the segment, bytes.
    pub offset: u64,
}

/// The position up to which a checkpoint contains the packets, as far as it is known.
pub(super) fn checkpoint_position(
    marks: &BTreeMap<u64, ArchivePosition>,
    checkpoint: Option<u64>,
) -> ArchivePosition {
    // A checkpoint contains the packets of all earlier ones.
    let mark = checkpoint.and_then(|number| marks.range(..=number).next_back());
    mark.map(|(_, position)| *position).unwrap_or_default()
}

/// File name of a segment.
pub(super) fn segment_name(number: u64) -> String {
    format!("{PREFIX}{number:08}{SUFFIX}")
}

/// Numbers and lengths of the segments, oldest first; none without a folder.
pub(super) fn segments(folder: &Path) -> Result<Vec<(u64, u64)>, DownlinkError> {
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

/// Writes lines of text, followed by a line with their checksum.
pub(super) fn write_sealed(path: &Path, text: String) -> io::Result<()> {
    // A missing folder is not created again, as its disk may return.
    if path.parent().is_some_and(|folder| !folder.is_dir()) {
        return Err(io::ErrorKind::NotFound.into());
    }
    let sum = checksum(CrcAlgorithm::Crc64Nvme, text.as_bytes());
    write_atomically(path, format!("{text}checksum {sum:016x}\n").as_bytes())
}

/// Reads the numbers in the lines of a file with a checksum; `None` if the checksum is wrong.
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

/// Reads the marks. Damaged marks are ignored, so that more packets than necessary are read.
pub(super) fn read_marks(folder: &Path) -> BTreeMap<u64, ArchivePosition> {
    let lines = read_sealed(&folder.join(MARKS)).ok().flatten().unwrap_or_default();
    let mark = |line: &Vec<u64>| match line[..] {
        [number, segment, offset] => Some((number, ArchivePosition { segment, offset })),
        _ => None,
    };
    lines.iter().filter_map(mark).collect()
}

/// Reads the list of retracted packets.
pub(super) fn read_retracted(folder: &Path) -> Result<BTreeMap<PacketName, ArchivePosition>, DownlinkError> {
    let path = folder.join(RETRACTED);
    let read = read_sealed(&path).and_then(|lines| {
        let reason = "its checksum is wrong, and without the list retracted packets would return; restore the file, or remove \
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
