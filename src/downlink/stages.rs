//! The downlink's stages: packets out of frames, files, frames out of packets.

use std::collections::VecDeque;
use std::fs::File;
use std::io::{Read, Write};
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, PoisonError};

use super::config::{DownlinkConfig, Format};
use super::counters::ReceptionCounters;
use super::decoder::Decoder;
use super::error::DownlinkError;
use super::file::{io_error, require_packets};
use super::intake::Intake;
use super::receiver::Event;
use super::transmission::Transmission;
use crate::files::{AtomicFile, Unfinished};
use crate::frames::GroundFrame;
use crate::runtime::{Flow, Outlet, Sink, Source, Stage, Units};

/// Bytes read from a file at a time.
const READ_BYTES: usize = 1 << 18;

/// Turns frames into packets or coded frames of packets: the spacecraft's end of the link.
#[derive(Debug)]
pub struct Transmitter {
    transmission: Transmission,
    bytes: u64,
}

impl Transmitter {
    /// A transmitter at the start of a mission.
    ///
    /// # Errors
    /// A bad configuration.
    pub fn new(config: &DownlinkConfig) -> Result<Self, DownlinkError> {
        Ok(Self { transmission: Transmission::new(config)?, bytes: 0 })
    }
}

impl Stage for Transmitter {
    type In = GroundFrame;
    type Out = Vec<u8>;
    type Error = DownlinkError;

    fn step(&mut self, frame: GroundFrame, out: &mut Outlet<Vec<u8>>) -> Result<(), DownlinkError> {
        let mut bytes = Vec::new();
        self.transmission.send(&frame, &mut bytes)?;
        self.bytes += bytes.len() as u64;
        if !bytes.is_empty() {
            out.push(bytes);
        }
        Ok(())
    }

    fn finish(&mut self, out: &mut Outlet<Vec<u8>>) -> Result<(), DownlinkError> {
        let mut bytes = Vec::new();
        self.transmission.finish(&mut bytes);
        self.bytes += bytes.len() as u64;
        if !bytes.is_empty() {
            out.push(bytes);
        }
        Ok(())
    }

    fn units(&self) -> Units {
        Units::of(self.bytes, "bytes")
    }
}

/// Keeps what passes in a file; as a stage it hands it on, as a sink it is the end.
#[derive(Debug)]
pub struct Recorder {
    path: PathBuf,
    /// `None` once finished.
    file: Option<AtomicFile>,
    bytes: u64,
}

impl Recorder {
    /// Begins a file.
    ///
    /// # Errors
    /// A file that cannot be written.
    pub fn create(path: &Path) -> Result<Self, DownlinkError> {
        let file = AtomicFile::create(path, Unfinished::Keep).map_err(io_error(path, "create the file"))?;
        Ok(Self { path: path.to_owned(), file: Some(file), bytes: 0 })
    }

    fn keep(&mut self, bytes: &[u8]) -> Result<(), DownlinkError> {
        self.bytes += bytes.len() as u64;
        match &mut self.file {
            Some(file) => file.write_all(bytes).map_err(io_error(&self.path, "write")),
            None => Ok(()),
        }
    }

    fn close(&mut self) -> Result<(), DownlinkError> {
        match self.file.take() {
            Some(file) => file.finish().map(|_| ()).map_err(io_error(&self.path, "finish the file")),
            None => Ok(()),
        }
    }
}

impl Stage for Recorder {
    type In = Vec<u8>;
    type Out = Vec<u8>;
    type Error = DownlinkError;

    fn step(&mut self, bytes: Vec<u8>, out: &mut Outlet<Vec<u8>>) -> Result<(), DownlinkError> {
        self.keep(&bytes)?;
        out.push(bytes);
        Ok(())
    }

    fn finish(&mut self, _: &mut Outlet<Vec<u8>>) -> Result<(), DownlinkError> {
        self.close()
    }

    fn units(&self) -> Units {
        Units::of(self.bytes, "bytes")
    }
}

impl Sink for Recorder {
    type In = Vec<u8>;
    type Error = DownlinkError;

    fn take(&mut self, bytes: Vec<u8>) -> Result<(), DownlinkError> {
        self.keep(&bytes)
    }

    fn finish(&mut self) -> Result<(), DownlinkError> {
        self.close()
    }

