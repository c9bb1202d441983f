//! Downlink files of either format.

use std::fs::File;
use std::io::{Read, Write};
use std::path::{Path, PathBuf};

use crate::downlink::DownlinkError;
use crate::downlink::config::DownlinkConfig;
use crate::downlink::error::{io_error, require_packets};
use crate::downlink::receive::cadu::FrameCounters;
use crate::downlink::receive::{Decoder, Event, Intake, ReceptionCounters};
use crate::downlink::wire::Transmission;
use crate::files::{AtomicFile, Unfinished};
use crate::frames::GroundFrame;

/// Writes frames to a file of packets, or of coded frames of packets.
///
/// The file is called `NAME.partial` until [`DownlinkWriter::finish`] has put all of it on the disk; then it takes its
/// name, replacing an older one. Cut short by whatever it is, what is there can be read.
#[derive(Debug)]
pub struct DownlinkWriter {
    path: PathBuf,
    file: AtomicFile,
    transmission: Transmission,
    pending: Vec<u8>,
}

impl DownlinkWriter {
    /// Begins a file.
    ///
    /// # Errors
    /// A bad configuration, or a file that cannot be written.
    pub fn create(path: &Path, config: &DownlinkConfig) -> Result<Self, DownlinkError> {
        let transmission = Transmission::new(config)?;
        let file = AtomicFile::create(path, Unfinished::Keep).map_err(io_error(path, "create the file"))?;
        Ok(Self { path: path.to_owned(), file, transmission, pending: Vec::new() })
    }

    /// Appends what a frame adds to the downlink.
    ///
    /// # Errors
    /// Those of [`Transmission::send`], and a file that cannot be written.
    pub fn write(&mut self, frame: &GroundFrame) -> Result<(), DownlinkError> {
        self.pending.clear();
        self.transmission.send(frame, &mut self.pending)?;
        self.file.write_all(&self.pending).map_err(io_error(&self.path, "write"))
    }

    /// Bytes of all packets so far.
    #[must_use]
    pub fn bytes(&self) -> u64 {
        self.file.bytes()
    }

    /// Puts everything on the disk and gives the file its name; returns its length in bytes.
    ///
    /// # Errors
    /// A file that cannot be written or renamed.
    pub fn finish(mut self) -> Result<u64, DownlinkError> {
        self.pending.clear();
        self.transmission.finish(&mut self.pending);
        self.file.write_all(&self.pending).map_err(io_error(&self.path, "write"))?;
        self.file.finish().map_err(io_error(&self.path, "finish the file"))
    }
}

/// Reads frames from a file of either format, in bounded memory.
#[derive(Debug)]
pub struct DownlinkReader<R = File> {
    path: PathBuf,
    source: R,
    receiver: Intake,
    decoder: Decoder,
    packets: u64,
    finished: bool,
}

impl DownlinkReader<File> {
    /// Opens a file.
    ///
    /// # Errors
    /// A file that cannot be opened.
    pub fn open(path: &Path) -> Result<Self, DownlinkError> {
        Ok(Self::new(File::open(path).map_err(io_error(path, "open the file"))?, path))
    }
}

impl<R: Read> DownlinkReader<R> {
    /// Reads from any source; `path` names it in errors.
    #[must_use]
    pub fn new(source: R, path: &Path) -> Self {
        Self {
            path: path.to_owned(),
            source,
            receiver: Intake::new(),
            decoder: Decoder::new(),
            packets: 0,
            finished: false,
        }
    }

    /// Goes on with what the decoder of an earlier file has learnt and counted.
    #[must_use]
    pub fn with_decoder(self, decoder: Decoder) -> Self {
        Self { decoder, ..self }
    }

    /// The decoder, for the next file.
    #[must_use]
    pub fn into_decoder(self) -> Decoder {
        self.decoder
    }

    /// The next frame; `None` at the end of the file.
    ///
    /// # Errors
    /// A file that cannot be read, is empty, or holds no packet at all; damage is counted instead.
    pub fn next_frame(&mut self) -> Result<Option<GroundFrame>, DownlinkError> {
        loop {
            while let Some(event) = self.receiver.next_event() {
                self.packets += u64::from(matches!(event, Event::Packet(_)));
                if let Some(frame) = self.decoder.accept(&event) {
                    return Ok(Some(frame));
                }
            }
            if self.finished {
                return self.end().map(|()| None);
            }
            if self.receiver.fill_from(&mut self.source).map_err(io_error(&self.path, "read"))? == 0 {
                self.receiver.finish();
                self.finished = true;
            }
        }
    }

    /// The account so far.
    #[must_use]
    pub fn counters(&self) -> &ReceptionCounters {
        self.decoder.counters()
    }

    /// The account of the coded frames, if the file holds such.
    #[must_use]
    pub fn frames(&self) -> Option<FrameCounters> {
        self.receiver.frames()
    }

    fn end(&mut self) -> Result<(), DownlinkError> {
        self.decoder.finish();
        require_packets(&self.path, self.receiver.bytes(), self.packets)
    }
}
