//! Downlink files as a source of bytes.

use std::collections::VecDeque;
use std::fs::File;
use std::io::Read;
use std::path::{Path, PathBuf};
use std::time::Duration;

use crate::downlink::error::{DownlinkError, io_error};
use crate::downlink::receive::{DownlinkFile, DownlinkReceiver, Event, EventReader};
use crate::downlink::wire::Format;
use crate::files::is_at;
use crate::runtime::{Flow, Outlet, Source, Units};

/// Number of bytes read from a file at a time.
const READ_BYTES: usize = 1 << 16;

/// Interval at which a followed file is checked for growth.
const POLL: Duration = Duration::from_millis(100);

/// The wait for a followed file to grow.
#[derive(Debug)]
struct GrowthWait {
    /// Number of polls without growth after which the file counts as complete; `None` for no limit.
    polls_max: Option<u64>,
    /// Number of polls since the file last grew.
    polls: u64,
}

/// Reads downlink files one after the other. If some have packets and some coded frames, it extracts the packets from the
/// frames.
#[derive(Debug)]
pub struct FileSource {
    /// Files that have not been opened yet.
    files: VecDeque<PendingFile>,
    current: Option<OpenFile>,
    bytes: u64,
    /// The format of the stream, and the file that set it.
    format: Option<(PathBuf, Format)>,
    /// The wait for the last file to grow, if it is followed.
    growth_wait: Option<GrowthWait>,
}

/// A file that is yet to be read.
#[derive(Debug)]
struct PendingFile {
    path: PathBuf,
    /// The open file, if it can be opened only once.
    file: Option<File>,
    /// The format, if the file could be probed.
    format: Option<Format>,
}

/// The file that is being read.
#[derive(Debug)]
struct OpenFile {
    path: PathBuf,
    file: DownlinkFile,
    /// Number of bytes read.
    bytes: u64,
    /// Receiver that searches for the first packet, for a file that could not be probed when the source was opened.
    probe: Option<Box<DownlinkReceiver>>,
    /// Receiver that extracts packets from coded frames, for a stream of packets.
    extractor: Option<Box<DownlinkReceiver>>,
}

impl FileSource {
    /// Opens the files. Searches each regular file for a packet immediately, and a pipe while it is read.
    ///
    /// # Errors
    /// A file cannot be opened, is empty, or holds no packet.
    pub fn open(paths: &[PathBuf]) -> Result<Self, DownlinkError> {
        let mut source =
            Self { files: VecDeque::new(), current: None, bytes: 0, format: None, growth_wait: None };
        for path in paths {
            let file = File::open(path).map_err(io_error(path, "open the file"))?;
            let path = path.clone();
            source.files.push_back(if is_regular(&file) {
                let format = format_of(&path, file)?;
                PendingFile { path, file: None, format: Some(format) }
            } else {
                PendingFile { path, file: Some(file), format: None }
            });
        }
        let known = source.files.iter().filter_map(|next| Some((next.path.clone(), next.format?)));
        // A single file of packets makes the stream one of packets.
        source.format = known.min_by_key(|(_, format)| *format != Format::Packets);
        Ok(source)
    }

    /// Whether the last file is followed as it grows.
    #[must_use]
    #[doc(hidden)]
    pub fn is_followed(&self) -> bool {
        self.growth_wait.is_some()
    }

    /// Sets the format of the stream, or requires that `format` equals it.
    fn require_format(&mut self, path: &Path, format: Format) -> Result<(), DownlinkError> {
        match &self.format {
            Some((other, expected)) if *expected != format => {
                Err(DownlinkError::MixedFormats { path: path.to_owned(), other: other.clone() })
            }
            Some(_) => Ok(()),
            None => {
                self.format = Some((path.to_owned(), format));
                Ok(())
            }
        }
    }

    /// Opens the next file.
    fn open_next(&mut self) -> Result<Option<OpenFile>, DownlinkError> {
        let Some(PendingFile { path, file, format }) = self.files.pop_front() else { return Ok(None) };
        let is_followed = self.growth_wait.is_some() && self.files.is_empty();
        let probe = (is_followed || file.is_some()).then(Box::default);
        let is_coded_among_packets = format == Some(Format::Cadu)
            && self.format.as_ref().is_some_and(|(_, format)| *format == Format::Packets);
        let extractor = is_coded_among_packets.then(|| Box::new(DownlinkReceiver::unfiltered()));
        let file = match file {
            Some(file) => file,
            None => File::open(&path).map_err(io_error(&path, "open the file"))?,
        };
        let file = DownlinkFile::from_file(file).map_err(io_error(&path, "read"))?;
        if is_followed && file.file().is_none() {
            return Err(DownlinkError::Compressed { path });
        }
        Ok(Some(OpenFile { path, file, bytes: 0, probe, extractor }))
    }

    /// Searches the next bytes of the file for its first packet, until one is found.
    fn probe(&mut self, open: &mut OpenFile, bytes: &[u8]) -> Result<(), DownlinkError> {
        let Some(probe) = &mut open.probe else { return Ok(()) };
        probe.push(bytes);
        if let format @ Some(_) = probe.unsupported_frames() {
            return Err(DownlinkError::NotADownlink { path: open.path.clone(), bytes: open.bytes, format });
        }
        while let Some(event) = probe.next_event() {
            if matches!(event, Event::Packet(_)) {
                let format = probe.format().unwrap_or_default();
                open.probe = None;
                return self.require_format(&open.path, format);
            }
        }
        Ok(())
    }