    fn units(&self) -> Units {
        Units::of(self.bytes, "bytes")
    }
}

/// Reads downlink files one after the other.
#[derive(Debug)]
pub struct FileSource {
    files: VecDeque<PathBuf>,
    now: Option<(PathBuf, File)>,
    bytes: u64,
}

impl FileSource {
    /// Looks into all files, so that a wrong one is known at once.
    ///
    /// # Errors
    /// A file that cannot be opened, is empty, does not hold a packet of ours, or is of another format than the first.
    pub fn open(paths: &[PathBuf]) -> Result<Self, DownlinkError> {
        let mut first: Option<(&PathBuf, Format)> = None;
        for path in paths {
            let format = format_of(path)?;
            match first {
                Some((other, expected)) if expected != format => {
                    return Err(DownlinkError::Mixed { path: path.clone(), other: other.clone() });
                }
                _ => first = Some((path, format)),
            }
        }
        Ok(Self { files: paths.iter().cloned().collect(), now: None, bytes: 0 })
    }
}

/// Reads until the first packet of ours; all of a foreign file, in bounded memory.
fn format_of(path: &Path) -> Result<Format, DownlinkError> {
    let mut file = File::open(path).map_err(io_error(path, "open the file"))?;
    let mut receiver = Intake::new();
    let mut at_end = false;
    loop {
        while let Some(event) = receiver.next_event() {
            if matches!(event, Event::Packet(_)) {
                return Ok(receiver.format().unwrap_or_default());
            }
        }
        if at_end {
            return require_packets(path, receiver.bytes(), 0).map(|()| Format::default());
        }
        if receiver.fill_from(&mut file).map_err(io_error(path, "read"))? == 0 {
            receiver.finish();
            at_end = true;
        }
    }
}

impl Source for FileSource {
    type Out = Vec<u8>;
    type Error = DownlinkError;

    fn next(&mut self, out: &mut Outlet<Vec<u8>>) -> Result<Flow, DownlinkError> {
        let (path, mut file) = match self.now.take() {
            Some(now) => now,
            None => {
                let Some(path) = self.files.pop_front() else { return Ok(Flow::Done) };
                let file = File::open(&path).map_err(io_error(&path, "open the file"))?;
                (path, file)
            }
        };
        let mut bytes = Vec::with_capacity(READ_BYTES);
        let read = Read::by_ref(&mut file).take(READ_BYTES as u64).read_to_end(&mut bytes);
        if read.map_err(io_error(&path, "read"))? > 0 {
            self.bytes += bytes.len() as u64;
            out.push(bytes);
            self.now = Some((path, file));
        }
        Ok(Flow::Continue)
    }

    fn units(&self) -> Units {
        Units::of(self.bytes, "bytes")
    }
}

/// Finds packets in what arrives and makes frames of them: the ground's end of the link.
#[derive(Debug, Default)]
pub struct Reception {
    receiver: Intake,
    decoder: Decoder,
    account: Arc<Mutex<ReceptionCounters>>,
}

impl Reception {
    /// Leaves its account in `account` at the end.
    #[must_use]
    pub fn new(account: Arc<Mutex<ReceptionCounters>>) -> Self {
        Self { account, ..Self::default() }
    }

    fn pass_on(&mut self, out: &mut Outlet<GroundFrame>) {
        while let Some(event) = self.receiver.next_event() {
            if let Some(frame) = self.decoder.accept(&event) {
                out.push(frame);
            }
        }
    }
}

impl Stage for Reception {
    type In = Vec<u8>;
    type Out = GroundFrame;
    type Error = DownlinkError;

    fn step(&mut self, bytes: Vec<u8>, out: &mut Outlet<GroundFrame>) -> Result<(), DownlinkError> {
        self.receiver.push(&bytes);
        self.pass_on(out);
        Ok(())
    }

    fn finish(&mut self, out: &mut Outlet<GroundFrame>) -> Result<(), DownlinkError> {
        self.receiver.finish();
        self.pass_on(out);
        self.decoder.finish();
        *self.account.lock().unwrap_or_else(PoisonError::into_inner) =
            ReceptionCounters { frames: self.receiver.frames(), ..self.decoder.counters().clone() };
        Ok(())
    }

    fn units(&self) -> Units {
        Units::of(self.receiver.bytes(), "bytes")
    }
}
