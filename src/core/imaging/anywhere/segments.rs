//! Archived visibilities on disk, as segments that a checkpoint names.
//!
//! | field of a segment | bytes |
//! |---|---|
//! | magic, `LNRHELD2` | 8 |
//! | visibilities, u64 | 8 |
//! | each: pair i and j (u8), sub-band (u16), time (s), positions of i and j (m), value (K sr) and weight ((K sr)^-2), f64; integration time (s), f32 | 88 |
//! | CRC-64/NVME of all before | 8 |
//!
//! Numbers are little-endian. Each segment is stored in two identical files; a damaged one is restored from the other when it is read.
//!
//! Segments are never changed, so that a checkpoint of gigabytes writes only new visibilities. Short segments are merged with the
//! following ones, so that each is at least twice as long as all after it. There are thus at most some thirty segments, and each visibility
//! is written at most as many times.

use std::fs::File;
use std::io::{ErrorKind, Read, Write};
use std::path::{Path, PathBuf};

use crc_fast::{CrcAlgorithm, Digest};
use num_complex::Complex64;

use super::archived::ArchivedVisibility;
use crate::files::{AtomicFile, IfUnfinished};
use crate::imaging::AccumulationError;
use crate::response::general::TimedPair;
use crate::units::{ChannelId, Pair};

/// Bytes of a visibility on disk.
pub const ARCHIVED_BYTES: u64 = 88;

const MAGIC: &[u8; 8] = b"LNRHELD2";
const MAGIC_OF_VERSION_1: &[u8; 8] = b"LNRHELD1";
/// Bytes of magic, count and checksum.
const FIXED_BYTES: u64 = 24;
/// Visibilities that are written or read at a time.
const CHUNK: usize = 1 << 14;
/// Maximum number of segments of a checkpoint: lengths double, so a 64-bit count cannot reach it.
pub(in crate::imaging) const SEGMENTS_MAX: usize = 64;

/// The folder of a checkpoint, and the number of the checkpoint, which names the segments that are written with it.
#[derive(Clone, Copy, Debug)]
pub struct SegmentFolder<'a> {
    /// The folder.
    pub folder: &'a Path,
    /// Number of the checkpoint.
    pub number: u64,
}

/// A segment as a checkpoint names it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ArchiveSegment {
    /// Channel.
    pub channel: ChannelId,
    /// Number of the checkpoint with which it was written.
    pub number: u64,
    /// Number of visibilities.
    pub visibilities: u64,
    /// CRC-64 of its bytes.
    pub checksum: u64,
}

impl ArchiveSegment {
    /// Name of its first file.
    #[must_use]
    pub fn file_name(&self) -> String {
        format!("visibilities-{:08}-{:04}.segment", self.number, self.channel.0)
    }

    /// Name of its second file.
    fn copy_name(&self) -> String {
        format!("visibilities-{:08}-{:04}.copy.segment", self.number, self.channel.0)
    }

    /// Names of both files.
    #[must_use]
    pub fn file_names(&self) -> [String; 2] {
        [self.file_name(), self.copy_name()]
    }

    /// Whether a file has the name of a segment.
    #[must_use]
    pub fn is_name(name: &str) -> bool {
        name.starts_with("visibilities-") && name.ends_with(".segment")
    }

    /// Writes visibilities as a segment, which is durable on disk when this returns.
    pub(in crate::imaging) fn write(
        folder: SegmentFolder<'_>,
        channel: ChannelId,
        held: &[ArchivedVisibility],
    ) -> Result<Self, AccumulationError> {
        let (visibilities, number) = (held.len() as u64, folder.number);
        let mut segment = Self { channel, number, visibilities, checksum: 0 };
        for name in segment.file_names() {
            segment.checksum = segment.write_file(&folder.folder.join(name), held)?;
        }
        Ok(segment)
    }

    /// Writes one of the two files; returns its checksum.
    fn write_file(&self, path: &Path, held: &[ArchivedVisibility]) -> Result<u64, AccumulationError> {
        let mut file = AtomicFile::create(path, IfUnfinished::Remove)?;
        let mut crc = Digest::new(CrcAlgorithm::Crc64Nvme);
        let mut put = |bytes: &[u8]| {
            crc.update(bytes);
            file.write_all(bytes)
        };
        put(MAGIC)?;
        put(&self.visibilities.to_le_bytes())?;
        for piece in held.chunks(CHUNK) {
            put(&piece.iter().flat_map(encode).collect::<Vec<u8>>())?;
        }
        let checksum = crc.finalize();
        file.write_all(&checksum.to_le_bytes())?;
        file.finish()?;
        Ok(checksum)
    }

