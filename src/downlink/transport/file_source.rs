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

/// Bytes read from a file at a time.
const READ_BYTES: usize = 1 << 16;

/// Interval at which a followed file is checked for growth.
const POLL: Duration = Duration::from_millis(100);

/// How long to wait for a followed file to grow.
#[derive(Debug)]
struct GrowthWait {
    /// Polls without growth after which the file counts as complete; `None` for no limit.
    polls_max: Option<u64>,
    polls: u64,
}

/// Reads downlink files one after the other. If some are of packets and some of coded frames, packets are taken out of the frames.
#[derive(Debug)]
pub struct FileSource {
    /// Files still to read.
    files: VecDeque<NextFile>,
    current: Option<OpenFile>,
    bytes: u64,
    /// The first file with a packet, and the format of the stream.
    format: Option<(PathBuf, Format)>,
    /// Set if the last file is followed.
    patience: Option<GrowthWait>,
}

/// A file still to read.
#[derive(Debug)]
struct NextFile {
    path: PathBuf,
    /// Already open if it can be opened only once.
    file: Option<File>,
    /// Its format, if it could be probed.
    format: Option<Format>,
}

/// The file that is being read.
#[derive(Debug)]
struct OpenFile {
    path: PathBuf,
    file: DownlinkFile,
    /// Bytes read so far.
    bytes: u64,
    /// Searches for the first packet in a file that could not be probed when the source was opened.
    probe: Option<Box<DownlinkReceiver>>,
    /// Takes packets out of coded frames, for a stream of packets.
    unframing: Option<Box<DownlinkReceiver>>,
}

impl FileSource {
    /// Opens the files. Probes each regular file for a packet at once, and a pipe as it is read.
    ///
    /// # Errors
    /// A file cannot be opened, is empty, or holds no packet.
    pub fn open(paths: &[PathBuf]) -> Result<Self, DownlinkError> {
        let mut source =
            Self { files: VecDeque::new(), current: None, bytes: 0, format: None, patience: None };
        for path in paths {
            let file = File::open(path).map_err(io_error(path, "open the file"))?;
            let path = path.clone();
            source.files.push_back(if is_regular(&file) {
                let format = format_of(&path, file)?;
                NextFile { path, file: None, format: Some(format) }
            } else {
                NextFile { path, file: Some(file), format: None }
            });
        }
        let known = source.files.iter().filter_map(|next| Some((next.path.clone(), next.format?)));
        // One with packets makes it a stream of packets.
        source.format = known.min_by_key(|(_, format)| *format != Format::Packets);
        Ok(source)
    }

    /// Whether the last file is followed as it grows.
    #[must_use]
    #[doc(hidden)]
    pub fn is_followed(&self) -> bool {
        self.patience.is_some()
    }

    /// Requires one format for the whole stream.
    fn note_format(&mut self, path: &Path, format: Format) -> Result<(), DownlinkError> {
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
    fn begin(&mut self) -> Result<Option<OpenFile>, DownlinkError> {
        let Some(NextFile { path, file, format }) = self.files.pop_front() else { return Ok(None) };
        let is_followed = self.patience.is_some() && self.files.is_empty();
        let probe = (is_followed || file.is_some()).then(Box::default);
        let is_coded_among_packets = format == Some(Format::Cadu)
            && self.format.as_ref().is_some_and(|(_, format)| *format == Format::Packets);
        let unframing = is_coded_among_packets.then(|| Box::new(DownlinkReceiver::unfiltered()));
        let file = match file {
            Some(file) => file,
            None => File::open(&path).map_err(io_error(&path, "open the file"))?,
        };
        let file = DownlinkFile::of(file).map_err(io_error(&path, "read"))?;
        if is_followed && file.file().is_none() {
            return Err(DownlinkError::Compressed { path });
        }
        Ok(Some(OpenFile { path, file, bytes: 0, probe, unframing }))
    }

    /// Searches the bytes just read for the first packet of the file, until one is found.
    fn probe(&mut self, open: &mut OpenFile, bytes: &[u8]) -> Result<(), DownlinkError> {
        let Some(probe) = &mut open.probe else { return Ok(()) };
        probe.push(bytes);
        if let name @ Some(_) = probe.foreign_frames() {
            return Err(DownlinkError::NotADownlink { path: open.path.clone(), bytes: open.bytes, name });
        }
        while let Some(event) = probe.next_event() {
            if matches!(event, Event::Packet(_)) {
                let format = probe.format().unwrap_or_default();
                open.probe = None;
                return self.note_format(&open.path, format);
            }
        }
        Ok(())
    }

    /// As [`FileSource::open`], but follows the last file as it grows: until it has not grown for `idle_s` seconds, or,
    /// if that is 0, until the run is ended. The last file may be empty at first.
    ///
    /// # Errors
    /// Those of [`FileSource::open`] for all files but the last, which need only exist.
    #[doc(hidden)]
    pub fn follow(paths: &[PathBuf], idle_s: f64) -> Result<Self, DownlinkError> {
        let Some((last, others)) = paths.split_last() else { return Self::open(paths) };
        let file = File::open(last).map_err(io_error(last, "open the file"))?;
        let mut source = Self::open(others)?;
        source.files.push_back(NextFile { path: last.clone(), file: Some(file), format: None });
        let polls_max = (idle_s > 0.0).then(|| (idle_s / POLL.as_secs_f64()).ceil() as u64);
        source.patience = Some(GrowthWait { polls_max, polls: 0 });
        Ok(source)
    }

    /// Waits one poll interval for the followed file to grow. Returns whether to read again.
    fn wait(&mut self, open: &OpenFile, out: &mut Outlet<Vec<u8>>) -> Result<bool, DownlinkError> {
        let Some(patience) = self.patience.as_mut().filter(|_| self.files.is_empty()) else {
            return Ok(false);
        };
        open.check_place()?;
        patience.polls += 1;
        if patience.polls_max.is_some_and(|most| patience.polls > most) {
            return Ok(false);
        }
        out.await_input(|| std::thread::sleep(POLL));
        Ok(true)
    }
}

impl OpenFile {
    /// At its end, a file in which no packet was found, if it is known what it is.
    fn refuse_foreign(&self) -> Result<(), DownlinkError> {
        match self.probe.as_ref().and_then(|probe| probe.foreign_name()) {
            None => Ok(()),
            name => Err(DownlinkError::NotADownlink { path: self.path.clone(), bytes: self.bytes, name }),
        }
    }

