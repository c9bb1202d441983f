//! A receiver of packets from bytes with any damage by a link or a disk.

use std::collections::VecDeque;
use std::io::{self, Read};

use super::sequence::{Arrival, Sequence};
use crate::downlink::wire::cadu::framer::{IDLE_APID, PACKET_HEADER_BYTES as PRIMARY_HEADER_BYTES};
use crate::downlink::wire::{
    HEADER_BYTES, PacketHeader, PacketKind, TRAILER_BYTES, has_valid_checksum, packet_checksum,
};

/// Number of bytes that [`PacketReceiver::fill_from`] requests at a time.
const CHUNK_BYTES: usize = 1 << 18;

/// First byte of an idle packet of telemetry; an idle command packet differs in one bit.
const IDLE_FIRST_BYTE: u8 = (IDLE_APID >> 8) as u8;

/// A packet with valid checksums.
#[derive(Clone, Copy, Debug)]
pub struct Packet<'a> {
    /// Offset in the stream, bytes.
    pub offset: u64,
    /// The headers.
    pub header: PacketHeader,
    /// The payload, without headers and checksum.
    pub payload: &'a [u8],
    /// The packet checksum, over headers and payload.
    pub checksum: u32,
    /// Whether the packet fills a gap that was reported earlier.
    pub late: bool,
}

impl Packet<'_> {
    /// Appends the packet as it was sent. Encoding parsed headers restores every bit.
    #[doc(hidden)]
    pub fn append_to(&self, out: &mut Vec<u8>) {
        let start = out.len();
        out.reserve(self.header.bytes.min(HEADER_BYTES + self.payload.len() + TRAILER_BYTES));
        out.extend_from_slice(&self.header.to_bytes());
        out.extend_from_slice(self.payload);
        let check = packet_checksum(&out[start..]);
        out.extend_from_slice(&check);
    }
}

/// An item of a stream, in order. Events other than [`Event::Gap`] and [`Event::Restart`] cover each byte of the stream
/// exactly once.
#[derive(Clone, Copy, Debug)]
#[non_exhaustive]
pub enum Event<'a> {
    /// A valid packet.
    Packet(Packet<'a>),
    /// A valid packet that was received before.
    Duplicate {
        /// Offset in the stream, bytes.
        offset: u64,
        /// The headers.
        header: PacketHeader,
    },
    /// A packet with valid headers and an invalid packet checksum.
    Damaged {
        /// Offset in the stream, bytes.
        offset: u64,
        /// The headers.
        header: PacketHeader,
        /// Number of bytes skipped: the packet, or only its headers if no other packet follows it.
        bytes: u64,
    },
    /// Packets of a kind are missing, with sequence counts from `expected` to just below that of the next packet.
    Gap {
        /// Offset of the next packet, bytes.
        offset: u64,
        /// Headers of the next packet.
        header: PacketHeader,
        /// Sequence count of the first missing packet.
        expected: u64,
    },
    /// The spacecraft restarted its sequence count.
    Restart {
        /// Offset of the next packet, bytes.
        offset: u64,
        /// Headers of the next packet.
        header: PacketHeader,
        /// The sequence count expected without a restart.
        expected: u64,
    },
    /// An idle packet (APID 0x7FF), which fills a stream without data.
    Idle {
        /// Offset in the stream, bytes.
        offset: u64,
        /// Number of bytes.
        bytes: u64,
    },
    /// Bytes that belong to no packet.
    Garbage {
        /// Offset in the stream, bytes.
        offset: u64,
        /// Number of bytes.
        bytes: u64,
    },
    /// The stream ends within a packet.
    Truncated {
        /// Offset of the packet, bytes.
        offset: u64,
        /// Number of its bytes in the stream.
        bytes: u64,
    },
}

