//! Bytes to packets, for either format.

use std::io::{self, Read};

use super::cadu::{CaduReceiver, FrameCounters};
use super::foreign::{HEAD_BYTES, frames_of, name_of};
use super::{Event, PacketReceiver};
use crate::downlink::wire::{Format, PacketKind};

/// Bytes that [`DownlinkReceiver::fill_from`] asks for at a time.
const CHUNK_BYTES: usize = 1 << 18;

/// Finds packets in a stream of either format, given in chunks of any size.
///
/// Detects the format by content: by the first packet or coded frame, neither of which occurs in the other format by
/// chance. Used like a [`PacketReceiver`]. In a coded stream, offsets of events count recovered packet bytes.
#[derive(Debug, Default)]
pub struct DownlinkReceiver {
    format: Option<Format>,
    packets: PacketReceiver,
    frames: CaduReceiver,
    bytes: u64,
    chunk: Vec<u8>,
    recovered: Vec<u8>,
    unfiltered: bool,
    /// The first bytes of the stream.
    head: Vec<u8>,
}

impl DownlinkReceiver {
    /// An intake at the start of a stream.
    #[must_use]
    pub fn new() -> Self {
        Self::default()
    }

    /// An intake with a [`PacketReceiver::unfiltered`].
    #[must_use]
    pub fn unfiltered() -> Self {
        Self { unfiltered: true, packets: PacketReceiver::unfiltered(), ..Self::default() }
    }

    /// Takes the next bytes of the stream.
    pub fn push(&mut self, bytes: &[u8]) {
        self.keep_head(bytes);
        self.bytes += bytes.len() as u64;
        if self.format != Some(Format::Cadu) {
            self.packets.push(bytes);
        }
        if self.format.is_none() && self.packets.has_header() {
            self.format = Some(Format::Packets);
            self.frames = CaduReceiver::new();
        }
        if self.format != Some(Format::Packets) {
            self.recovered.clear();
            self.frames.push(bytes, &mut self.recovered);
            self.take_recovered();
        }
    }

    /// Takes the next bytes from a reader; returns their number, 0 at its end.
    ///
    /// # Errors
    /// Those of the reader, except interruptions.
    pub fn fill_from(&mut self, reader: &mut impl Read) -> io::Result<usize> {
        if self.format == Some(Format::Packets) {
            let bytes = self.packets.fill_from(reader)?;
            self.bytes += bytes as u64;
            return Ok(bytes);
        }
        let mut chunk = std::mem::take(&mut self.chunk);
        chunk.resize(CHUNK_BYTES, 0);
        let read = loop {
            match reader.read(&mut chunk) {
                Err(error) if error.kind() == io::ErrorKind::Interrupted => {}
                other => break other,
            }
        };
        if let Ok(bytes) = read {
            self.push(&chunk[..bytes]);
        }
        self.chunk = chunk;
        read
    }

    /// Ends the stream.
    pub fn finish(&mut self) {
        if self.format != Some(Format::Packets) {
            self.recovered.clear();
            self.frames.finish(&mut self.recovered);
            self.take_recovered();
        }
        self.packets.finish();
    }

    /// The next event; `None` until more bytes arrive, or at the end of the stream.
    pub fn next_event(&mut self) -> Option<Event<'_>> {
        // Bytes can be called garbage only once the format is known, or at the end.
        if self.format.is_none() && !self.packets.is_finished() {
            return None;
        }
        self.packets.next_event()
    }

    /// Bytes received so far.
    #[must_use]
    pub fn bytes(&self) -> u64 {
        self.bytes
    }

    /// Memory held for the stream, bytes.
    #[must_use]
    pub fn held_bytes(&self) -> usize {
        let chunks = self.chunk.capacity() + self.recovered.capacity();
        self.packets.held_bytes() + self.frames.held_bytes() + chunks
    }

    /// What the stream is, as far as its first bytes tell, if it is no downlink.
    #[must_use]
    #[doc(hidden)]
    pub fn foreign_name(&self) -> Option<String> {
        name_of(&self.head)
    }

    /// Transfer frames of another kind, in which packets may be seen by chance: what they are.
    #[must_use]
    pub(in crate::downlink) fn foreign_frames(&self) -> Option<String> {
        frames_of(&self.head)
    }

    /// Whether as much is held of the beginning as will be.
    pub(super) fn has_whole_head(&self) -> bool {
        self.head.len() == HEAD_BYTES
    }

    fn keep_head(&mut self, bytes: &[u8]) {
        let room = HEAD_BYTES - self.head.len();
        self.head.extend_from_slice(&bytes[..room.min(bytes.len())]);
    }

    /// Restarts of the packet count of a kind, independent of the order of arrival.
    pub(super) fn restarts(&self, kind: PacketKind) -> u64 {
        self.packets.restarts(kind)
    }

    /// The format, once it is known.
    #[must_use]
    pub fn format(&self) -> Option<Format> {
        self.format
    }

    /// The frame counters of a coded stream.
    #[must_use]
    pub fn frames(&self) -> Option<FrameCounters> {
        (self.format == Some(Format::Cadu)).then(|| self.frames.counters())
    }

    /// Passes recovered packets on. The first frame decides the format.
    fn take_recovered(&mut self) {
        if self.format.is_none() && self.frames.has_frame() {
            self.format = Some(Format::Cadu);
            self.packets = if self.unfiltered { PacketReceiver::unfiltered() } else { PacketReceiver::new() };
        }
        if !self.recovered.is_empty() {
            self.packets.push(&self.recovered);
        }
    }
}
