//! A downlink file as a source of bytes, unpacked if it is packed.

use std::fmt;
use std::fs::File;
use std::io::{self, BufRead, BufReader, Chain, Cursor, Read};
use std::path::Path;

use flate2::read::MultiGzDecoder;
use ruzstd::decoding::errors::{FrameDecoderError, ReadFrameHeaderError};
use ruzstd::decoding::{BlockDecodingStrategy, FrameDecoder};

use crate::downlink::error::{DownlinkError, io_error};

/// First bytes of gzip and zstd files.
const GZIP: &[u8] = b"\x1f\x8b";
const ZSTD: &[u8] = b"\x28\xb5\x2f\xfd";
/// Memory for the history of a zstd file, bytes: that of its own program.
const WINDOW_BYTES_MAX: u64 = 1 << 27;
/// A file may unpack to so many times its size, and so many bytes more: visibilities are noise, which packs to little less.
const UNPACKED_TIMES_MAX: u64 = 256;
const UNPACKED_BYTES_MORE: u64 = 1 << 26;

/// A downlink file as it was received, or packed by gzip or zstd, which its first bytes tell.
///
/// Unpacks as it is read, in bounded memory.
pub struct DownlinkFile {
    content: Content,
    unpacked: u64,
}

enum Content {
    Plain(Chain<Cursor<Vec<u8>>, File>),
    Gzip(Box<MultiGzDecoder<PackedBytes>>),
    Zstd(Box<ZstdFrames>),
}

/// The bytes of a packed file, counted.
struct PackedBytes {
    source: Chain<Cursor<Vec<u8>>, File>,
    bytes: u64,
}

/// The frames of a zstd file, one after the other.
struct ZstdFrames {
    source: BufReader<PackedBytes>,
    decoder: FrameDecoder,
    is_within: bool,
}

impl DownlinkFile {
    /// Opens a file.
    ///
    /// # Errors
    /// The file cannot be opened or read.
    pub fn open(path: &Path) -> Result<Self, DownlinkError> {
        let file = File::open(path).map_err(io_error(path, "open the file"))?;
        Self::of(file).map_err(io_error(path, "read"))
    }

    /// Reads from the place of an open file.
    ///
    /// # Errors
    /// The file cannot be read.
    pub fn of(mut file: File) -> io::Result<Self> {
        let mut head = Vec::new();
        Read::by_ref(&mut file).take(ZSTD.len() as u64).read_to_end(&mut head)?;
        let [is_gzip, is_zstd] = [GZIP, ZSTD].map(|signature| head.starts_with(signature));
        let source = Cursor::new(head).chain(file);
        let packed = |source| PackedBytes { source, bytes: 0 };
        let content = match (is_gzip, is_zstd) {
            (true, _) => Content::Gzip(Box::new(MultiGzDecoder::new(packed(source)))),
            (_, true) => Content::Zstd(Box::new(ZstdFrames::new(packed(source)))),
            _ => Content::Plain(source),
        };
        Ok(Self { content, unpacked: 0 })
    }

    /// The file itself.
    pub(in crate::downlink) fn file(&self) -> Option<&File> {
        match &self.content {
            Content::Plain(source) => Some(source.get_ref().1),
            _ => None,
        }
    }

    /// The packer, and the bytes read of the packed file.
    fn packed(&self) -> Option<(&'static str, u64)> {
        match &self.content {
            Content::Plain(_) => None,
            Content::Gzip(source) => Some(("gzip", source.get_ref().bytes)),
            Content::Zstd(source) => Some(("zstd", source.source.get_ref().bytes)),
        }
    }
}

impl Read for DownlinkFile {
    fn read(&mut self, bytes: &mut [u8]) -> io::Result<usize> {
        let read = match &mut self.content {
            Content::Plain(source) => return source.read(bytes),
            Content::Gzip(source) => source.read(bytes),
            Content::Zstd(source) => source.read(bytes),
        };
        let Some((packer, packed)) = self.packed() else { return read };
        let at = self.unpacked;
        let read = read.map_err(|error| {
            let reason = match error.kind() {
                io::ErrorKind::UnexpectedEof => "it ends early".to_owned(),
                _ => error.to_string(),
            };
            let what = format!(
                "the {packer} file is damaged behind {at} unpacked bytes ({reason}); expected one that `{packer} -t` passes"
            );
            io::Error::new(io::ErrorKind::InvalidData, what)
        })?;
        self.unpacked += read as u64;
        if self.unpacked > UNPACKED_TIMES_MAX * packed + UNPACKED_BYTES_MORE {
            let what = format!(
                "{packed} bytes of the {packer} file unpack to more than {at} bytes; expected at most {UNPACKED_TIMES_MAX} times as \
                 many, as visibilities are mostly noise. If it is a downlink, unpack it first"
            );
            return Err(io::Error::new(io::ErrorKind::InvalidData, what));
        }
        Ok(read)
    }
}

impl fmt::Debug for DownlinkFile {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let (packed, unpacked) = (self.packed(), self.unpacked);
        f.debug_struct("DownlinkFile").field("packed", &packed).field("unpacked", &unpacked).finish()
    }
}