/// A queued event without its bytes. Returning it consumes the bytes it covers; gaps and restarts cover none.
#[derive(Clone, Copy, Debug)]
enum PendingEvent {
    Packet { header: PacketHeader, late: bool },
    Duplicate(PacketHeader),
    Damaged(PacketHeader, usize),
    Idle(usize),
    Gap { header: PacketHeader, expected: u64 },
    Restart { header: PacketHeader, expected: u64 },
    Garbage { offset: u64, bytes: u64 },
    Truncated { bytes: usize },
}

/// The result of examining the first unconsumed bytes.
enum PacketMatch {
    /// A valid packet.
    Valid(PacketHeader),
    /// A damaged packet with valid headers, and the number of bytes to skip.
    Damaged(PacketHeader, usize),
    /// An idle packet of this number of bytes.
    Idle(usize),
    /// A packet in which the stream ends.
    Truncated,
    /// More bytes are needed to decide.
    Undecided,
    /// No downlink packet.
    NoPacket,
}

/// Finds packets in a stream of bytes, given in chunks of any size.
///
/// Push bytes, then take events until there are none. At the end call [`PacketReceiver::finish`] and take the remaining
/// events. Memory then stays below the longest packet plus twice the longest chunk.
///
/// After damage it searches for the next valid headers. Time is linear in the stream: a packet checksum is computed only
/// after valid headers, which occur once in 10^11 bytes of noise and at most once in 22 bytes of forged data.
#[derive(Debug, Default)]
pub struct PacketReceiver {
    buffer: Vec<u8>,
    /// Unconsumed bytes of the buffer: `begin..end`.
    begin: usize,
    end: usize,
    /// Offset of `buffer[0]` in the stream.
    offset: u64,
    /// Start of the current run of garbage.
    garbage_from: Option<u64>,
    /// Start of a packet in which the stream may end.
    truncated_from: Option<u64>,
    is_finished: bool,
    pending: VecDeque<PendingEvent>,
    sequences: [Sequence; PacketKind::ALL.len()],
    /// Whether sequence counts are left to the caller.
    unfiltered: bool,
}

impl PacketReceiver {
    /// A receiver at the start of a stream.
    #[must_use]
    pub fn new() -> Self {
        Self::default()
    }

    /// A receiver that returns every valid packet, including duplicates, and reports no gaps, for callers that keep their own
    /// received set.
    #[must_use]
    pub fn unfiltered() -> Self {
        Self { unfiltered: true, ..Self::default() }
    }

    /// Takes the next bytes of the stream.
    pub fn push(&mut self, bytes: &[u8]) {
        self.reserve(bytes.len()).copy_from_slice(bytes);
        self.end += bytes.len();
    }

    /// Takes the next bytes from a reader without an extra copy; returns their number, 0 at its end.
    ///
    /// # Errors
    /// The errors of the reader, except interruptions.
    pub fn fill_from(&mut self, reader: &mut impl Read) -> io::Result<usize> {
        loop {
            match reader.read(self.reserve(CHUNK_BYTES)) {
                Ok(bytes) => {
                    self.end += bytes;
                    return Ok(bytes);
                }
                Err(error) if error.kind() == io::ErrorKind::Interrupted => {}
                Err(error) => return Err(error),
            }
        }
    }

    /// Ends the stream.
    pub fn finish(&mut self) {
        self.is_finished = true;
    }

    pub(super) fn is_finished(&self) -> bool {
        self.is_finished
    }

    /// Whether the next events contain a packet, valid, damaged or idle.
    pub(super) fn has_any_packet(&mut self) -> bool {
        if self.pending.is_empty() {
            self.queue_next();
        }
        self.pending.iter().any(|event| {
            matches!(
                event,
                PendingEvent::Packet { .. }
                    | PendingEvent::Duplicate(_)
                    | PendingEvent::Damaged(..)
                    | PendingEvent::Idle(_)
            )
        })
    }

    /// Number of restarts of the sequence count of a kind, whatever the order of arrival.
    pub(super) fn restarts(&self, kind: PacketKind) -> u64 {
        self.sequences[kind.index()].restarts()
    }

