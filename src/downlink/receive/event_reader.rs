//! The bytes of a file, or of any reader, to events.

use std::io::Read;
use std::path::{Path, PathBuf};

use super::{DownlinkFile, DownlinkReceiver, Event};
use crate::downlink::error::{DownlinkError, io_error, require_packets};

/// Feeds a source to an intake, chunk by chunk, and names the source in errors.
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

    /// Feeds the next chunk, or the end of the source. Returns false if the end was fed before.
    ///
    /// # Errors
    /// The source cannot be read.
    pub fn feed(&mut self, intake: &mut DownlinkReceiver) -> Result<bool, DownlinkError> {
        if self.at_end {
            return Ok(false);
        }
        if intake.fill_from(&mut self.source).map_err(io_error(&self.path, "read"))? == 0 {
            intake.finish();
            self.at_end = true;
        }
        Ok(true)
    }
}

/// Reads the events of one source, in bounded memory.
#[derive(Debug)]
pub struct EventReader<R = DownlinkFile> {
    feed: ByteFeed<R>,
    intake: DownlinkReceiver,
    packets: u64,
    /// Whether the stream has been looked at for frames of another kind.
    looked: bool,
}

impl EventReader<DownlinkFile> {
    /// Opens a file.
    ///
    /// # Errors
    /// The file cannot be opened.
    pub fn open(path: &Path) -> Result<Self, DownlinkError> {
        Ok(Self::of(ByteFeed::open(path)?))
    }
}

impl<R: Read> EventReader<R> {
    /// Reads from any source; `path` names it in errors.
    #[must_use]
    pub fn new(source: R, path: &Path) -> Self {
        Self::of(ByteFeed::new(source, path))
    }

    fn of(feed: ByteFeed<R>) -> Self {
        Self { feed, intake: DownlinkReceiver::new(), packets: 0, looked: false }
    }

    /// The same source through [`DownlinkReceiver::unfiltered`]: every sound packet, duplicates too.
    #[must_use]
    pub fn unfiltered(self) -> Self {
        Self { intake: DownlinkReceiver::unfiltered(), ..self }
    }

    /// Reads on until `take` returns something; `None` at the end of the source.
    ///
    /// # Errors
    /// The source cannot be read, or is of transfer frames of another kind.
    pub fn find<T>(
        &mut self,
        mut take: impl FnMut(&Event<'_>) -> Option<T>,
    ) -> Result<Option<T>, DownlinkError> {
        loop {
            self.refuse_foreign_frames()?;
            while let Some(event) = self.intake.next_event() {
                self.packets += u64::from(matches!(event, Event::Packet(_)));
                if let Some(found) = take(&event) {
                    return Ok(Some(found));
                }
            }
            if !self.feed.feed(&mut self.intake)? {
                return Ok(None);
            }
        }
    }

    /// Packets may be seen in transfer frames of another kind, but most are cut by the frames' headers: once events are due, the stream
    /// is looked at.
    fn refuse_foreign_frames(&mut self) -> Result<(), DownlinkError> {
        if self.looked || self.intake.bytes() == 0 {
            return Ok(());
        }
        self.looked = self.intake.has_whole_head();
        match self.intake.foreign_frames() {
            None => Ok(()),
            name => Err(DownlinkError::NotADownlink {
                path: self.feed.path.clone(),
                bytes: self.intake.bytes(),
                name,
            }),
        }
    }

    /// Reads to the end of the source and gives `take` every event.
    ///
    /// # Errors
    /// The source cannot be read; the first error of `take`.
    pub fn for_each<E: From<DownlinkError>>(
        &mut self,
        mut take: impl FnMut(&Event<'_>) -> Result<(), E>,
    ) -> Result<(), E> {
        self.find(|event| take(event).err())?.map_or(Ok(()), Err)
    }

    /// Requires that a packet has been read.
    ///
    /// # Errors
    /// [`DownlinkError::EmptyFile`] for a source without a byte, [`DownlinkError::NotADownlink`] for one without a packet.
    pub fn require_packets(&self) -> Result<(), DownlinkError> {
        require_packets(&self.feed.path, self.intake.bytes(), self.packets, || self.intake.foreign_name())
    }

    /// Packets read so far.
    #[must_use]
    pub fn packets(&self) -> u64 {
        self.packets
    }

    /// The intake, for what it has found out about the stream.
    #[must_use]
    pub fn intake(&self) -> &DownlinkReceiver {
        &self.intake
    }
}
