//! The downlink's stages up to the ground's door: packets out of frames, and files.

use std::collections::VecDeque;
use std::fs::File;
use std::io::{Read, Write};
use std::path::{Path, PathBuf};
use std::time::Duration;

use crate::downlink::config::DownlinkConfig;
use crate::downlink::error::{DownlinkError, io_error, require_packets};
use crate::downlink::receive::{Event, Intake};
use crate::downlink::wire::{Format, Transmission};
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
    /// To come; open already if they can be opened only once.
    files: VecDeque<(PathBuf, Option<File>)>,
    now: Option<Reading>,
    bytes: u64,
    /// What the first file with a packet holds.
    format: Option<(PathBuf, Format)>,
    /// Of the last file, if it is followed.
    patience: Option<Patience>,
}

/// A file that is being read.
#[derive(Debug)]
struct Reading {
    path: PathBuf,
    file: File,
    /// Bytes of it so far.
    bytes: u64,
    /// Looks for the first packet in a file that could not be looked into before.
    probe: Option<Box<Intake>>,
}

impl FileSource {
    /// Looks into all files, so that a wrong one is known at once; into what can be read only once, a pipe, as it is read.
    ///
    /// # Errors
    /// A file that cannot be opened, is empty, does not hold a packet of ours, or is of another format than the first.
    pub fn open(paths: &[PathBuf]) -> Result<Self, DownlinkError> {
        let mut source = Self { files: VecDeque::new(), now: None, bytes: 0, format: None, patience: None };
        for path in paths {
            let file = File::open(path).map_err(io_error(path, "open the file"))?;
            if is_regular(&file) {
                source.note_format(path, format_of(path, file)?)?;
                source.files.push_back((path.clone(), None));
            } else {
                source.files.push_back((path.clone(), Some(file)));
            }
        }
        Ok(source)
    }

    /// One stream has one format.
    fn note_format(&mut self, path: &Path, format: Format) -> Result<(), DownlinkError> {
        match &self.format {
            Some((other, expected)) if *expected != format => {
                Err(DownlinkError::Mixed { path: path.to_owned(), other: other.clone() })
            }
            Some(_) => Ok(()),
            None => {
                self.format = Some((path.to_owned(), format));
                Ok(())
            }
        }
    }

    /// The next file.
    fn begin(&mut self) -> Result<Option<Reading>, DownlinkError> {
        let Some((path, file)) = self.files.pop_front() else { return Ok(None) };
        let is_followed = self.patience.is_some() && self.files.is_empty();
        let probe = (is_followed || file.is_some()).then(Box::default);
        let file = match file {
            Some(file) => file,
            None => File::open(&path).map_err(io_error(&path, "open the file"))?,
        };
        Ok(Some(Reading { path, file, bytes: 0, probe }))
    }

    /// Looks for the first packet in what has come of a file, if none has been found in it yet.
    fn probe(&mut self, reading: &mut Reading, bytes: &[u8]) -> Result<(), DownlinkError> {
        let Some(probe) = &mut reading.probe else { return Ok(()) };
        probe.push(bytes);
        while let Some(event) = probe.next_event() {
            if matches!(event, Event::Packet(_)) {
                let format = probe.format().unwrap_or_default();
                reading.probe = None;
                return self.note_format(&reading.path, format);
            }
        }
        Ok(())
    }

    /// As [`FileSource::open`], but the last file, which may hold nothing yet, is read on as it grows: until it has not
    /// for `idle_s` seconds, or until the run is ended if that is 0.
    ///
    /// # Errors
    /// Those of [`FileSource::open`] for all files but the last, which need only be there.
    pub fn follow(paths: &[PathBuf], idle_s: f64) -> Result<Self, DownlinkError> {
        let Some((last, others)) = paths.split_last() else { return Self::open(paths) };
        let file = File::open(last).map_err(io_error(last, "open the file"))?;
        let mut source = Self::open(others)?;
        source.files.push_back((last.clone(), Some(file)));
        let polls_max = (idle_s > 0.0).then(|| (idle_s / POLL.as_secs_f64()).ceil() as u64);
        source.patience = Some(Patience { polls_max, polls: 0 });
        Ok(source)
    }

    /// Waits a little for the last file to grow; whether to look again.
    fn wait(&mut self, reading: &Reading) -> Result<bool, DownlinkError> {
        let Some(patience) = self.patience.as_mut().filter(|_| self.files.is_empty()) else {
            return Ok(false);
        };
        reading.check_place()?;
        patience.polls += 1;
        if patience.polls_max.is_some_and(|most| patience.polls > most) {
            return Ok(false);
        }
        std::thread::sleep(POLL);
        Ok(true)
    }
}

impl Reading {
    /// A followed file must stay what it was: what is written over what was read would be passed by.
    fn check_place(&self) -> Result<(), DownlinkError> {
        let path = &self.path;
        let Ok(there) = std::fs::metadata(path) else {
            return Err(DownlinkError::Replaced { path: path.clone(), read: self.bytes });
        };
        let here = self.file.metadata().map_err(io_error(path, "examine the file"))?;
        if there.is_file() && (there.len() < self.bytes || !is_same(&here, &there)) {
            return Err(DownlinkError::Replaced { path: path.clone(), read: self.bytes });
        }
        Ok(())
    }
}

/// Whether a file can be opened again and is then the same: a pipe is not.
fn is_regular(file: &File) -> bool {
    file.metadata().is_ok_and(|found| found.is_file())
}

/// Whether an open file is the one that its path leads to.
#[cfg(unix)]
fn is_same(here: &std::fs::Metadata, there: &std::fs::Metadata) -> bool {
    use std::os::unix::fs::MetadataExt;
    (here.dev(), here.ino()) == (there.dev(), there.ino())
}

/// Whether an open file is the one that its path leads to; not known here.
#[cfg(not(unix))]
fn is_same(_: &std::fs::Metadata, _: &std::fs::Metadata) -> bool {
    true
}

/// Reads until the first packet of ours; all of a foreign file, in bounded memory.
fn format_of(path: &Path, mut file: File) -> Result<Format, DownlinkError> {
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
        let begun = match self.now.take() {
            Some(reading) => Some(reading),
            None => self.begin()?,
        };
        let Some(mut reading) = begun else { return Ok(Flow::Done) };
        let mut bytes = Vec::with_capacity(READ_BYTES);
        let read = Read::by_ref(&mut reading.file).take(READ_BYTES as u64).read_to_end(&mut bytes);
        if read.map_err(io_error(&reading.path, "read"))? > 0 {
            self.bytes += bytes.len() as u64;
            reading.bytes += bytes.len() as u64;
            self.probe(&mut reading, &bytes)?;
            out.push(bytes);
            self.now = Some(reading);
            if let Some(patience) = &mut self.patience {
                patience.polls = 0;
            }
        } else if self.wait(&reading)? {
            self.now = Some(reading);
        }
        Ok(Flow::Continue)
    }

    fn units(&self) -> Units {
        Units::of(self.bytes, "bytes")
    }
}