    /// Bytes received so far.
    #[must_use]
    pub fn bytes(&self) -> u64 {
        self.offset + self.end as u64
    }

    /// Memory allocated for the stream, bytes.
    #[must_use]
    pub fn memory_bytes(&self) -> usize {
        self.buffer.capacity()
    }

    /// The next event; `None` until more bytes arrive, or at the end of the stream.
    pub fn next_event(&mut self) -> Option<Event<'_>> {
        if self.pending.is_empty() {
            self.queue_next();
        }
        let next = self.pending.pop_front()?;
        let offset = self.offset + self.begin as u64;
        Some(match next {
            PendingEvent::Packet { header, late } => {
                let packet = &self.buffer[self.begin..self.begin + header.bytes];
                self.begin += header.bytes;
                let payload = &packet[HEADER_BYTES..packet.len() - TRAILER_BYTES];
                let checksum = packet.last_chunk().map_or(0, |bytes| u32::from_be_bytes(*bytes));
                Event::Packet(Packet { offset, header, payload, checksum, late })
            }
            PendingEvent::Duplicate(header) => {
                self.begin += header.bytes;
                Event::Duplicate { offset, header }
            }
            PendingEvent::Damaged(header, bytes) => {
                self.begin += bytes;
                Event::Damaged { offset, header, bytes: bytes as u64 }
            }
            PendingEvent::Idle(bytes) => {
                self.begin += bytes;
                Event::Idle { offset, bytes: bytes as u64 }
            }
            PendingEvent::Truncated { bytes } => {
                self.begin += bytes;
                Event::Truncated { offset, bytes: bytes as u64 }
            }
            PendingEvent::Garbage { offset, bytes } => Event::Garbage { offset, bytes },
            PendingEvent::Gap { header, expected } => Event::Gap { offset, header, expected },
            PendingEvent::Restart { header, expected } => Event::Restart { offset, header, expected },
        })
    }

    /// Makes space for `bytes` more bytes at the end of the buffer, and returns it.
    fn reserve(&mut self, bytes: usize) -> &mut [u8] {
        if self.end + bytes > self.buffer.len() {
            if self.begin > 0 {
                self.buffer.copy_within(self.begin..self.end, 0);
                self.offset += self.begin as u64;
                self.end -= self.begin;
                self.begin = 0;
            }
            if self.end + bytes > self.buffer.len() {
                self.buffer.resize(self.end + bytes, 0);
            }
        }
        &mut self.buffer[self.end..self.end + bytes]
    }

    /// Advances to the next packet, if it is complete, and queues its events.
    fn queue_next(&mut self) {
        while self.begin < self.end {
            match self.examine() {
                PacketMatch::Valid(header) => return self.queue_valid(header),
                PacketMatch::Damaged(header, bytes) => return self.queue_damaged(header, bytes),
                PacketMatch::Idle(bytes) => return self.pending.push_back(PendingEvent::Idle(bytes)),
                PacketMatch::Undecided => return,
                PacketMatch::Truncated => {
                    // Its headers may be chance: packets are sought inside it, and if there are none `queue_end` reports it.
                    self.truncated_from.get_or_insert(self.offset + self.begin as u64);
                    self.skip_garbage();
                }
                PacketMatch::NoPacket => self.skip_garbage(),
            }
        }
        if self.is_finished {
            self.queue_end();
        }
    }

    fn examine(&self) -> PacketMatch {
        let rest = &self.buffer[self.begin..self.end];
        // Idle packets have no checksum, so they are accepted only directly after a packet.
        if self.garbage_from.is_none()
            && let Some(idle) = self.examine_idle(rest)
        {
            return idle;
        }
        let Some(bytes) = rest.get(..HEADER_BYTES) else {
            // Too short for headers: a truncated packet if it directly follows another and its first byte fits.
            return match (self.is_finished, rest[0] == PacketHeader::FIRST_BYTE) {
                (_, false) => PacketMatch::NoPacket,
                (false, true) => PacketMatch::Undecided,
                (true, true) if self.garbage_from.is_none() => PacketMatch::Truncated,
                (true, true) => PacketMatch::NoPacket,
            };
        };
        let Some(header) = PacketHeader::parse(bytes) else { return PacketMatch::NoPacket };
        let Some(packet) = rest.get(..header.bytes) else {
            return if self.is_finished { PacketMatch::Truncated } else { PacketMatch::Undecided };
        };
        if has_valid_checksum(packet) {
            return PacketMatch::Valid(header);
        }
        let after = &rest[header.bytes..];
        if after.len() < HEADER_BYTES && !self.is_finished {
            return PacketMatch::Undecided;
        }
        let ends_cleanly = match after.first() {
            None => true,
            Some(first) if after.len() < HEADER_BYTES => *first == PacketHeader::FIRST_BYTE,
            Some(_) => PacketHeader::parse(after).is_some(),
        };
        PacketMatch::Damaged(header, if ends_cleanly { header.bytes } else { HEADER_BYTES })
    }

    /// Examines an idle packet at the beginning of `rest`. It is accepted if another packet, or the end, follows it.
    fn examine_idle(&self, rest: &[u8]) -> Option<PacketMatch> {
        let is_idle = |bytes: &[u8]| matches!(bytes, [first, 0xFF, ..] if first & 0xEF == IDLE_FIRST_BYTE);
        if !is_idle(rest) {
            return None;
        }
        let incomplete = if self.is_finished { PacketMatch::Truncated } else { PacketMatch::Undecided };
        let Some(&[.., high, low]) = rest.first_chunk::<PRIMARY_HEADER_BYTES>() else {
            return Some(incomplete);
        };
        let bytes = PRIMARY_HEADER_BYTES + 1 + usize::from(u16::from_be_bytes([high, low]));
        let Some(after) = rest.get(bytes..) else { return Some(incomplete) };
        if after.len() < HEADER_BYTES && !self.is_finished {
            return Some(PacketMatch::Undecided);
        }
        let ends_cleanly = after.is_empty() || is_idle(after) || PacketHeader::parse(after).is_some();
        ends_cleanly.then_some(PacketMatch::Idle(bytes))
    }

    /// Skips bytes up to the next one that could begin a packet, at least one.
    fn skip_garbage(&mut self) {
        self.garbage_from.get_or_insert(self.offset + self.begin as u64);
        self.begin += 1;
        let rest = &self.buffer[self.begin..self.end];
        self.begin += rest.iter().position(|o| *o == PacketHeader::FIRST_BYTE).unwrap_or(rest.len());
    }

    fn end_garbage(&mut self, end: u64) {
        if let Some(offset) = self.garbage_from.take().filter(|offset| *offset < end) {
            self.pending.push_back(PendingEvent::Garbage { offset, bytes: end - offset });
        }
    }

    fn queue_valid(&mut self, header: PacketHeader) {
        let arrival = match self.unfiltered {
            true => Arrival::InOrder,
            false => self.sequences[header.kind.index()].receive(header.count, header.time),
        };
        self.queue_before(header, arrival);
        self.pending.push_back(match arrival {
            Arrival::Duplicate => PendingEvent::Duplicate(header),
            other => PendingEvent::Packet { header, late: other == Arrival::Late },
        });
    }

    fn queue_damaged(&mut self, header: PacketHeader, bytes: usize) {
        let arrival = match self.unfiltered {
            true => Arrival::InOrder,
            false => self.sequences[header.kind.index()].receive_damaged(header.count, header.time),
        };
        self.queue_before(header, arrival);
        self.pending.push_back(PendingEvent::Damaged(header, bytes));
    }

    /// Queues the events that precede a packet: garbage, a gap or a restart.
    fn queue_before(&mut self, header: PacketHeader, arrival: Arrival) {
        self.truncated_from = None;
        self.end_garbage(self.offset + self.begin as u64);
        match arrival {
            Arrival::AfterGap { expected } => self.pending.push_back(PendingEvent::Gap { header, expected }),
            Arrival::Restart { expected } => {
                self.pending.push_back(PendingEvent::Restart { header, expected })
            }
            Arrival::InOrder | Arrival::Late | Arrival::Early | Arrival::Duplicate => {}
        }
    }

    /// Queues the events at the end of the stream: garbage, then the truncated packet, if there is one.
    fn queue_end(&mut self) {
        let end = self.offset + self.end as u64;
        let truncated_from = self.truncated_from.take().unwrap_or(end);
        self.end_garbage(truncated_from);
        if truncated_from < end {
            let bytes = (end - truncated_from) as usize;
            self.begin = self.end - bytes;
            self.pending.push_back(PendingEvent::Truncated { bytes });
        }
    }
}

