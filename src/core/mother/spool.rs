//! Spool files: visibilities of a group of channels on disk, window by window. A simulation of more channels than fit
//! into memory writes one for each group, and [`Merger`](super::Merger) combines them.
//!
//! | field | bytes |
//! |---|---|
//! | magic, `LNRSPOOL` | 8 |
//! | version, u16 | 2 |
//! | key of the inputs, u64 | 8 |
//! | for each window: length u32, blocks, CRC-32C u32 | variable |
//!
//! A block: channel u16, pair 2 u8, start i64, number of visibilities u32, and for each of them: offset u32, duration
//! u32, real and imaginary part f32, weight f32, flags u8. All numbers are little-endian. A file gets its final name
//! once it is complete.

use std::fs::File;
use std::io::{self, BufReader, Read, Write};
use std::path::{Path, PathBuf};

use crc_fast::{CrcAlgorithm, checksum};
use num_complex::Complex32;
use thiserror::Error;

use crate::files::{AtomicFile, IfUnfinished};
use crate::frames::{Flags, GroundFrame, VisibilityBlock};
use crate::runtime::{Sink, Units};
use crate::units::{ChannelId, MissionTime, Pair};

const MAGIC: &[u8; 8] = b"LNRSPOOL";
const VERSION: u16 = 1;
/// Size of a block's header before the number of its visibilities, bytes.
const BLOCK_HEAD: usize = 12;
/// Size of a visibility, bytes.
const VISIBILITY: usize = 21;

/// Error of a spool file.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum SpoolError {
    /// The file cannot be accessed.
    #[error("{}: {source}", path.display())]
    File {
        /// The file.
        path: PathBuf,
        /// Error of the operating system.
        source: io::Error,
    },
    /// The bytes are not those that were written.
    #[error("{}: damaged at byte {at}: {found}; expected {expected}. Remove the file and repeat the command", path.display())]
    Damaged {
        /// The file.
        path: PathBuf,
        /// Position, bytes.
        at: u64,
        /// What was found.
        found: String,
        /// What was expected.
        expected: &'static str,
    },
}

/// Writes the visibilities of frames; a housekeeping frame ends a window.
#[derive(Debug)]
pub struct SpoolWriter {
    path: PathBuf,
    /// `None` once finished.
    file: Option<AtomicFile>,
    /// Number of windows still to be written.
    left: usize,
    window: Vec<u8>,
    written: u64,
}

impl SpoolWriter {
    /// Creates a file for the visibilities of `windows` windows, with this key. It gets its name once it is complete.
    ///
    /// # Errors
    /// The file cannot be created.
    pub fn create(path: &Path, key: u64, windows: usize) -> Result<Self, SpoolError> {
        let failed = |source| SpoolError::File { path: path.to_owned(), source };
        let mut file = AtomicFile::create(path, IfUnfinished::Remove).map_err(failed)?;
        let head = [MAGIC.as_slice(), &VERSION.to_le_bytes(), &key.to_le_bytes()].concat();
        file.write_all(&head).map_err(failed)?;
        Ok(Self { path: path.to_owned(), file: Some(file), left: windows, window: Vec::new(), written: 0 })
    }

    fn put(&mut self, block: &VisibilityBlock) {
        let out = &mut self.window;
        out.extend(block.channel.0.to_le_bytes());
        out.extend([block.pair.i, block.pair.j]);
        out.extend(block.start.0.to_le_bytes());
        // A window has far fewer visibilities.
        out.extend((block.len() as u32).to_le_bytes());
        out.extend(block.offset_ticks.iter().flat_map(|x| x.to_le_bytes()));
        out.extend(block.duration_ticks.iter().flat_map(|x| x.to_le_bytes()));
        out.extend(block.value_k_sr.iter().flat_map(|x| [x.re, x.im]).flat_map(f32::to_le_bytes));
        out.extend(block.weight.iter().flat_map(|x| x.to_le_bytes()));
        out.extend(block.flags.iter().map(|flags| flags.0));
        self.written += block.len() as u64;
    }

    fn end_window(&mut self) -> Result<(), SpoolError> {
        let Some(file) = &mut self.file else { return Ok(()) };
        let crc = checksum(CrcAlgorithm::Crc32Iscsi, &self.window) as u32;
        let length =
            u32::try_from(self.window.len()).map_err(|_| io::Error::from(io::ErrorKind::FileTooLarge));
        let written = length.and_then(|length| {
            file.write_all(&length.to_le_bytes())?;
            file.write_all(&self.window)?;
            file.write_all(&crc.to_le_bytes())
        });
        self.window.clear();
        self.left = self.left.saturating_sub(1);
        written.map_err(|source| SpoolError::File { path: self.path.clone(), source })
    }
}