    /// Reads the visibilities in `folder` and passes them to `take` in chunks, so that a forged count takes no memory.
    pub(in crate::imaging) fn read(
        &self,
        folder: &Path,
        take: &mut dyn FnMut(&mut dyn Iterator<Item = ArchivedVisibility>),
    ) -> Result<(), AccumulationError> {
        // The whole file is verified before anything is passed on.
        let path = self.intact_file(folder)?;
        self.read_file(&path, take)
    }

    /// The path of an intact file. A damaged first file is restored from the second.
    fn intact_file(&self, folder: &Path) -> Result<PathBuf, AccumulationError> {
        let [first, second] = self.file_names().map(|name| folder.join(name));
        let verify = |path: &Path| self.read_file(path, &mut |piece| piece.for_each(drop));
        let error = match verify(&first) {
            Ok(()) => return Ok(first),
            Err(error @ AccumulationError::Segment { .. }) => error,
            Err(error) => return Err(error),
        };
        // Segments of earlier versions have one file.
        if verify(&second).is_err() {
            return Err(error);
        }
        // If restoring fails, the second file is used.
        let _ = restore(&second, &first);
        Ok(second)
    }

    /// Reads one of the files.
    fn read_file(
        &self,
        path: &Path,
        take: &mut dyn FnMut(&mut dyn Iterator<Item = ArchivedVisibility>),
    ) -> Result<(), AccumulationError> {
        let damaged = |found: String| AccumulationError::Segment { path: path.to_owned(), found };
        let mut file = File::open(path).map_err(|error| match error.kind() {
            ErrorKind::NotFound => damaged("no such file".into()),
            _ => error.into(),
        })?;
        let (bytes, expected) = (file.metadata()?.len(), self.bytes());
        let mut head = [0; 16];
        if bytes >= FIXED_BYTES {
            file.read_exact(&mut head)?;
        }
        if head.starts_with(MAGIC_OF_VERSION_1) {
            let found = "visibilities without the length of their integrations, of an earlier version: replay their files into a new folder";
            return Err(damaged(found.into()));
        }
        if Some(bytes) != expected {
            return Err(damaged(format!("{bytes} bytes")));
        }
        let mut crc = Digest::new(CrcAlgorithm::Crc64Nvme);
        crc.update(&head);
        if head[..8] != *MAGIC || head[8..] != self.visibilities.to_le_bytes() {
            return Err(damaged("another header".into()));
        }
        let mut left = self.visibilities;
        while left > 0 {
            let count = left.min(CHUNK as u64);
            let mut piece = vec![0; (count * ARCHIVED_BYTES) as usize];
            file.read_exact(&mut piece)?;
            crc.update(&piece);
            take(&mut piece.as_chunks::<{ ARCHIVED_BYTES as usize }>().0.iter().map(decode));
            left -= count;
        }
        let mut stored = [0; 8];
        file.read_exact(&mut stored)?;
        let found = crc.finalize();
        if found != self.checksum || stored != found.to_le_bytes() {
            return Err(damaged(format!("checksum {found:016x}")));
        }
        Ok(())
    }

    /// Requires that at least one file of the segment in `folder` is intact.
    ///
    /// # Errors
    /// [`AccumulationError::Segment`], or the system's.
    pub fn verify(&self, folder: &Path) -> Result<(), AccumulationError> {
        self.intact_file(folder).map(drop)
    }

    /// The path of its first file.
    #[must_use]
    pub fn path(&self, folder: &Path) -> PathBuf {
        folder.join(self.file_name())
    }

    /// Length of the file; `None` for an impossible count.
    fn bytes(&self) -> Option<u64> {
        self.visibilities.checked_mul(ARCHIVED_BYTES)?.checked_add(FIXED_BYTES)
    }
}

/// Restores a file from its copy.
fn restore(from: &Path, to: &Path) -> std::io::Result<()> {
    let mut file = AtomicFile::create(to, IfUnfinished::Remove)?;
    std::io::copy(&mut File::open(from)?, &mut file)?;
    file.finish().map(drop)
}

fn encode(held: &ArchivedVisibility) -> [u8; ARCHIVED_BYTES as usize] {
    let ArchivedVisibility { at, band, value_k_sr: value, weight, duration_s } = held;
    let ([a, b, c], [d, e, f]) = (at.r_i_m, at.r_j_m);
    let mut bytes = [0; ARCHIVED_BYTES as usize];
    (bytes[0], bytes[1]) = (at.pair.i, at.pair.j);
    bytes[2..4].copy_from_slice(&band.to_le_bytes());
    let numbers = [at.time_s, a, b, c, d, e, f, value.re, value.im, *weight];
    for (field, number) in bytes[4..].as_chunks_mut::<8>().0.iter_mut().zip(numbers) {
        *field = number.to_le_bytes();
    }
    bytes[84..].copy_from_slice(&duration_s.to_le_bytes());
    bytes
}

