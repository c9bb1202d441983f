//! Held visibilities on disk: segments beside a checkpoint, which names them.
//!
//! | field of a segment | bytes |
//! |---|---|
//! | magic, `LNRHELD2` | 8 |
//! | visibilities, u64 | 8 |
//! | each: pair i and j (u8), sub-band (u16), time (s), positions of i and j (m), value (K sr) and weight ((K sr)^-2), f64; length of the integration (s), f32 | 88 |
//! | CRC-64/NVME of all before | 8 |
//!
//! A segment is in two files of the same bytes, so that a damaged one loses nothing: it is written again from the other when it is read.
//!
//! All numbers are little-endian. A segment is written once and never changed: a checkpoint that keeps gigabytes of visibilities
//! writes those that are new. Small segments are written again as one with what follows them, so that each is at least twice as long
//! as all behind it: there are at most some thirty, and each visibility is written as often at most.

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

/// Bytes of a held visibility on disk.
pub const HELD_BYTES: u64 = 88;

const MAGIC: &[u8; 8] = b"LNRHELD2";
const EARLIER: &[u8; 8] = b"LNRHELD1";
/// Bytes of magic, count and checksum.
const FIXED_BYTES: u64 = 24;
/// Visibilities that are written or read at a time.
const PIECE: usize = 1 << 14;
/// Most segments of a checkpoint; those that are written are fewer than 64 bits of a count.
pub(in crate::imaging) const SEGMENTS_MAX: usize = 64;

/// The folder of a checkpoint, and its number, which stands in the names of the segments that are written with it.
#[derive(Clone, Copy, Debug)]
pub struct SegmentPlace<'a> {
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
    /// Number of the checkpoint that it was written with.
    pub number: u64,
    /// Visibilities in it.
    pub visibilities: u64,
    /// Its checksum.
    pub checksum: u64,
}

impl ArchiveSegment {
    /// Its file's name.
    #[must_use]
    pub fn file_name(&self) -> String {
        format!("visibilities-{:08}-{:04}.segment", self.number, self.channel.0)
    }

    /// Name of the second file.
    fn copy_name(&self) -> String {
        format!("visibilities-{:08}-{:04}.copy.segment", self.number, self.channel.0)
    }

    /// Names of both.
    #[must_use]
    pub fn file_names(&self) -> [String; 2] {
        [self.file_name(), self.copy_name()]
    }

    /// Whether a file may be a segment, by its name.
    #[must_use]
    pub fn is_name(name: &str) -> bool {
        name.starts_with("visibilities-") && name.ends_with(".segment")
    }