impl Sink for SpoolWriter {
    type In = GroundFrame;
    type Error = SpoolError;

    fn take(&mut self, frame: GroundFrame) -> Result<(), SpoolError> {
        match frame {
            GroundFrame::Visibilities(block) => self.put(&block),
            GroundFrame::Housekeeping(_) => self.end_window()?,
            // The merger makes these frames itself.
            GroundFrame::Instrument(_) | GroundFrame::Ephemeris(_) => {}
        }
        Ok(())
    }

    fn finish(&mut self) -> Result<(), SpoolError> {
        // An incomplete file of a cancelled run is removed.
        let Some(file) = self.file.take().filter(|_| self.left == 0) else { return Ok(()) };
        let finished = file.finish();
        finished.map(drop).map_err(|source| SpoolError::File { path: self.path.clone(), source })
    }

    fn units(&self) -> Units {
        Units::of(self.written, "visibilities")
    }
}

/// Reads back what a [`SpoolWriter`] wrote.
#[derive(Debug)]
pub struct SpoolReader {
    path: PathBuf,
    file: BufReader<File>,
    /// Bytes of the file, and those read.
    bytes: u64,
    at: u64,
}

impl SpoolReader {
    /// Opens a file whose key is `key`; `None` if there is no file, or if it has another key.
    ///
    /// # Errors
    /// A file that cannot be read.
    pub fn open(path: &Path, key: u64) -> Result<Option<Self>, SpoolError> {
        let failed = |source| SpoolError::File { path: path.to_owned(), source };
        let file = match File::open(path) {
            Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(None),
            file => file.map_err(failed)?,
        };
        let bytes = file.metadata().map_err(failed)?.len();
        let mut reader =
            Self { path: path.to_owned(), file: BufReader::with_capacity(1 << 20, file), bytes, at: 0 };
        let mut head = [0; 18];
        match reader.file.read_exact(&mut head) {
            Err(error) if error.kind() == io::ErrorKind::UnexpectedEof => return Ok(None),
            read => read.map_err(failed)?,
        }
        reader.at = head.len() as u64;
        let wanted = [MAGIC.as_slice(), &VERSION.to_le_bytes(), &key.to_le_bytes()].concat();
        Ok((head.as_slice() == wanted).then_some(reader))
    }

    /// The blocks of the next window.
    ///
    /// # Errors
    /// A file that cannot be read, is damaged, or ends.
    pub fn next_window(&mut self) -> Result<Vec<VisibilityBlock>, SpoolError> {
        let length = u32::from_le_bytes(self.take()?);
        if u64::from(length) + 4 > self.bytes - self.at {
            return Err(self.damaged(format!("a window of {length} bytes"), "one that the file holds"));
        }
        let mut window = vec![0; length as usize];
        self.fill(&mut window)?;
        let crc = u32::from_le_bytes(self.take()?);
        if crc != checksum(CrcAlgorithm::Crc32Iscsi, &window) as u32 {
            return Err(self.damaged("another checksum".into(), "that of the window's bytes"));
        }
        blocks(&window).ok_or_else(|| self.damaged("a window that is cut".into(), "whole blocks"))
    }

    fn take<const N: usize>(&mut self) -> Result<[u8; N], SpoolError> {
        let mut bytes = [0; N];
        self.fill(&mut bytes)?;
        Ok(bytes)
    }

    fn fill(&mut self, out: &mut [u8]) -> Result<(), SpoolError> {
        let read = self.file.read_exact(out);
        read.map_err(|source| SpoolError::File { path: self.path.clone(), source })?;
        self.at += out.len() as u64;
        Ok(())
    }

    fn damaged(&self, found: String, expected: &'static str) -> SpoolError {
        SpoolError::Damaged { path: self.path.clone(), at: self.at, found, expected }
    }
}

