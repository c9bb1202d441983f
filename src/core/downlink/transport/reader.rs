//! Reads downlink files of either format.

use std::io::Read;
use std::path::Path;

use crate::downlink::error::DownlinkError;
use crate::downlink::receive::cadu::FrameCounters;
use crate::downlink::receive::{Decoder, DownlinkFile, EventReader, ReceptionCounters};
use crate::frames::GroundFrame;

/// Reads ground frames from a file of either format, in bounded memory.
///
/// ```
/// use lunarray::prelude::*;
///
/// # fn main() -> Result<(), Box<dyn std::error::Error>> {
/// # let folder = tempfile::tempdir()?;
/// # let file = folder.path().join("mission.ccsds");
/// # Mission::dsl().channels(&[3e6]).nside(4).set("spacecraft.every_nth_window", 900).simulate(&file)?;
/// let mut reader = DownlinkReader::open(&file)?;
/// let mut good = 0;
/// while let Some(frame) = reader.next_frame()? {
///     if let GroundFrame::Visibilities(block) = frame {
///         good += block.flags.iter().filter(|flags| flags.is_good()).count();
///     }
/// }
/// // The whole contents of the file, and all damage.
/// let contents = Contents::read(&file)?;
/// assert!(good > 0 && good as u64 <= contents.visibilities.count);
/// # Ok(())
/// # }
/// ```
#[derive(Debug)]
pub struct DownlinkReader<R = DownlinkFile> {
    events: EventReader<R>,
    decoder: Decoder,
}

impl DownlinkReader<DownlinkFile> {
    /// Opens a file.
    ///
    /// # Errors
    /// The file cannot be opened.
    pub fn open(path: &Path) -> Result<Self, DownlinkError> {
        Ok(Self { events: EventReader::open(path)?, decoder: Decoder::new() })
    }
}

impl<R: Read> DownlinkReader<R> {
    /// Reads from any source; `path` names it in errors.
    #[must_use]
    #[doc(hidden)]
    pub fn new(source: R, path: &Path) -> Self {
        Self { events: EventReader::new(source, path), decoder: Decoder::new() }
    }

    /// Continues with the decoder of an earlier file, with its instrument description and counters.
    #[must_use]
    #[doc(hidden)]
    pub fn with_decoder(self, decoder: Decoder) -> Self {
        Self { decoder, ..self }
    }

    /// The decoder, for the next file.
    #[must_use]
    #[doc(hidden)]
    pub fn into_decoder(self) -> Decoder {
        self.decoder
    }

    /// The next frame; `None` at the end of the file.
    ///
    /// # Errors
    /// The file cannot be read, is empty, or contains no packet. Damage is counted instead.
    pub fn next_frame(&mut self) -> Result<Option<GroundFrame>, DownlinkError> {
        let frame = self.events.find(|event| self.decoder.accept(event))?;
        if frame.is_none() {
            self.decoder.finish();
            self.events.require_packets()?;
        }
        Ok(frame)
    }

    /// The counters so far.
    #[must_use]
    pub fn counters(&self) -> &ReceptionCounters {
        self.decoder.counters()
    }

    /// Number of bytes read.
    #[must_use]
    pub fn bytes(&self) -> u64 {
        self.events.receiver().bytes()
    }

    /// The counters of the coded frames; `None` for a file of packets.
    #[must_use]
    #[doc(hidden)]
    pub fn frames(&self) -> Option<FrameCounters> {
        self.events.receiver().frames()
    }
}
