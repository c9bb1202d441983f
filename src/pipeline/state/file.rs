//! Checkpoints, written and read.

use std::fs::File;
use std::io::{BufReader, Read, Seek, SeekFrom, Write};
use std::path::Path;

use bincode::{Decode, Encode};
use crc_fast::{CrcAlgorithm, Digest};

use super::error::StateError;
use super::journal::JournalEntry;
use crate::accumulation::AccumulatorState;
use crate::calibration::CalibratorState;
use crate::downlink::CollectorState;
use crate::runtime::LedgerReport;

const MAGIC: &[u8; 8] = b"LNRSTA01";
/// Bytes of magic, length of the head, and checksum.
const FIXED_BYTES: u64 = 24;

/// Bytes read at a time.
const PIECE_BYTES: u64 = 1 << 20;

/// Greatest head that is read.
const HEAD_BYTES_MAX: usize = 1 << 32;

/// A checkpoint without its engines.
#[derive(Clone, Debug, PartialEq, Encode, Decode)]
pub(super) struct Head {
    /// Keys and values of the settings that shape sums.
    pub(super) settings: Vec<(String, String)>,
    pub(super) collector: CollectorState,
    pub(super) calibrator: CalibratorState,
    pub(super) accumulator: AccumulatorState,
    pub(super) ledger: LedgerReport,
    pub(super) journal: Vec<JournalEntry>,
}

/// Sums up what is written.
struct Summed<'a, W> {
    inner: &'a mut W,
    crc: Digest,
}

impl<W: Write> Write for Summed<'_, W> {
    fn write(&mut self, bytes: &[u8]) -> std::io::Result<usize> {
        let written = self.inner.write(bytes)?;
        self.crc.update(&bytes[..written]);
        Ok(written)
    }

    fn flush(&mut self) -> std::io::Result<()> {
        self.inner.flush()
    }
}

/// Writes a checkpoint whose engines `engines` writes.
pub(super) fn write(
    out: &mut impl Write,
    path: &Path,
    head: &Head,
    engines: impl FnOnce(&mut dyn Write) -> Result<(), StateError>,
) -> Result<(), StateError> {
    let failed = || StateError::io(path, "write");
    let damaged = |found: String| StateError::Damaged {
        path: path.to_owned(),
        found,
        expected: "a state that can be written",
    };
    let config = bincode::config::standard();
    let head = bincode::encode_to_vec(head, config).map_err(|error| damaged(error.to_string()))?;
    let mut summed = Summed { inner: out, crc: Digest::new(CrcAlgorithm::Crc64Nvme) };
    summed.write_all(MAGIC).map_err(failed())?;
    summed.write_all(&(head.len() as u64).to_le_bytes()).map_err(failed())?;
    summed.write_all(&head).map_err(failed())?;
    engines(&mut summed)?;
    let crc = summed.crc.finalize();
    out.write_all(&crc.to_le_bytes()).map_err(failed())
}

/// Whether a file begins as a checkpoint does.
pub(super) fn is_checkpoint(path: &Path) -> Result<bool, StateError> {
    let mut magic = Vec::new();
    let file = File::open(path).map_err(StateError::io(path, "open the file"))?;
    file.take(MAGIC.len() as u64).read_to_end(&mut magic).map_err(StateError::io(path, "read"))?;
    Ok(magic == MAGIC)
}

/// Reads a checkpoint; `rest` makes something of the head and the engines.
pub(super) fn read<T>(
    path: &Path,
    rest: impl FnOnce(Head, &mut dyn Read) -> Result<T, StateError>,
) -> Result<T, StateError> {
    read_from(&mut File::open(path).map_err(StateError::io(path, "read"))?, path, rest)
}

/// Reads a checkpoint from anything; messages call it `path`.
///
/// The checksum is compared before anything is believed.
pub(super) fn read_from<T>(
    from: &mut (impl Read + Seek),
    path: &Path,
    rest: impl FnOnce(Head, &mut dyn Read) -> Result<T, StateError>,
) -> Result<T, StateError> {
    let failed = || StateError::io(path, "read");
    let damaged = |found: String, expected| StateError::Damaged { path: path.to_owned(), found, expected };
    let bytes = checked_length(from, path)?;
    from.rewind().map_err(failed())?;
    let mut from = BufReader::with_capacity(bytes.min(PIECE_BYTES) as usize, from);
    let mut fixed = [0; 16];
    from.read_exact(&mut fixed).map_err(failed())?;
    let (magic, length) = fixed.split_at(8);
    if magic != MAGIC {
        return Err(damaged(format!("{magic:02x?}"), "a checkpoint of the ground's state, version 01"));
    }
    let length = length.first_chunk().map_or(0, |length| u64::from_le_bytes(*length));
    if length > bytes - FIXED_BYTES {
        return Err(damaged(format!("a head of {length} bytes"), "one that the file has room for"));
    }
    let mut head = vec![0; length as usize];
    from.read_exact(&mut head).map_err(failed())?;
    // Lengths that a forger claims are held against it.
    let config = bincode::config::standard().with_limit::<HEAD_BYTES_MAX>();
    let (head, used) = bincode::decode_from_slice::<Head, _>(&head, config)
        .map_err(|error| damaged(error.to_string(), "a head"))?;
    if used as u64 != length {
        return Err(damaged("bytes behind the head".into(), "none"));
    }
    let mut engines = from.take(bytes - FIXED_BYTES - length);
    let found = rest(head, &mut engines)?;
    match engines.limit() {
        0 => Ok(found),
        left => Err(damaged(format!("{left} bytes behind the engines"), "none")),
    }
}

/// Length of a checkpoint whose checksum holds.
fn checked_length(from: &mut (impl Read + Seek), path: &Path) -> Result<u64, StateError> {
    let failed = || StateError::io(path, "read");
    let damaged = |found: String, expected| StateError::Damaged { path: path.to_owned(), found, expected };
    let bytes = from.seek(SeekFrom::End(0)).map_err(failed())?;
    if bytes < FIXED_BYTES {
        return Err(damaged(format!("{bytes} bytes"), "at least 24"));
    }
    from.rewind().map_err(failed())?;
    let mut body = from.by_ref().take(bytes - 8);
    let mut crc = Digest::new(CrcAlgorithm::Crc64Nvme);
    let mut chunk = vec![0; bytes.min(PIECE_BYTES) as usize];
    loop {
        match body.read(&mut chunk).map_err(failed())? {
            0 => break,
            read => crc.update(&chunk[..read]),
        }
    }
    let mut stored = [0; 8];
    from.read_exact(&mut stored).map_err(failed())?;
    let found = crc.finalize();
    if found != u64::from_le_bytes(stored) {
        return Err(damaged(format!("checksum {found:016x}"), "the checksum that it was written with"));
    }
    Ok(bytes)
}
