//! Checkpoints of engines: one format for sums over any basis.
//!
//! | field | bytes |
//! |---|---|
//! | magic, `LNRENGIN` | 8 |
//! | version, u16 | 2 |
//! | kind of the basis, u8 | 1 |
//! | length of the head, u32 | 4 |
//! | head: setup and totals | at most 4096 |
//! | integers of the sums | as the basis writes them |
//! | CRC-32C of all before, u32 | 4 |
//!
//! Numbers are little-endian. The bytes depend only on which visibilities are in the sums, not on how they arrived.
//! Readers allocate memory for data that they have read, not for what a head announces.

use std::io::{Read, Write};

use bincode::config::{Configuration, Fixint, Limit, LittleEndian};

use crate::frames::AntennaResponse;
use crate::imaging::error::AccumulationError;

const MAGIC: &[u8; 8] = b"LNRENGIN";
const VERSION: u16 = 3;
const CURRENT: &str = "an engine's checkpoint, version 3: sum the data again";
/// Prefixes of the magics of earlier formats, one for each engine.
const EARLIER_MAGICS: [&[u8]; 2] = [b"LNRPIX", b"LNRHRM"];

/// The kind of sums in a checkpoint; the numbers must never change.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum BasisKind {
    /// Sums over pixels.
    Pixel = 1,
    /// Sums over spherical harmonics.
    Harmonic = 2,
    /// Individual visibilities.
    Archive = 3,
}

impl BasisKind {
    fn expected(self) -> &'static str {
        match self {
            Self::Pixel => "sums over pixels (kind 1)",
            Self::Harmonic => "sums over harmonics (kind 2)",
            Self::Archive => "visibilities held for refinement (kind 3)",
        }
    }
}

/// Maximum size of a head; real ones take some 100 bytes.
const HEAD_BYTES_MAX: usize = 4096;

const CODEC: Configuration<LittleEndian, Fixint, Limit<HEAD_BYTES_MAX>> =
    bincode::config::standard().with_little_endian().with_fixed_int_encoding().with_limit::<HEAD_BYTES_MAX>();

/// Antenna responses, numbered in checkpoints by their position; only append.
pub(in crate::imaging) const RESPONSES: [AntennaResponse; 3] =
    [AntennaResponse::Isotropic, AntennaResponse::DipoleNormal, AntennaResponse::ThreeDipoles];

/// The position of a variant, by which it is numbered in checkpoints.
pub(in crate::imaging) fn number_of<T: PartialEq>(variants: &[T], variant: &T) -> u8 {
    variants.iter().position(|v| v == variant).map_or(u8::MAX, |k| k as u8)
}

/// The error for a checkpoint that is not accepted.
pub(in crate::imaging) fn refused(found: String, expected: &'static str) -> AccumulationError {
    AccumulationError::Checkpoint { found, expected }
}

/// Writes a frame and its checksum.
pub struct FrameWriter<'a> {
    inner: &'a mut dyn Write,
    crc: crc_fast::Digest,
}

impl<'a> FrameWriter<'a> {
    /// Writes the start of a frame.
    pub(in crate::imaging) fn new(
        inner: &'a mut dyn Write,
        kind: BasisKind,
        head: impl bincode::Encode,
    ) -> Result<Self, AccumulationError> {
        let mut out = Self { inner, crc: crc_fast::Digest::new(crc_fast::CrcAlgorithm::Crc32Iscsi) };
        let head = bincode::encode_to_vec(head, CODEC)
            .map_err(|error| refused(error.to_string(), "a head that can be encoded"))?;
        out.write(MAGIC)?;
        out.write(&VERSION.to_le_bytes())?;
        out.write(&[kind as u8])?;
        out.write(&(head.len() as u32).to_le_bytes())?;
        out.write(&head)?;
        Ok(out)
    }

    pub(in crate::imaging) fn write(&mut self, bytes: &[u8]) -> std::io::Result<()> {
        self.crc.update(bytes);
        self.inner.write_all(bytes)
    }

    /// Writes integers by `to_bytes`.
    pub(in crate::imaging) fn integers<T: Copy, const N: usize>(
        &mut self,
        values: &[T],
        to_bytes: impl Fn(T) -> [u8; N],
    ) -> std::io::Result<()> {
        for values in values.chunks(1 << 16) {
            let bytes: Vec<u8> = values.iter().flat_map(|value| to_bytes(*value)).collect();
            self.write(&bytes)?;
        }
        Ok(())
    }

    /// Writes the checksum that ends the frame.
    pub(in crate::imaging) fn finish(self) -> std::io::Result<()> {
        let crc = self.crc.finalize() as u32;
        self.inner.write_all(&crc.to_le_bytes())
    }
}

/// Reads a frame and compares its checksum.
pub struct FrameReader<'a> {
    inner: &'a mut dyn Read,
    crc: crc_fast::Digest,
}

