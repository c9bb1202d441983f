//! Bytes to packets, robust against any damage by a link or a disk.

use std::collections::VecDeque;
use std::io::{self, Read};

use super::sequence::{Arrival, Sequence};
use crate::downlink::wire::cadu::framer::{IDLE_APID, PACKET_HEADER_BYTES as PRIMARY_HEADER_BYTES};
use crate::downlink::wire::{
    HEADER_BYTES, PacketHeader, PacketKind, TRAILER_BYTES, packet_checksum, has_valid_checksum,
};

/// Bytes that [`PacketReceiver::fill_from`] reads at a time.
const CHUNK_BYTES: usize = 1 << 18;

/// First byte of an idle packet of telemetry; that of a command has one bit more.
const IDLE_FIRST_BYTE: u8 = (IDLE_APID >> 8) as u8;

/// A sound packet: its checksums are right.
#[derive(Clone, Copy, Debug)]
pub struct Packet<'a> {
    /// Offset in the stream, bytes.
    pub offset: u64,
    /// Its headers.
    pub header: PacketHeader,
    /// The payload, without headers and checksum.
    pub payload: &'a [u8],
    /// Its checksum, over headers and payload.
    pub check: u32,
    /// Whether it fills a gap reported earlier.
    pub late: bool,
}

impl Packet<'_> {
    /// Appends it as it was sent. Parsed headers hold every bit of the originals.
    pub(crate) fn append_to(&self, out: &mut Vec<u8>) {
        let start = out.len();
        out.reserve(self.header.bytes.min(HEADER_BYTES + self.payload.len() + TRAILER_BYTES));
        out.extend_from_slice(&self.header.to_bytes());
        out.extend_from_slice(self.payload);
        let check = packet_checksum(&out[start..]);
        out.extend_from_slice(&check);
    }
}

/// What a stream contains, in order. Events other than [`Event::Gap`] and [`Event::Restart`] cover each byte of the
/// stream exactly once.
#[derive(Clone, Copy, Debug)]
#[non_exhaustive]
pub enum Event<'a> {
    /// A sound packet.
    Packet(Packet<'a>),
    /// A sound packet received before.
    Duplicate {
        /// Offset in the stream, bytes.
        offset: u64,
        /// Its headers.
        header: PacketHeader,
    },
    /// A packet with sound headers and a bad packet checksum.
    Damaged {
        /// Offset in the stream, bytes.
        offset: u64,
        /// Its headers.
        header: PacketHeader,
        /// Bytes skipped: the packet, or only its headers if no other packet follows where it should end.
        bytes: u64,
    },
    /// Packets of a kind are missing: counts from `expected` to just below that of the next packet.
    Gap {
        /// Offset of the next packet, bytes.
        offset: u64,
        /// Headers of the next packet.
        header: PacketHeader,
        /// Count of the first missing packet.
        expected: u64,
    },
    /// The spacecraft restarted its packet count.
    Restart {
        /// Offset of the next packet, bytes.
        offset: u64,
        /// Headers of the next packet.
        header: PacketHeader,
        /// The count that was due.
        expected: u64,
    },
    /// Idle packets (APID 0x7FF), which fill a stream and say nothing.
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
        /// Bytes of it in the stream.
        bytes: u64,
    },
}

/// An event without its bytes. Except for gaps and restarts, handing it out consumes the bytes it covers.
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

/// What begins at the first unconsumed byte.
enum PacketMatch {
    /// A sound packet.
    Good(PacketHeader),
    /// Sound headers of a damaged packet; bytes to skip.
    Bad(PacketHeader, usize),
    /// An idle packet, with its bytes.
    Idle(usize),
    /// Headers of a packet in which the stream ends.
    Cut,
    /// More bytes are needed to decide.
    Unknown,
    /// No downlink packet.
    Nothing,
}

/// Finds packets in a stream of bytes, given in chunks of any size.
///
/// Push bytes, then take events until there are none. At the end call [`PacketReceiver::finish`] and take the rest.
/// Used so, memory stays below the longest packet plus twice the longest chunk.
///
/// Idle packets (APID 0x7FF) between packets are passed over.
///
/// After damage it searches for the next sound headers. Time is linear in the stream: a packet checksum is computed
/// once per sound headers, which noise yields once in 10^11 bytes and a forger at most once in 22.
#[derive(Debug, Default)]
pub struct PacketReceiver {
    buffer: Vec<u8>,
    /// Unconsumed bytes of the buffer: `begin..end`.
    begin: usize,
    end: usize,
    /// Offset of `buffer[0]` in the stream.
    offset: u64,
    /// Where the current run of garbage began.
    garbage_from: Option<u64>,
    /// Where, near the end, headers of an incomplete packet were found.
    cut_at: Option<u64>,
    finished: bool,
    pending: VecDeque<PendingEvent>,
    sequences: [Sequence; PacketKind::ALL.len()],
    /// Whether packet counts are left to the caller.
    unfiltered: bool,
}

