//! The downlink's stages up to the ground's door: packets out of frames, and files.

use std::collections::VecDeque;
use std::fs::File;
use std::io::{Read, Write};
use std::path::{Path, PathBuf};
use std::time::Duration;

use super::config::{DownlinkConfig, Format};
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

/// Between two looks at a file that may have grown.
const POLL: Duration = Duration::from_millis(100);

/// How long to wait for a file to grow.
#[derive(Debug)]
struct Patience {
    /// Looks in vain after which the file is taken to be whole; `None` for ever.
    polls_max: Option<u64>,
    polls: u64,
}

/// Reads downlink files one after the other.
#[derive(Debug)]
pub struct FileSource {
    files: VecDeque<PathBuf>,
    now: Option<(PathBuf, File)>,
    bytes: u64,
    /// Of the last file, if it is followed.
    patience: Option<Patience>,
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
        Ok(Self { files: paths.iter().cloned().collect(), now: None, bytes: 0, patience: None })
    }

    /// As [`FileSource::open`], but the last file, which may hold nothing yet, is read on as it grows: until it has not
    /// for `idle_s` seconds, or until the run is ended if that is 0.
    ///
    /// # Errors
    /// Those of [`FileSource::open`] for all files but the last, which need only be there.
    pub fn follow(paths: &[PathBuf], idle_s: f64) -> Result<Self, DownlinkError> {
        let Some((last, others)) = paths.split_last() else { return Self::open(paths) };
        File::open(last).map_err(io_error(last, "open the file"))?;
        let mut source = Self::open(others)?;
        source.files.push_back(last.clone());
        let polls_max = (idle_s > 0.0).then(|| (idle_s / POLL.as_secs_f64()).ceil() as u64);
        source.patience = Some(Patience { polls_max, polls: 0 });
        Ok(source)
    }

    /// Waits a little for the last file to grow; whether to look again.
    fn wait(&mut self) -> bool {
        let Some(patience) = self.patience.as_mut().filter(|_| self.files.is_empty()) else { return false };
        patience.polls += 1;
        if patience.polls_max.is_some_and(|most| patience.polls > most) {
            return false;
        }
        std::thread::sleep(POLL);
        true
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
            if let Some(patience) = &mut self.patience {
                patience.polls = 0;
            }
        } else if self.wait() {
            self.now = Some((path, file));
        }
        Ok(Flow::Continue)
    }

    fn units(&self) -> Units {
        Units::of(self.bytes, "bytes")
    }
}