impl<'a> FrameReader<'a> {
    /// Reads the start of a frame of this kind, with its head.
    pub(in crate::imaging) fn new<H: bincode::Decode<()>>(
        inner: &'a mut dyn Read,
        kind: BasisKind,
    ) -> Result<(Self, H), AccumulationError> {
        let crc = crc_fast::Digest::new(crc_fast::CrcAlgorithm::Crc32Iscsi);
        let mut from = Self { inner, crc };
        let magic: [u8; 8] = from.array()?;
        if EARLIER_MAGICS.iter().any(|earlier| magic.starts_with(earlier)) {
            let found = format!("an engine of an earlier format ({})", magic.escape_ascii());
            return Err(refused(found, CURRENT));
        }
        if &magic != MAGIC {
            return Err(refused(format!("{magic:02x?}"), "an engine's checkpoint"));
        }
        let version = u16::from_le_bytes(from.array()?);
        if version != VERSION {
            return Err(refused(format!("version {version} of an engine's checkpoint"), CURRENT));
        }
        let [found] = from.array()?;
        if found != kind as u8 {
            return Err(refused(format!("sums of kind {found}"), kind.expected()));
        }
        let head = from.head()?;
        Ok((from, head))
    }

    fn array<const N: usize>(&mut self) -> std::io::Result<[u8; N]> {
        let mut bytes = [0; N];
        self.read(&mut bytes)?;
        Ok(bytes)
    }

    pub(in crate::imaging) fn read(&mut self, bytes: &mut [u8]) -> std::io::Result<()> {
        self.inner.read_exact(bytes)?;
        self.crc.update(bytes);
        Ok(())
    }

    fn head<H: bincode::Decode<()>>(&mut self) -> Result<H, AccumulationError> {
        let length = u32::from_le_bytes(self.array()?) as usize;
        if length > HEAD_BYTES_MAX {
            return Err(refused(format!("a head of {length} bytes"), "at most 4096"));
        }
        let mut bytes = vec![0; length];
        self.read(&mut bytes)?;
        match bincode::decode_from_slice(&bytes, CODEC) {
            Ok((head, used)) if used == length => Ok(head),
            Ok(_) => Err(refused("bytes behind the head".into(), "none")),
            Err(error) => Err(refused(error.to_string(), "a head")),
        }
    }

    /// Reads integers by `from_bytes`.
    pub(in crate::imaging) fn integers<T, const N: usize>(
        &mut self,
        values: &mut [T],
        from_bytes: impl Fn([u8; N]) -> T,
    ) -> std::io::Result<()> {
        for values in values.chunks_mut(1 << 16) {
            let mut bytes = vec![0; N * values.len()];
            self.read(&mut bytes)?;
            for (value, bytes) in values.iter_mut().zip(bytes.as_chunks::<N>().0) {
                *value = from_bytes(*bytes);
            }
        }
        Ok(())
    }

    /// Compares the checksum.
    pub(in crate::imaging) fn finish(self) -> Result<(), AccumulationError> {
        let found = self.crc.finalize() as u32;
        let mut stored = [0; 4];
        self.inner.read_exact(&mut stored)?;
        if found != u32::from_le_bytes(stored) {
            return Err(refused(format!("checksum {found:08x}"), "the checksum that it was written with"));
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::imaging::circle::HarmonicEngine;
    use crate::imaging::{NormalEngine, PixelEngine};

    /// A frame with this kind, version and magic, and zeros for content.
    fn frame(magic: &[u8; 8], version: u16, kind: u8) -> Vec<u8> {
        [magic.as_slice(), &version.to_le_bytes(), &[kind], &[0; 200]].concat()
    }

    fn refusal<E: NormalEngine>(bytes: &[u8]) -> String {
        match E::restore(&mut &bytes[..]) {
            Ok(_) => panic!("restored"),
            Err(error) => error.to_string(),
        }
    }

    #[test]
    fn earlier_formats_are_refused_by_name() {
        for magic in [b"LNRPIX01", b"LNRPIX02", b"LNRHRM02", b"LNRHRM03"] {
            let name = std::str::from_utf8(magic).unwrap();
            let bytes = frame(magic, 0, 0);
            for message in [refusal::<PixelEngine>(&bytes), refusal::<HarmonicEngine>(&bytes)] {
                assert!(message.contains(name) && message.contains("sum the data again"), "{message}");
            }
        }
    }

    #[test]
    fn other_magics_versions_and_kinds_are_refused() {
        for (bytes, expected) in [
            (frame(b"LNRSTA04", VERSION, 1), "expected an engine's checkpoint"),
            (frame(MAGIC, VERSION + 1, 1), "expected an engine's checkpoint, version 3"),
            (
                frame(MAGIC, 2, 1),
                "found version 2 of an engine's checkpoint, expected an engine's checkpoint, version 3: sum",
            ),
            (frame(MAGIC, VERSION, 2), "found sums of kind 2, expected sums over pixels"),
            (frame(MAGIC, VERSION, 3), "found sums of kind 3"),
        ] {
            let message = refusal::<PixelEngine>(&bytes);
            assert!(message.contains(expected), "{message}");
        }
        let message = refusal::<HarmonicEngine>(&frame(MAGIC, VERSION, 1));
        assert!(message.contains("found sums of kind 1, expected sums over harmonics"), "{message}");
    }

    #[test]
    fn a_head_is_bounded() {
        let mut bytes = frame(MAGIC, VERSION, 1);
        bytes[11..15].copy_from_slice(&4097_u32.to_le_bytes());
        assert!(refusal::<PixelEngine>(&bytes).contains("a head of 4097 bytes"));
    }
}