impl Read for PackedBytes {
    fn read(&mut self, bytes: &mut [u8]) -> io::Result<usize> {
        let read = self.source.read(bytes)?;
        self.bytes += read as u64;
        Ok(read)
    }
}

impl ZstdFrames {
    fn new(source: PackedBytes) -> Self {
        let mut decoder = FrameDecoder::new();
        decoder.set_max_window_size(WINDOW_BYTES_MAX);
        Self { source: BufReader::new(source), decoder, is_within: false }
    }

    /// Opens the next frame of data, if there is one; those that others may skip are skipped.
    fn begin(&mut self) -> io::Result<bool> {
        while !self.source.fill_buf()?.is_empty() {
            match self.decoder.init(&mut self.source) {
                Ok(()) => return Ok(true),
                Err(FrameDecoderError::ReadFrameHeaderError(ReadFrameHeaderError::SkipFrame {
                    length,
                    ..
                })) => {
                    io::copy(&mut Read::by_ref(&mut self.source).take(length.into()), &mut io::sink())?;
                }
                Err(error) => return Err(io::Error::other(error)),
            }
        }
        Ok(false)
    }
}

impl Read for ZstdFrames {
    fn read(&mut self, bytes: &mut [u8]) -> io::Result<usize> {
        loop {
            if !self.is_within {
                self.is_within = self.begin()?;
            }
            if !self.is_within || bytes.is_empty() {
                return Ok(0);
            }
            let decoder = &mut self.decoder;
            while decoder.can_collect() == 0 && !decoder.is_finished() {
                let one = BlockDecodingStrategy::UptoBlocks(1);
                decoder.decode_blocks(&mut self.source, one).map_err(io::Error::other)?;
            }
            let read = decoder.read(bytes)?;
            if read > 0 {
                return Ok(read);
            }
            let told = decoder.get_checksum_from_data();
            if told.is_some() && told != decoder.get_calculated_checksum() {
                return Err(io::Error::other("the checksum of its content does not match"));
            }
            self.is_within = false;
        }
    }
}

#[cfg(test)]
mod tests {
    use std::io::Write;

    use flate2::Compression;
    use flate2::write::GzEncoder;
    use ruzstd::encoding::{CompressionLevel, compress_to_vec};

    use super::*;

    fn gzip(bytes: &[u8]) -> Vec<u8> {
        let mut encoder = GzEncoder::new(Vec::new(), Compression::default());
        encoder.write_all(bytes).unwrap();
        encoder.finish().unwrap()
    }

    fn zstd(bytes: &[u8]) -> Vec<u8> {
        compress_to_vec(bytes, CompressionLevel::Fastest)
    }

    fn unpacked(bytes: &[u8]) -> io::Result<Vec<u8>> {
        let mut file = tempfile::tempfile()?;
        file.write_all(bytes)?;
        io::Seek::rewind(&mut file)?;
        let mut found = Vec::new();
        DownlinkFile::of(file)?.read_to_end(&mut found)?;
        Ok(found)
    }

    #[test]
    fn what_was_packed_is_unpacked_also_in_several_members_and_frames() {
        // Bytes in no order that repeats: a generator of full period.
        let mut state = 1_u32;
        let mut next = || {
            state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            (state >> 24) as u8
        };
        let bytes: Vec<u8> = (0..300_000).map(|_| next()).collect();
        let halves = bytes.split_at(100_001);
        assert_eq!(unpacked(&bytes).unwrap(), bytes);
        assert_eq!(unpacked(b"").unwrap(), b"");
        for pack in [gzip, zstd] {
            assert!(unpacked(&pack(&bytes)).unwrap() == bytes);
            let apart = [pack(halves.0), pack(b""), pack(halves.1)].concat();
            assert!(unpacked(&apart).unwrap() == bytes);
            for end in [apart.len() - 1, apart.len() / 2] {
                assert_eq!(unpacked(&apart[..end]).unwrap_err().kind(), io::ErrorKind::InvalidData);
            }
        }
        // A frame that readers may skip (RFC 8878, 3.1.2).
        let skippable = [&b"\x50\x2a\x4d\x18\x03\x00\x00\x00abc"[..], &zstd(&bytes)].concat();
        assert!(unpacked(&[zstd(&bytes), skippable].concat()).unwrap() == [&bytes[..], &bytes].concat());
    }

    #[test]
    fn files_that_unpack_without_end_and_windows_too_large_are_refused() {
        let zeros = vec![0; 1 << 24];
        for pack in [gzip, zstd] {
            let error = unpacked(&pack(&zeros).repeat(40)).unwrap_err().to_string();
            assert!(error.contains("unpack to more than"), "{error}");
        }
        // A frame that asks for a history of 2^41 bytes (window descriptor 0xF8: exponent 31 over 2^10).
        let error = unpacked(b"\x28\xb5\x2f\xfd\x00\xf8\x01\x00\x00").unwrap_err().to_string();
        assert!(error.contains("zstd") && error.to_lowercase().contains("window"), "{error}");
    }
}
