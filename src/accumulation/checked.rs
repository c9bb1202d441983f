//! What checkpoints are made of: a head, raw little-endian numbers, and a checksum over all of it.

use std::io::{Read, Write};

use bincode::config::{Configuration, Fixint, Limit, LittleEndian};

use super::error::AccumulationError;
use crate::frames::AntennaResponse;

/// Greatest head that is read: real ones take some 100 bytes.
const HEAD_BYTES_MAX: usize = 4096;

const CODEC: Configuration<LittleEndian, Fixint, Limit<HEAD_BYTES_MAX>> =
    bincode::config::standard().with_little_endian().with_fixed_int_encoding().with_limit::<HEAD_BYTES_MAX>();

/// Numbers of variants on disk: never to be renumbered.
pub(super) const RESPONSES: [AntennaResponse; 2] =
    [AntennaResponse::Isotropic, AntennaResponse::DipoleNormal];

pub(super) fn number_of<T: PartialEq>(variants: &[T], variant: &T) -> u8 {
    variants.iter().position(|v| v == variant).map_or(u8::MAX, |k| k as u8)
}

pub(super) fn refused(found: String, expected: &'static str) -> AccumulationError {
    AccumulationError::Checkpoint { found, expected }
}

/// Writes and sums up.
pub(super) struct Summed<'a> {
    inner: &'a mut dyn Write,
    crc: crc_fast::Digest,
}

impl<'a> Summed<'a> {
    pub(super) fn new(inner: &'a mut dyn Write) -> Self {
        Self { inner, crc: crc_fast::Digest::new(crc_fast::CrcAlgorithm::Crc32Iscsi) }
    }

    pub(super) fn write(&mut self, bytes: &[u8]) -> std::io::Result<()> {
        self.crc.update(bytes);
        self.inner.write_all(bytes)
    }

    /// A head with its length.
    pub(super) fn head(&mut self, head: impl bincode::Encode) -> Result<(), AccumulationError> {
        let head = bincode::encode_to_vec(head, CODEC)
            .map_err(|error| refused(error.to_string(), "a head that can be encoded"))?;
        self.write(&(head.len() as u32).to_le_bytes())?;
        Ok(self.write(&head)?)
    }

    /// Integers, little-endian.
    pub(super) fn integers<T: Copy, const N: usize>(
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

    /// The checksum.
    pub(super) fn finish(self) -> std::io::Result<()> {
        let crc = self.crc.finalize() as u32;
        self.inner.write_all(&crc.to_le_bytes())
    }
}

/// Reads and sums up.
pub(super) struct Checked<'a> {
    inner: &'a mut dyn Read,
    crc: crc_fast::Digest,
}

impl<'a> Checked<'a> {
    pub(super) fn new(inner: &'a mut dyn Read) -> Self {
        Self { inner, crc: crc_fast::Digest::new(crc_fast::CrcAlgorithm::Crc32Iscsi) }
    }

    pub(super) fn read(&mut self, bytes: &mut [u8]) -> std::io::Result<()> {
        self.inner.read_exact(bytes)?;
        self.crc.update(bytes);
        Ok(())
    }

    pub(super) fn head<T: bincode::Decode<()>>(&mut self) -> Result<T, AccumulationError> {
        let mut length = [0; 4];
        self.read(&mut length)?;
        let length = u32::from_le_bytes(length) as usize;
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

    /// Integers, little-endian.
    pub(super) fn integers<T, const N: usize>(
        &mut self,
        values: &mut [T],
        of_bytes: impl Fn([u8; N]) -> T,
    ) -> std::io::Result<()> {
        for values in values.chunks_mut(1 << 16) {
            let mut bytes = vec![0; N * values.len()];
            self.read(&mut bytes)?;
            for (value, bytes) in values.iter_mut().zip(bytes.as_chunks::<N>().0) {
                *value = of_bytes(*bytes);
            }
        }
        Ok(())
    }

    /// Compares the checksum.
    pub(super) fn finish(self) -> Result<(), AccumulationError> {
        let found = self.crc.finalize() as u32;
        let mut stored = [0; 4];
        self.inner.read_exact(&mut stored)?;
        if found != u32::from_le_bytes(stored) {
            return Err(refused(format!("checksum {found:08x}"), "the checksum that it was written with"));
        }
        Ok(())
    }
}
