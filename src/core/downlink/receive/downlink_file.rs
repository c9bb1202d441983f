//! A downlink file as a source of bytes, decompressed if necessary.

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
/// Maximum window of a zstd file, bytes: the default limit of the zstd program.
const WINDOW_BYTES_MAX: u64 = 1 << 27;
/// A file may expand to this multiple of its size plus [`EXPANSION_BYTES`]. Visibilities are mostly noise, which hardly
/// compresses.
const EXPANSION_MAX: u64 = 256;
/// Number of bytes by which a file may expand in addition.
const EXPANSION_BYTES: u64 = 1 << 26;

/// A downlink file, which may be compressed by gzip or zstd; its first bytes tell.
///
/// Decompresses as it is read, in bounded memory.
pub struct DownlinkFile {
    content: Content,
    expanded: u64,
}

enum Content {
    Plain(Chain<Cursor<Vec<u8>>, File>),
    Gzip(Box<MultiGzDecoder<CountedBytes>>),
    Zstd(Box<ZstdFrames>),
}

/// The bytes of a compressed file, with their number.
struct CountedBytes {
    source: Chain<Cursor<Vec<u8>>, File>,
    bytes: u64,
}

/// The frames of a zstd file, one after the other.
struct ZstdFrames {
    source: BufReader<CountedBytes>,
    decoder: FrameDecoder,
    in_frame: bool,
}

impl DownlinkFile {
    /// Opens a file.
    ///
    /// # Errors
    /// The file cannot be opened or read.
    pub fn open(path: &Path) -> Result<Self, DownlinkError> {
        let file = File::open(path).map_err(io_error(path, "open the file"))?;
        Self::from_file(file).map_err(io_error(path, "read"))
    }

    /// Reads from the current position of an open file.
    ///
    /// # Errors
    /// The file cannot be read.
    pub fn from_file(mut file: File) -> io::Result<Self> {
        // A terminal ends, and so does a serial line, which is one; /dev/zero does not.
        #[cfg(unix)]
        if std::os::unix::fs::FileTypeExt::is_char_device(&file.metadata()?.file_type())
            && !io::IsTerminal::is_terminal(&file)
        {
            let reason = "a device, which may be endless; expected a file or a pipe";
            return Err(io::Error::new(io::ErrorKind::InvalidInput, reason));
        }
        let mut head = Vec::new();
        Read::by_ref(&mut file).take(ZSTD.len() as u64).read_to_end(&mut head)?;
        let [is_gzip, is_zstd] = [GZIP, ZSTD].map(|signature| head.starts_with(signature));
        let source = Cursor::new(head).chain(file);
        let counted = |source| CountedBytes { source, bytes: 0 };
        let content = match (is_gzip, is_zstd) {
            (true, _) => Content::Gzip(Box::new(MultiGzDecoder::new(counted(source)))),
            (_, true) => Content::Zstd(Box::new(ZstdFrames::new(counted(source)))),
            _ => Content::Plain(source),
        };
        Ok(Self { content, expanded: 0 })
    }

    /// The open file, unless it is compressed.
    pub(in crate::downlink) fn file(&self) -> Option<&File> {
        match &self.content {
            Content::Plain(source) => Some(source.get_ref().1),
            _ => None,
        }
    }

    /// The name of the compression, and the number of compressed bytes read; `None` for a plain file.
    fn compression(&self) -> Option<(&'static str, u64)> {
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
        let Some((program, compressed)) = self.compression() else { return read };
        let at = self.expanded;
        let read = read.map_err(|error| {
            let reason = match error.kind() {
                io::ErrorKind::UnexpectedEof => "it ends early".to_owned(),
                _ => error.to_string(),
            };
            let what = format!(
                "the {program} file is damaged after {at} decompressed bytes ({reason}); expected a file that passes `{program} -t`"
            );
            io::Error::new(io::ErrorKind::InvalidData, what)
        })?;
        self.expanded += read as u64;
        if self.expanded > EXPANSION_MAX * compressed + EXPANSION_BYTES {
            let what = format!(
                "{compressed} bytes of the {program} file expand to more than {at} bytes; expected at most {EXPANSION_MAX} times as \
                 many, as visibilities are mostly noise. If it is a downlink, decompress it first"
            );
            return Err(io::Error::new(io::ErrorKind::InvalidData, what));
        }
        Ok(read)
    }
}

impl fmt::Debug for DownlinkFile {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let (compressed, expanded) = (self.compression(), self.expanded);
        f.debug_struct("DownlinkFile").field("compressed", &compressed).field("expanded", &expanded).finish()
    }
}

