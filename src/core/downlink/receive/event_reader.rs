//! Reads the events of a file, or of any other source of bytes.

use std::io::Read;
use std::path::{Path, PathBuf};

use super::{DownlinkFile, DownlinkReceiver, Event};
use crate::downlink::error::{DownlinkError, io_error, require_packets};

/// Feeds a source to a receiver, chunk by chunk, and names the source in errors.
#[derive(Debug)]
pub struct ByteFeed<R = DownlinkFile> {
    path: PathBuf,
    source: R,
    at_end: bool,
}

impl ByteFeed<DownlinkFile> {
    /// Opens a file.
    ///
    /// # Errors
    /// The file cannot be opened.
    pub fn open(path: &Path) -> Result<Self, DownlinkError> {
        Ok(Self::new(DownlinkFile::open(path)?, path))
    }
}

impl<R: Read> ByteFeed<R> {
    /// Reads from any source; `path` names it in errors.
    #[must_use]
    pub fn new(source: R, path: &Path) -> Self {
        Self { path: path.to_owned(), source, at_end: false }
    }

    /// Feeds the next chunk, or the end of the source. Returns false once the end has been fed.
    ///
    /// # Errors
    /// The source cannot be read.
    pub fn feed(&mut self, receiver: &mut DownlinkReceiver) -> Result<bool, DownlinkError> {
        if self.at_end {
            return Ok(false);
        }
        if receiver.fill_from(&mut self.source).map_err(io_error(&self.path, "read"))? == 0 {
            receiver.finish();
            self.at_end = true;
        }
        Ok(true)
    }
}

/// Reads the events of one source, in bounded memory.
#[derive(Debug)]
pub struct EventReader<R = DownlinkFile> {
    feed: ByteFeed<R>,
    receiver: DownlinkReceiver,
    packets: u64,
    /// Whether the stream has been checked for unsupported frames.
    is_checked: bool,
}

impl EventReader<DownlinkFile> {
    /// Opens a file.
    ///
    /// # Errors
    /// The file cannot be opened.
    pub fn open(path: &Path) -> Result<Self, DownlinkError> {
        Ok(Self::from_feed(ByteFeed::open(path)?))
    }
}

impl<R: Read> EventReader<R> {
    /// Reads from any source; `path` names it in errors.
    #[must_use]
    pub fn new(source: R, path: &Path) -> Self {
        Self::from_feed(ByteFeed::new(source, path))
    }

    fn from_feed(feed: ByteFeed<R>) -> Self {
        Self { feed, receiver: DownlinkReceiver::new(), packets: 0, is_checked: false }
    }

    /// Returns every valid packet, including duplicates, as [`DownlinkReceiver::unfiltered`] does.
    #[must_use]
    pub fn unfiltered(self) -> Self {
        Self { receiver: DownlinkReceiver::unfiltered(), ..self }
    }

    /// Reads events until `take` returns a value; `None` at the end of the source.
    ///
    /// # Errors
    /// The source cannot be read, or contains unsupported transfer frames.
    pub fn find<T>(
        &mut self,
        mut take: impl FnMut(&Event<'_>) -> Option<T>,
    ) -> Result<Option<T>, DownlinkError> {
        loop {
            self.refuse_unsupported_frames()?;
            while let Some(event) = self.receiver.next_event() {
                self.packets += u64::from(matches!(event, Event::Packet(_)));
                if let Some(found) = take(&event) {
                    return Ok(Some(found));
                }
            }
            if !self.feed.feed(&mut self.receiver)? {
                return Ok(None);
            }
        }
    }

    /// Refuses unsupported transfer frames. Some packets would be found in them, but most are interrupted by frame headers.
    fn refuse_unsupported_frames(&mut self) -> Result<(), DownlinkError> {
        if self.is_checked || self.receiver.bytes() == 0 {
            return Ok(());
        }
        self.is_checked = self.receiver.has_full_head();
        match self.receiver.unsupported_frames() {
            None => Ok(()),
            format => Err(DownlinkError::NotADownlink {
                path: self.feed.path.clone(),
                bytes: self.receiver.bytes(),
                format,
            }),
        }
    }

    /// Calls `take` with every event up to the end of the source.
    ///
    /// # Errors
    /// The source cannot be read; the first error of `take`.
    pub fn for_each<E: From<DownlinkError>>(
        &mut self,
        mut take: impl FnMut(&Event<'_>) -> Result<(), E>,
    ) -> Result<(), E> {
        self.find(|event| take(event).err())?.map_or(Ok(()), Err)
    }

    /// Requires that at least one packet has been read.
    ///
    /// # Errors
    /// [`DownlinkError::EmptyFile`] for a source without bytes, [`DownlinkError::NotADownlink`] for one without packets.
    pub fn require_packets(&self) -> Result<(), DownlinkError> {
        require_packets(&self.feed.path, self.receiver.bytes(), self.packets, || {
            self.receiver.foreign_format()
        })
    }

    /// Packets read so far.
    #[must_use]
    pub fn packets(&self) -> u64 {
        self.packets
    }

    /// The receiver, with the format and the counters of the stream.
    #[must_use]
    pub fn receiver(&self) -> &DownlinkReceiver {
        &self.receiver
    }
}