#[cfg(test)]
mod tests {
    use rand::Rng;

    use super::*;
    use crate::downlink::wire::{CucTime, FORMAT_VERSION, PACKET_BYTES_MAX, PacketSegment};
    use crate::units::{StreamKind, random_stream};

    /// Number of bytes that a stream's events cover, and the maximum size of the buffer. Reads the whole stream.
    fn cover(stream: &mut impl Read) -> (u64, usize) {
        let mut receiver = PacketReceiver::new();
        let (mut covered, mut held) = (0, 0);
        loop {
            if receiver.fill_from(stream).unwrap() == 0 {
                receiver.finish();
            }
            while let Some(event) = receiver.next_event() {
                covered += match event {
                    Event::Packet(packet) => packet.header.bytes as u64,
                    Event::Duplicate { header, .. } => header.bytes as u64,
                    Event::Damaged { bytes, .. }
                    | Event::Idle { bytes, .. }
                    | Event::Garbage { bytes, .. }
                    | Event::Truncated { bytes, .. } => bytes,
                    Event::Gap { .. } | Event::Restart { .. } => 0,
                };
            }
            held = held.max(receiver.buffer.len());
            if receiver.is_finished {
                assert_eq!(covered, receiver.bytes());
                return (covered, held);
            }
        }
    }

