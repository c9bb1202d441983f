//! A receiver of packets from a stream of either format.

use std::io::{self, Read};

use super::cadu::{CaduReceiver, FrameCounters};
use super::format_detection::{HEAD_BYTES, identify, identify_unsupported_frames};
use super::{Event, PacketReceiver};
use crate::downlink::wire::{Format, PacketKind};

/// Number of bytes that [`DownlinkReceiver::fill_from`] requests at a time.
const CHUNK_BYTES: usize = 1 << 18;

/// Finds packets in a stream of either format, given in chunks of any size. Used like a [`PacketReceiver`].
///
/// Detects the format by the first packet or coded frame, neither of which occurs in the other format by chance. In a
/// coded stream, offsets of events count recovered packet bytes.
#[derive(Debug, Default)]
pub struct DownlinkReceiver {
    format: Option<Format>,
    packets: PacketReceiver,
    frames: CaduReceiver,
    bytes: u64,
    chunk: Vec<u8>,
    recovered: Vec<u8>,
    unfiltered: bool,
    head: Vec<u8>,
}

impl DownlinkReceiver {
    /// A receiver at the start of a stream.
    #[must_use]
    pub fn new() -> Self {
        Self::default()
    }

    /// A receiver that returns every valid packet, see [`PacketReceiver::unfiltered`].
    #[must_use]
    pub fn unfiltered() -> Self {
        Self { unfiltered: true, packets: PacketReceiver::unfiltered(), ..Self::default() }
    }

    /// Takes the next bytes of the stream.
    pub fn push(&mut self, bytes: &[u8]) {
        self.push_with(bytes, CaduReceiver::push);
    }

    /// Takes the next bytes of the stream, a datagram that begins with a coded frame.
    pub fn push_frame(&mut self, bytes: &[u8]) {
        self.push_with(bytes, CaduReceiver::push_frame);
    }

    fn push_with(&mut self, bytes: &[u8], push: fn(&mut CaduReceiver, &[u8], &mut Vec<u8>)) {
        self.keep_head(bytes);
        self.bytes += bytes.len() as u64;
        if self.format != Some(Format::Cadu) {
            self.packets.push(bytes);
        }
        if self.format.is_none() && self.packets.has_any_packet() {
            self.format = Some(Format::Packets);
            self.frames = CaduReceiver::new();
        }
        if self.format != Some(Format::Packets) {
            self.recovered.clear();
            push(&mut self.frames, bytes, &mut self.recovered);
            self.forward_recovered();
        }
    }

    /// Takes the next bytes from a reader; returns their number, 0 at its end.
    ///
    /// # Errors
    /// The errors of the reader, except interruptions.
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
            self.forward_recovered();
        }
        self.packets.finish();
    }

    /// The next event; `None` until more bytes arrive, or at the end of the stream.
    pub fn next_event(&mut self) -> Option<Event<'_>> {
        // Before the format is known, bytes without packets may still be frames.
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

    /// Memory allocated for the stream, bytes.
    #[must_use]
    pub fn memory_bytes(&self) -> usize {
        let chunks = self.chunk.capacity() + self.recovered.capacity();
        self.packets.memory_bytes() + self.frames.memory_bytes() + chunks
    }

    /// Identifies a stream that is not a downlink from its first bytes; `None` if they are not recognised.
    #[must_use]
    #[doc(hidden)]
    pub fn foreign_format(&self) -> Option<String> {
        identify(&self.head)
    }

    /// Identifies transfer frames of an unsupported format, in which parts of packets may be found by chance.
    #[must_use]
    pub(in crate::downlink) fn unsupported_frames(&self) -> Option<String> {
        identify_unsupported_frames(&self.head)
    }

    /// Whether the first [`HEAD_BYTES`] bytes have been received.
    pub(super) fn has_full_head(&self) -> bool {
        self.head.len() == HEAD_BYTES
    }

    fn keep_head(&mut self, bytes: &[u8]) {
        let missing = HEAD_BYTES - self.head.len();
        self.head.extend_from_slice(&bytes[..missing.min(bytes.len())]);
    }

    /// Number of restarts of the packet count of a kind, in any order of arrival.
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

    /// Forwards recovered packets to the packet receiver. The first frame decides the format.
    fn forward_recovered(&mut self) {
        if self.format.is_none() && self.frames.has_frame() {
            self.format = Some(Format::Cadu);
            self.packets = if self.unfiltered { PacketReceiver::unfiltered() } else { PacketReceiver::new() };
        }
        if !self.recovered.is_empty() {
            self.packets.push(&self.recovered);
        }
    }
}