    /// Opens the files, as [`FileSource::open`] does, and follows the last one as it grows: until it has not grown for
    /// `idle_s` seconds or, if that is 0, until the run ends. The last file may be empty at first.
    ///
    /// # Errors
    /// The errors of [`FileSource::open`]; the last file need only exist.
    #[doc(hidden)]
    pub fn follow(paths: &[PathBuf], idle_s: f64) -> Result<Self, DownlinkError> {
        let Some((last, others)) = paths.split_last() else { return Self::open(paths) };
        let file = File::open(last).map_err(io_error(last, "open the file"))?;
        let mut source = Self::open(others)?;
        source.files.push_back(PendingFile { path: last.clone(), file: Some(file), format: None });
        let polls_max = (idle_s > 0.0).then(|| (idle_s / POLL.as_secs_f64()).ceil() as u64);
        source.growth_wait = Some(GrowthWait { polls_max, polls: 0 });
        Ok(source)
    }

    /// Waits one poll interval for the followed file to grow; returns whether to read again.
    fn wait(&mut self, open: &OpenFile, out: &mut Outlet<Vec<u8>>) -> Result<bool, DownlinkError> {
        let Some(growth_wait) = self.growth_wait.as_mut().filter(|_| self.files.is_empty()) else {
            return Ok(false);
        };
        open.require_same_file()?;
        growth_wait.polls += 1;
        if growth_wait.polls_max.is_some_and(|polls_max| growth_wait.polls > polls_max) {
            return Ok(false);
        }
        out.await_input(|| std::thread::sleep(POLL));
        Ok(true)
    }
}

impl OpenFile {
    /// Refuses a file that was read to its end without a packet, if its format is recognised.
    fn refuse_foreign(&self) -> Result<(), DownlinkError> {
        match self.probe.as_ref().and_then(|probe| probe.foreign_format()) {
            None => Ok(()),
            format => Err(DownlinkError::NotADownlink { path: self.path.clone(), bytes: self.bytes, format }),
        }
    }

    /// Requires that the path still leads to the same file and that the file has not shrunk. Overwritten bytes are not
    /// detected.
    fn require_same_file(&self) -> Result<(), DownlinkError> {
        let path = &self.path;
        let Ok(metadata) = std::fs::metadata(path) else {
            return Err(DownlinkError::Replaced { path: path.clone(), read: self.bytes });
        };
        if metadata.is_file()
            && (metadata.len() < self.bytes || !self.file.file().is_some_and(|file| is_at(file, path)))
        {
            return Err(DownlinkError::Replaced { path: path.clone(), read: self.bytes });
        }
        Ok(())
    }
}

/// Forwards the packets that a receiver has found.
fn push_packets(receiver: &mut DownlinkReceiver, out: &mut Outlet<Vec<u8>>) {
    let mut packets = Vec::new();
    while let Some(event) = receiver.next_event() {
        if let Event::Packet(packet) = event {
            packet.append_to(&mut packets);
        }
    }
    if !packets.is_empty() {
        out.push(packets);
    }
}

/// Whether the file can be opened again with the same content, unlike a pipe.
fn is_regular(file: &File) -> bool {
    file.metadata().is_ok_and(|found| found.is_file())
}

/// The format of a file, according to its first packet. Without one, reads the whole file, in bounded memory.
fn format_of(path: &Path, file: File) -> Result<Format, DownlinkError> {
    let file = DownlinkFile::from_file(file).map_err(io_error(path, "read"))?;
    let mut events = EventReader::new(file, path);
    if events.find(|event| matches!(event, Event::Packet(_)).then_some(()))?.is_none() {
        events.require_packets()?;
    }
    Ok(events.receiver().format().unwrap_or_default())
}

impl Source for FileSource {
    type Out = Vec<u8>;
    type Error = DownlinkError;

    fn next(&mut self, out: &mut Outlet<Vec<u8>>) -> Result<Flow, DownlinkError> {
        let current = match self.current.take() {
            Some(open) => Some(open),
            None => self.open_next()?,
        };
        let Some(mut open) = current else { return Ok(Flow::Done) };
        let mut bytes = Vec::with_capacity(READ_BYTES);
        let read = Read::by_ref(&mut open.file).take(READ_BYTES as u64).read_to_end(&mut bytes);
        if read.map_err(io_error(&open.path, "read"))? > 0 {
            self.bytes += bytes.len() as u64;
            open.bytes += bytes.len() as u64;
            self.probe(&mut open, &bytes)?;
            match &mut open.extractor {
                Some(receiver) => {
                    receiver.push(&bytes);
                    push_packets(receiver, out);
                }
                None => out.push(bytes),
            }
            self.current = Some(open);
            if let Some(growth_wait) = &mut self.growth_wait {
                growth_wait.polls = 0;
            }
        } else if self.wait(&open, out)? {
            self.current = Some(open);
        } else {
            open.refuse_foreign()?;
            if let Some(receiver) = &mut open.extractor {
                receiver.finish();
                push_packets(receiver, out);
            }
        }
        Ok(Flow::Continue)
    }

    fn units(&self) -> Units {
        Units::of(self.bytes, "bytes")
    }
}