    const HELD_MAX: usize = PACKET_BYTES_MAX + HEADER_BYTES + CHUNK_BYTES;

    #[test]
    fn a_hundred_megabytes_of_noise_take_bounded_memory() {
        struct Noise(rand_chacha::ChaCha8Rng, u64);
        impl Read for Noise {
            fn read(&mut self, out: &mut [u8]) -> io::Result<usize> {
                let bytes = out.len().min(self.1 as usize);
                self.0.fill_bytes(&mut out[..bytes]);
                self.1 -= bytes as u64;
                Ok(bytes)
            }
        }
        let mut noise = Noise(random_stream(2, StreamKind::Probe, [0, 0]), 100_000_000);
        let (covered, held) = cover(&mut noise);
        assert_eq!(covered, 100_000_000);
        assert!(held <= HELD_MAX, "{held}");
    }

    #[test]
    fn forged_headers_without_payloads_take_linear_time_and_bounded_memory() {
        // Each header claims the longest packet, so that the receiver computes a checksum of 64 KiB for each.
        let forged: Vec<u8> = (0..20_000)
            .flat_map(|count| {
                PacketHeader {
                    kind: PacketKind::Visibilities,
                    segment: PacketSegment::Whole,
                    count: 2 * count,
                    time: CucTime(1),
                    version: FORMAT_VERSION,
                    bytes: PACKET_BYTES_MAX,
                }
                .to_bytes()
            })
            .collect();
        let (covered, held) = cover(&mut forged.as_slice());
        assert_eq!(covered, forged.len() as u64);
        assert!(held <= HELD_MAX);
    }
}