/// Parses the blocks of a window; `None` if the last one is incomplete.
fn blocks(mut rest: &[u8]) -> Option<Vec<VisibilityBlock>> {
    let mut found = Vec::new();
    while !rest.is_empty() {
        let head: [u8; BLOCK_HEAD] = part(&mut rest)?;
        let [c0, c1, i, j, start @ ..] = head;
        let count = u32::from_le_bytes(part(&mut rest)?) as usize;
        if rest.len() < count.checked_mul(VISIBILITY)? {
            return None;
        }
        let mut four = |n: usize| -> Vec<[u8; 4]> {
            let (these, after) = rest.split_at(4 * n);
            rest = after;
            these.as_chunks().0.to_vec()
        };
        let [offset_ticks, duration_ticks] =
            [0, 1].map(|_| four(count).into_iter().map(u32::from_le_bytes).collect::<Vec<u32>>());
        let values: Vec<f32> = four(2 * count).into_iter().map(f32::from_le_bytes).collect();
        let weight = four(count).into_iter().map(f32::from_le_bytes).collect();
        let (flags, after) = rest.split_at(count);
        rest = after;
        found.push(VisibilityBlock {
            channel: ChannelId(u16::from_le_bytes([c0, c1])),
            pair: Pair { i, j },
            start: MissionTime(i64::from_le_bytes(start)),
            offset_ticks,
            duration_ticks,
            value_k_sr: values.as_chunks().0.iter().map(|&[re, im]| Complex32::new(re, im)).collect(),
            weight,
            flags: flags.iter().copied().map(Flags).collect(),
        });
    }
    Some(found)
}

fn part<const N: usize>(rest: &mut &[u8]) -> Option<[u8; N]> {
    let (part, after) = rest.split_first_chunk()?;
    *rest = after;
    Some(*part)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::frames::Housekeeping;

    fn block(channel: u16, count: u32) -> VisibilityBlock {
        let numbers = || (0..count).map(|k| k as f32);
        VisibilityBlock {
            channel: ChannelId(channel),
            pair: Pair { i: 1, j: 5 },
            start: MissionTime(-77),
            offset_ticks: (0..count).map(|k| 1000 * k).collect(),
            duration_ticks: (0..count).map(|k| 3 + k).collect(),
            value_k_sr: numbers().map(|x| Complex32::new(x, -1.5 * x)).collect(),
            weight: numbers().map(|x| 1.0 / (1.0 + x)).collect(),
            flags: (0..count).map(|k| Flags(k as u8)).collect(),
        }
    }

    fn write(path: &Path, windows: &[Vec<VisibilityBlock>], promised: usize) {
        let mut writer = SpoolWriter::create(path, 5, promised).unwrap();
        for window in windows {
            for block in window {
                writer.take(GroundFrame::Visibilities(block.clone())).unwrap();
            }
            writer.take(GroundFrame::Housekeeping(Housekeeping::default())).unwrap();
        }
        writer.finish().unwrap();
    }

    #[test]
    fn windows_come_back_as_they_were() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("x.spool");
        let windows = [vec![block(0, 3), block(29, 0), block(7, 300)], Vec::new(), vec![block(1, 1)]];
        write(&path, &windows, 3);
        let mut reader = SpoolReader::open(&path, 5).unwrap().unwrap();
        for window in &windows {
            assert_eq!(&reader.next_window().unwrap(), window);
        }
        assert!(matches!(reader.next_window(), Err(SpoolError::File { .. })));
        // Made from something else, or not there.
        assert!(SpoolReader::open(&path, 6).unwrap().is_none());
        assert!(SpoolReader::open(&folder.path().join("y"), 5).unwrap().is_none());
    }

    #[test]
    fn what_lacks_windows_does_not_stay() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("x.spool");
        write(&path, &[vec![block(0, 3)]], 2);
        assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 0);
    }

    #[test]
    fn every_damaged_byte_is_found() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("x.spool");
        write(&path, &[vec![block(2, 2), block(3, 1)]], 1);
        let whole = std::fs::read(&path).unwrap();
        for at in 0..whole.len() {
            let mut bytes = whole.clone();
            bytes[at] ^= 0x11;
            std::fs::write(&path, &bytes).unwrap();
            let read = SpoolReader::open(&path, 5).unwrap().map(|mut reader| reader.next_window());
            assert!(read.is_none_or(|window| window.is_err()), "byte {at}");
            std::fs::write(&path, &whole[..at]).unwrap();
            let read = SpoolReader::open(&path, 5).unwrap().map(|mut reader| reader.next_window());
            assert!(read.is_none_or(|window| window.is_err()), "{at} bytes");
        }
    }
}