    /// Checks that the path still leads to the same file and that it has not shrunk. Bytes written over those that were
    /// read would go unnoticed.
    fn check_place(&self) -> Result<(), DownlinkError> {
        let path = &self.path;
        let Ok(there) = std::fs::metadata(path) else {
            return Err(DownlinkError::Replaced { path: path.clone(), read: self.bytes });
        };
        if there.is_file()
            && (there.len() < self.bytes || !self.file.file().is_some_and(|file| is_at(file, path)))
        {
            return Err(DownlinkError::Replaced { path: path.clone(), read: self.bytes });
        }
        Ok(())
    }
}

/// Passes on the packets that have been found.
fn push_packets(intake: &mut DownlinkReceiver, out: &mut Outlet<Vec<u8>>) {
    let mut packets = Vec::new();
    while let Some(event) = intake.next_event() {
        if let Event::Packet(packet) = event {
            packet.append_to(&mut packets);
        }
    }
    if !packets.is_empty() {
        out.push(packets);
    }
}

/// Whether the file can be opened again with the same content; a pipe cannot.
fn is_regular(file: &File) -> bool {
    file.metadata().is_ok_and(|found| found.is_file())
}

/// The format of a file, by its first packet. Reads all of a foreign file, in bounded memory.
fn format_of(path: &Path, file: File) -> Result<Format, DownlinkError> {
    let file = DownlinkFile::of(file).map_err(io_error(path, "read"))?;
    let mut events = EventReader::new(file, path);
    if events.find(|event| matches!(event, Event::Packet(_)).then_some(()))?.is_none() {
        events.require_packets()?;
    }
    Ok(events.intake().format().unwrap_or_default())
}

impl Source for FileSource {
    type Out = Vec<u8>;
    type Error = DownlinkError;

    fn next(&mut self, out: &mut Outlet<Vec<u8>>) -> Result<Flow, DownlinkError> {
        let current = match self.current.take() {
            Some(open) => Some(open),
            None => self.begin()?,
        };
        let Some(mut open) = current else { return Ok(Flow::Done) };
        let mut bytes = Vec::with_capacity(READ_BYTES);
        let read = Read::by_ref(&mut open.file).take(READ_BYTES as u64).read_to_end(&mut bytes);
        if read.map_err(io_error(&open.path, "read"))? > 0 {
            self.bytes += bytes.len() as u64;
            open.bytes += bytes.len() as u64;
            self.probe(&mut open, &bytes)?;
            match &mut open.unframing {
                Some(intake) => {
                    intake.push(&bytes);
                    push_packets(intake, out);
                }
                None => out.push(bytes),
            }
            self.current = Some(open);
            if let Some(patience) = &mut self.patience {
                patience.polls = 0;
            }
        } else if self.wait(&open, out)? {
            self.current = Some(open);
        } else {
            open.refuse_foreign()?;
            if let Some(intake) = &mut open.unframing {
                intake.finish();
                push_packets(intake, out);
            }
        }
        Ok(Flow::Continue)
    }

    fn units(&self) -> Units {
        Units::of(self.bytes, "bytes")
    }
}