    /// Writes visibilities as a segment that is on disk, whole, when this returns.
    pub(in crate::imaging) fn write(
        place: SegmentPlace<'_>,
        channel: ChannelId,
        held: &[ArchivedVisibility],
    ) -> Result<Self, AccumulationError> {
        let (visibilities, number) = (held.len() as u64, place.number);
        let mut segment = Self { channel, number, visibilities, checksum: 0 };
        for name in segment.file_names() {
            segment.checksum = segment.write_file(&place.folder.join(name), held)?;
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
        for piece in held.chunks(PIECE) {
            put(&piece.iter().flat_map(record).collect::<Vec<u8>>())?;
        }
        let checksum = crc.finalize();
        file.write_all(&checksum.to_le_bytes())?;
        file.finish()?;
        Ok(checksum)
    }

    /// Reads the visibilities in `folder`, and hands them over piece by piece. Memory follows the bytes that are there.
    pub(in crate::imaging) fn read(
        &self,
        folder: &Path,
        take: &mut dyn FnMut(&mut dyn Iterator<Item = ArchivedVisibility>),
    ) -> Result<(), AccumulationError> {
        // Nothing is handed over before it is known to hold.
        let path = self.sound_file(folder)?;
        self.read_file(&path, take)
    }

    /// The first of the two files that holds. The other is written again from it, if that is possible.
    fn sound_file(&self, folder: &Path) -> Result<PathBuf, AccumulationError> {
        let [first, second] = self.file_names().map(|name| folder.join(name));
        let verify = |path: &Path| self.read_file(path, &mut |piece| piece.for_each(drop));
        let error = match verify(&first) {
            Ok(()) => return Ok(first),
            Err(error @ AccumulationError::Segment { .. }) => error,
            Err(error) => return Err(error),
        };
        // Of an earlier version there is one file.
        if verify(&second).is_err() {
            return Err(error);
        }
        // On a disk that cannot be written the second goes on to serve.
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
        if head.starts_with(EARLIER) {
            let found = "visibilities without the length of their integrations, of an earlier version: replay their files into a new folder";
            return Err(damaged(found.into()));
        }
        if Some(bytes) != expected {
            return Err(damaged(format!("{bytes} bytes")));
        }
        let mut crc = Digest::new(CrcAlgorithm::Crc64Nvme);
        crc.update(&head);
        if head[..8] != *MAGIC || head[8..] != self.visibilities.to_le_bytes() {
            return Err(damaged("another beginning".into()));
        }
        let mut left = self.visibilities;
        while left > 0 {
            let count = left.min(PIECE as u64);
            let mut piece = vec![0; (count * HELD_BYTES) as usize];
            file.read_exact(&mut piece)?;
            crc.update(&piece);
            take(&mut piece.as_chunks::<{ HELD_BYTES as usize }>().0.iter().map(held));
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

    /// Requires that the segment in `folder` holds, in one file at least.
    ///
    /// # Errors
    /// [`AccumulationError::Segment`], or the system's.
    pub fn verify(&self, folder: &Path) -> Result<(), AccumulationError> {
        self.sound_file(folder).map(drop)
    }

    /// Where it is.
    #[must_use]
    pub fn path(&self, folder: &Path) -> PathBuf {
        folder.join(self.file_name())
    }

    /// Length of the file; `None` for a count that none has.
    fn bytes(&self) -> Option<u64> {
        self.visibilities.checked_mul(HELD_BYTES)?.checked_add(FIXED_BYTES)
    }
}

/// Writes a file again from its copy.
fn restore(from: &Path, to: &Path) -> std::io::Result<()> {
    let mut file = AtomicFile::create(to, IfUnfinished::Remove)?;
    std::io::copy(&mut File::open(from)?, &mut file)?;
    file.finish().map(drop)
}

fn record(held: &ArchivedVisibility) -> [u8; HELD_BYTES as usize] {
    let ArchivedVisibility { at, band, value_k_sr: value, weight, duration_s } = held;
    let ([a, b, c], [d, e, f]) = (at.r_i_m, at.r_j_m);
    let mut bytes = [0; HELD_BYTES as usize];
    (bytes[0], bytes[1]) = (at.pair.i, at.pair.j);
    bytes[2..4].copy_from_slice(&band.to_le_bytes());
    let numbers = [at.time_s, a, b, c, d, e, f, value.re, value.im, *weight];
    for (place, number) in bytes[4..].as_chunks_mut::<8>().0.iter_mut().zip(numbers) {
        *place = number.to_le_bytes();
    }
    bytes[84..].copy_from_slice(&duration_s.to_le_bytes());
    bytes
}

fn held(bytes: &[u8; HELD_BYTES as usize]) -> ArchivedVisibility {
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
    fn a_segment_comes_back_and_damage_anywhere_is_found() {
        let folder = tempfile::tempdir().unwrap();
        let place = SegmentPlace { folder: folder.path(), number: 7 };
        for count in [1, 3, PIECE + 1] {
            let all = visibilities(count);
            let segment = ArchiveSegment::write(place, ChannelId(2), &all).unwrap();
            assert_eq!(segment.file_name(), "visibilities-00000007-0002.segment");
            assert_eq!(read(&segment, folder.path()).unwrap(), all);
        }
        let segment = ArchiveSegment::write(place, ChannelId(2), &visibilities(3)).unwrap();
        let path = segment.path(folder.path());
        let copy = folder.path().join(segment.copy_name());
        // While one file holds, nothing is lost, and the other is whole again.
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
        assert_eq!(good.len() as u64, 3 * HELD_BYTES + FIXED_BYTES);
        let is_told = || {
            let error = segment.verify(folder.path()).unwrap_err();
            assert!(matches!(error, AccumulationError::Segment { .. }), "{error}");
        };
        for at in 0..good.len() {
            let mut bad = good.clone();
            bad[at] ^= 0x11;
            std::fs::write(&path, bad).unwrap();
            is_told();
            std::fs::write(&path, &good[..at]).unwrap();
            is_told();
        }
        let mut earlier = good.clone();
        earlier[..8].copy_from_slice(EARLIER);
        std::fs::write(&path, &earlier[..good.len() - 12]).unwrap();
        let said = segment.verify(folder.path()).unwrap_err().to_string();
        assert!(said.contains("replay their files into a new folder"), "{said}");
        // Another one of the same length, which holds in itself, is not the one that was named.
        ArchiveSegment::write(place, ChannelId(2), &visibilities(4)[1..]).unwrap();
        is_told();
        std::fs::remove_file(&copy).unwrap();
        std::fs::remove_file(&path).unwrap();
        is_told();
        // A forged count costs nothing.
        ArchiveSegment::write(place, ChannelId(2), &visibilities(3)).unwrap();
        for visibilities in [0, u64::MAX, u64::MAX / HELD_BYTES] {
            assert!(ArchiveSegment { visibilities, ..segment }.verify(folder.path()).is_err());
        }
    }
}