impl Read for CountedBytes {
    fn read(&mut self, bytes: &mut [u8]) -> io::Result<usize> {
        let read = self.source.read(bytes)?;
        self.bytes += read as u64;
        Ok(read)
    }
}

impl ZstdFrames {
    fn new(source: CountedBytes) -> Self {
        let mut decoder = FrameDecoder::new();
        decoder.set_max_window_size(WINDOW_BYTES_MAX);
        Self { source: BufReader::new(source), decoder, in_frame: false }
    }

    /// Opens the next frame of data and skips skippable frames; returns false at the end.
    fn open_frame(&mut self) -> io::Result<bool> {
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
            if !self.in_frame {
                self.in_frame = self.open_frame()?;
            }
            if !self.in_frame || bytes.is_empty() {
                return Ok(0);
            }
            let decoder = &mut self.decoder;
            while decoder.can_collect() == 0 && !decoder.is_finished() {
                let one_block = BlockDecodingStrategy::UptoBlocks(1);
                decoder.decode_blocks(&mut self.source, one_block).map_err(io::Error::other)?;
            }
            let read = decoder.read(bytes)?;
            if read > 0 {
                return Ok(read);
            }
            let stored = decoder.get_checksum_from_data();
            if stored.is_some() && stored != decoder.get_calculated_checksum() {
                return Err(io::Error::other("the checksum of its content does not match"));
            }
            self.in_frame = false;
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

    #[cfg(unix)]
    #[test]
    fn endless_devices_are_refused() {
        let said = DownlinkFile::open(Path::new("/dev/zero")).err().unwrap().to_string();
        assert!(said.contains("/dev/zero"), "{said}");
        let refused = DownlinkFile::from_file(File::open("/dev/zero").unwrap()).err().unwrap();
        assert!(refused.to_string().contains("a device, which may be endless"), "{refused}");
    }

    fn gzip(bytes: &[u8]) -> Vec<u8> {
        let mut encoder = GzEncoder::new(Vec::new(), Compression::default());
        encoder.write_all(bytes).unwrap();
        encoder.finish().unwrap()
    }

    fn zstd(bytes: &[u8]) -> Vec<u8> {
        compress_to_vec(bytes, CompressionLevel::Fastest)
    }

    fn decompressed(bytes: &[u8]) -> io::Result<Vec<u8>> {
        let mut file = tempfile::tempfile()?;
        file.write_all(bytes)?;
        io::Seek::rewind(&mut file)?;
        let mut found = Vec::new();
        DownlinkFile::from_file(file)?.read_to_end(&mut found)?;
        Ok(found)
    }

    #[test]
    fn files_of_several_members_or_frames_are_decompressed() {
        // A generator of full period, so that the bytes hardly compress.
        let mut state = 1_u32;
        let mut next = || {
            state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            (state >> 24) as u8
        };
        let bytes: Vec<u8> = (0..300_000).map(|_| next()).collect();
        let halves = bytes.split_at(100_001);
        assert_eq!(decompressed(&bytes).unwrap(), bytes);
        assert_eq!(decompressed(b"").unwrap(), b"");
        for compress in [gzip, zstd] {
            assert!(decompressed(&compress(&bytes)).unwrap() == bytes);
            let members = [compress(halves.0), compress(b""), compress(halves.1)].concat();
            assert!(decompressed(&members).unwrap() == bytes);
            for end in [members.len() - 1, members.len() / 2] {
                assert_eq!(decompressed(&members[..end]).unwrap_err().kind(), io::ErrorKind::InvalidData);
            }
        }
        // A frame that readers may skip (RFC 8878, 3.1.2).
        let skippable = [&b"\x50\x2a\x4d\x18\x03\x00\x00\x00abc"[..], &zstd(&bytes)].concat();
        assert!(decompressed(&[zstd(&bytes), skippable].concat()).unwrap() == [&bytes[..], &bytes].concat());
    }

    #[test]
    fn decompression_bombs_and_large_windows_are_refused() {
        let zeros = vec![0; 1 << 24];
        for compress in [gzip, zstd] {
            let error = decompressed(&compress(&zeros).repeat(40)).unwrap_err().to_string();
            assert!(error.contains("expand to more than"), "{error}");
        }
        // A frame that requires a window of 2^41 bytes (window descriptor 0xF8: exponent 31 over 2^10).
        let error = decompressed(b"\x28\xb5\x2f\xfd\x00\xf8\x01\x00\x00").unwrap_err().to_string();
        assert!(error.contains("zstd") && error.to_lowercase().contains("window"), "{error}");
    }
}