fn decode(bytes: &[u8; ARCHIVED_BYTES as usize]) -> ArchivedVisibility {
    let mut numbers = [0.0; 10];
    for (number, bytes) in numbers.iter_mut().zip(bytes[4..].as_chunks::<8>().0) {
        *number = f64::from_le_bytes(*bytes);
    }
    let [time_s, a, b, c, d, e, f, re, im, weight] = numbers;
    let pair = Pair { i: bytes[0], j: bytes[1] };
    ArchivedVisibility {
        at: TimedPair { pair, time_s, r_i_m: [a, b, c], r_j_m: [d, e, f] },
        band: u16::from_le_bytes([bytes[2], bytes[3]]),
        value_k_sr: Complex64::new(re, im),
        weight,
        duration_s: f32::from_le_bytes([bytes[84], bytes[85], bytes[86], bytes[87]]),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn visibilities(count: usize) -> Vec<ArchivedVisibility> {
        let one = |k: usize| {
            let x = k as f64 + 0.25;
            ArchivedVisibility {
                at: TimedPair {
                    pair: Pair { i: 1, j: 2 + (k % 5) as u8 },
                    time_s: x,
                    r_i_m: [x, -x, 1e-300],
                    r_j_m: [0.1 * x, 2e6, -0.0],
                },
                band: k as u16,
                value_k_sr: Complex64::new(-x, 1.0 / x),
                weight: 1e-8 / x,
                duration_s: k as f32,
            }
        };
        (0..count).map(one).collect()
    }

    fn read(segment: &ArchiveSegment, folder: &Path) -> Result<Vec<ArchivedVisibility>, AccumulationError> {
        let mut found = Vec::new();
        segment.read(folder, &mut |piece| found.extend(piece)).map(|()| found)
    }

    #[test]
    fn a_segment_is_read_again_and_any_damage_is_found() {
        let folder = tempfile::tempdir().unwrap();
        let segment_folder = SegmentFolder { folder: folder.path(), number: 7 };
        for count in [1, 3, CHUNK + 1] {
            let all = visibilities(count);
            let segment = ArchiveSegment::write(segment_folder, ChannelId(2), &all).unwrap();
            assert_eq!(segment.file_name(), "visibilities-00000007-0002.segment");
            assert_eq!(read(&segment, folder.path()).unwrap(), all);
        }
        let segment = ArchiveSegment::write(segment_folder, ChannelId(2), &visibilities(3)).unwrap();
        let path = segment.path(folder.path());
        let copy = folder.path().join(segment.copy_name());
        // While one file is intact, nothing is lost, and the other is restored.
        let whole = std::fs::read(&path).unwrap();
        for at in (0..whole.len()).step_by(17) {
            for file in [&path, &copy] {
                let mut bad = whole.clone();
                bad[at] ^= 1;
                std::fs::write(file, bad).unwrap();
                assert_eq!(read(&segment, folder.path()).unwrap(), visibilities(3));
                assert_eq!(std::fs::read(&path).unwrap(), whole);
            }
            std::fs::write(&copy, &whole).unwrap();
        }
        std::fs::remove_file(&path).unwrap();
        assert_eq!(read(&segment, folder.path()).unwrap(), visibilities(3));
        // Without the copy all damage is found.
        std::fs::remove_file(&copy).unwrap();
        let good = std::fs::read(&path).unwrap();
        assert_eq!(good.len() as u64, 3 * ARCHIVED_BYTES + FIXED_BYTES);
        let assert_damaged = || {
            let error = segment.verify(folder.path()).unwrap_err();
            assert!(matches!(error, AccumulationError::Segment { .. }), "{error}");
        };
        for at in 0..good.len() {
            let mut bad = good.clone();
            bad[at] ^= 0x11;
            std::fs::write(&path, bad).unwrap();
            assert_damaged();
            std::fs::write(&path, &good[..at]).unwrap();
            assert_damaged();
        }
        let mut earlier = good.clone();
        earlier[..8].copy_from_slice(MAGIC_OF_VERSION_1);
        std::fs::write(&path, &earlier[..good.len() - 12]).unwrap();
        let message = segment.verify(folder.path()).unwrap_err().to_string();
        assert!(message.contains("replay their files into a new folder"), "{message}");
        // An intact segment of the same length with other content is not the one that was named.
        ArchiveSegment::write(segment_folder, ChannelId(2), &visibilities(4)[1..]).unwrap();
        assert_damaged();
        std::fs::remove_file(&copy).unwrap();
        std::fs::remove_file(&path).unwrap();
        assert_damaged();
        // A forged count costs nothing.
        ArchiveSegment::write(segment_folder, ChannelId(2), &visibilities(3)).unwrap();
        for visibilities in [0, u64::MAX, u64::MAX / ARCHIVED_BYTES] {
            assert!(ArchiveSegment { visibilities, ..segment }.verify(folder.path()).is_err());
        }
    }
}