impl PacketReceiver {
    /// A receiver at the start of a stream.
    #[must_use]
    pub fn new() -> Self {
        Self::default()
    }

    /// A receiver that hands out every sound packet, duplicates too, and reports no gaps: for callers that keep a
    /// received set of their own.
    #[must_use]
    pub fn unfiltered() -> Self {
        Self { unfiltered: true, ..Self::default() }
    }

    /// Takes the next bytes of the stream.
    pub fn push(&mut self, bytes: &[u8]) {
        self.room(bytes.len()).copy_from_slice(bytes);
        self.end += bytes.len();
    }

    /// Takes the next bytes from a reader without an extra copy; returns their number, 0 at its end.
    ///
    /// # Errors
    /// Those of the reader, except interruptions.
    pub fn fill_from(&mut self, reader: &mut impl Read) -> io::Result<usize> {
        loop {
            match reader.read(self.room(CHUNK_BYTES)) {
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
        self.finished = true;
    }

    /// Whether the stream has ended.
    pub(super) fn is_finished(&self) -> bool {
        self.finished
    }

    /// Whether the headers of a packet, sound or damaged, come next after garbage.
    pub(super) fn has_header(&mut self) -> bool {
        if self.pending.is_empty() {
            self.look();
        }
        let of_packet = |next: &PendingEvent| {
            matches!(
                next,
                PendingEvent::Packet { .. }
                    | PendingEvent::Duplicate(_)
                    | PendingEvent::Damaged(..)
                    | PendingEvent::Idle(_)
            )
        };
        self.pending.iter().any(of_packet)
    }

    /// Restarts of the packet count of a kind, independent of the order of arrival.
    pub(super) fn restarts(&self, kind: PacketKind) -> u64 {
        self.sequences[kind.index()].restarts()
    }

    /// Bytes received so far.
    #[must_use]
    pub fn bytes(&self) -> u64 {
        self.offset + self.end as u64
    }

    /// Memory held for the stream, bytes.
    #[must_use]
    pub fn held_bytes(&self) -> usize {
        self.buffer.capacity()
    }

    /// The next event; `None` until more bytes arrive, or at the end of the stream.
    pub fn next_event(&mut self) -> Option<Event<'_>> {
        if self.pending.is_empty() {
            self.look();
        }
        let next = self.pending.pop_front()?;
        let offset = self.offset + self.begin as u64;
        Some(match next {
            PendingEvent::Packet { header, late } => {
                let packet = &self.buffer[self.begin..self.begin + header.bytes];
                self.begin += header.bytes;
                let payload = &packet[HEADER_BYTES..packet.len() - TRAILER_BYTES];
                let check = packet.last_chunk().map_or(0, |check| u32::from_be_bytes(*check));
                Event::Packet(Packet { offset, header, payload, check, late })
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

    /// Space for `bytes` more bytes at the end of the buffer.
    fn room(&mut self, bytes: usize) -> &mut [u8] {
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
    fn look(&mut self) {
        while self.begin < self.end {
            match self.find() {
                PacketMatch::Good(header) => return self.take_good(header),
                PacketMatch::Bad(header, bytes) => return self.take_damaged(header, bytes),
                PacketMatch::Idle(bytes) => return self.pending.push_back(PendingEvent::Idle(bytes)),
                PacketMatch::Unknown => return,
                PacketMatch::Cut => {
                    self.cut_at.get_or_insert(self.offset + self.begin as u64);
                    self.pass_garbage();
                }
                PacketMatch::Nothing => self.pass_garbage(),
            }
        }
        if self.finished {
            self.take_rest();
        }
    }

    /// Examines the beginning of the unconsumed bytes.
    fn find(&self) -> PacketMatch {
        let rest = &self.buffer[self.begin..self.end];
        // Idle packets have no checksum: they are taken for such only where a packet is due.
        if self.garbage_from.is_none()
            && let Some(idle) = self.find_idle(rest)
        {
            return idle;
        }
        let Some(bytes) = rest.get(..HEADER_BYTES) else {
            // Too short for headers: the beginning of a packet if it follows one and looks like one.
            return match (self.finished, rest[0] == PacketHeader::FIRST_BYTE) {
                (_, false) => PacketMatch::Nothing,
                (false, true) => PacketMatch::Unknown,
                (true, true) if self.garbage_from.is_none() => PacketMatch::Cut,
                (true, true) => PacketMatch::Nothing,
            };
        };
        let Some(header) = PacketHeader::parse(bytes) else { return PacketMatch::Nothing };
        let Some(packet) = rest.get(..header.bytes) else {
            return if self.finished { PacketMatch::Cut } else { PacketMatch::Unknown };
        };
        if has_valid_checksum(packet) {
            return PacketMatch::Good(header);
        }
        let after = &rest[header.bytes..];
        if after.len() < HEADER_BYTES && !self.finished {
            return PacketMatch::Unknown;
        }
        let another_follows = match after.first() {
            None => true,
            Some(first) if after.len() < HEADER_BYTES => *first == PacketHeader::FIRST_BYTE,
            Some(_) => PacketHeader::parse(after).is_some(),
        };
        PacketMatch::Bad(header, if another_follows { header.bytes } else { HEADER_BYTES })
    }

    /// An idle packet at the beginning of `rest`; another packet, or the end, must follow it.
    fn find_idle(&self, rest: &[u8]) -> Option<PacketMatch> {
        let begins = |bytes: &[u8]| matches!(bytes, [first, 0xFF, ..] if first & 0xEF == IDLE_FIRST_BYTE);
        if !begins(rest) {
            return None;
        }
        let undecided = if self.finished { PacketMatch::Cut } else { PacketMatch::Unknown };
        let Some(&[.., high, low]) = rest.first_chunk::<PRIMARY_HEADER_BYTES>() else {
            return Some(undecided);
        };
        let bytes = PRIMARY_HEADER_BYTES + 1 + usize::from(u16::from_be_bytes([high, low]));
        let Some(after) = rest.get(bytes..) else { return Some(undecided) };
        if after.len() < HEADER_BYTES && !self.finished {
            return Some(PacketMatch::Unknown);
        }
        let follows = after.is_empty() || begins(after) || PacketHeader::parse(after).is_some();
        follows.then_some(PacketMatch::Idle(bytes))
    }

    /// Skips one byte, then all up to the next that could begin a packet.
    fn pass_garbage(&mut self) {
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

    fn take_good(&mut self, header: PacketHeader) {
        let arrival = match self.unfiltered {
            true => Arrival::InOrder,
            false => self.sequences[header.kind.index()].receive(header.count, header.time),
        };
        self.announce(header, arrival);
        self.pending.push_back(match arrival {
            Arrival::Duplicate => PendingEvent::Duplicate(header),
            other => PendingEvent::Packet { header, late: other == Arrival::Late },
        });
    }

    fn take_damaged(&mut self, header: PacketHeader, bytes: usize) {
        let arrival = match self.unfiltered {
            true => Arrival::InOrder,
            false => self.sequences[header.kind.index()].pass_damaged(header.count, header.time),
        };
        self.announce(header, arrival);
        self.pending.push_back(PendingEvent::Damaged(header, bytes));
    }

    /// Queues what precedes a packet: garbage, a gap or a restart.
    fn announce(&mut self, header: PacketHeader, arrival: Arrival) {
        self.cut_at = None;
        self.end_garbage(self.offset + self.begin as u64);
        match arrival {
            Arrival::AfterGap { expected } => self.pending.push_back(PendingEvent::Gap { header, expected }),
            Arrival::Restart { expected } => {
                self.pending.push_back(PendingEvent::Restart { header, expected })
            }
            Arrival::InOrder | Arrival::Late | Arrival::Early | Arrival::Duplicate => {}
        }
    }

    /// At the end of the stream, the rest is garbage, then perhaps the beginning of a packet.
    fn take_rest(&mut self) {
        let end = self.offset + self.end as u64;
        let cut_at = self.cut_at.take().unwrap_or(end);
        self.end_garbage(cut_at);
        if cut_at < end {
            let bytes = (end - cut_at) as usize;
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

    /// Bytes that a stream's events cover, and the most that the receiver held. It must have read all of it.
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
            if receiver.finished {
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
    fn forged_headers_without_bodies_end_in_time() {
        // Each announces the longest packet, so that each makes the receiver check 64 KiB.
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
