//! Bytes of a downlink to packets, whichever format they are in.

use std::io::{self, Read};

use super::cadu::{CaduReceiver, FrameCounters};
use super::{Event, PacketReceiver};
use crate::downlink::wire::{Format, Kind};

/// Bytes that [`Intake::fill_from`] asks for at a time.
const CHUNK_BYTES: usize = 1 << 18;

/// Finds packets in a stream of either format, given in chunks of any size.
///
/// Content tells: the format is that of which a packet or a frame is found first, none of which are found in the
/// other by chance. Use it as a [`PacketReceiver`]. Of a coded stream, offsets of events count in the packets that
/// were recovered from it.
#[derive(Debug, Default)]
pub struct Intake {
    format: Option<Format>,
    packets: PacketReceiver,
    frames: CaduReceiver,
    bytes: u64,
    chunk: Vec<u8>,
    recovered: Vec<u8>,
    unfiltered: bool,
}

impl Intake {
    /// An intake at the start of a stream.
    #[must_use]
    pub fn new() -> Self {
        Self::default()
    }

    /// An intake whose receiver is [`PacketReceiver::unfiltered`].
    #[must_use]
    pub fn unfiltered() -> Self {
        Self { unfiltered: true, packets: PacketReceiver::unfiltered(), ..Self::default() }
    }

    /// Takes the next bytes of the stream.
    pub fn push(&mut self, bytes: &[u8]) {
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

    /// Takes the next bytes from a reader; returns how many, 0 at its end.
    ///
    /// # Errors
    /// Those of the reader, interruptions excepted.
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

    /// Says that the stream is at its end.
    pub fn finish(&mut self) {
        if self.format != Some(Format::Packets) {
            self.recovered.clear();
            self.frames.finish(&mut self.recovered);
            self.take_recovered();
        }
        self.packets.finish();
    }

    /// The next event; `None` until more bytes come, or when all is said.
    pub fn next_event(&mut self) -> Option<Event<'_>> {
        // What garbage is can only be said once the format is known, or at the end.
        if self.format.is_none() && !self.packets.is_finished() {
            return None;
        }
        self.packets.next_event()
    }

    /// Bytes taken so far.
    #[must_use]
    pub fn bytes(&self) -> u64 {
        self.bytes
    }

    /// Memory taken for the stream, bytes.
    #[must_use]
    pub fn held_bytes(&self) -> usize {
        let chunks = self.chunk.capacity() + self.recovered.capacity();
        self.packets.held_bytes() + self.frames.held_bytes() + chunks
    }

    /// Times that the spacecraft has begun to count packets of a kind anew, in whatever order they came.
    pub(crate) fn restarts(&self, kind: Kind) -> u64 {
        self.packets.restarts(kind)
    }

    /// The format, once it is known.
    #[must_use]
    pub fn format(&self) -> Option<Format> {
        self.format
    }

    /// The account of the frames, if there are any.
    #[must_use]
    pub fn frames(&self) -> Option<FrameCounters> {
        (self.format == Some(Format::Cadu)).then(|| self.frames.counters())
    }

    /// Hands on what the frames have given; the first frame settles the format.
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
