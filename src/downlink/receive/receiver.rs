//! Bytes to packets: the ground's end, robust against whatever a link or a disk does to them.

use std::collections::VecDeque;
use std::io::{self, Read};

use super::sequence::{Arrival, Sequence};
use crate::downlink::wire::{HEADER_BYTES, Kind, PacketHeader, TRAILER_BYTES, packet_holds};

/// Bytes that [`PacketReceiver::fill_from`] asks for at a time.
const CHUNK_BYTES: usize = 1 << 18;

/// A packet whose checks hold.
#[derive(Clone, Copy, Debug)]
pub struct Packet<'a> {
    /// Place in the stream.
    pub offset: u64,
    /// Its headers.
    pub header: PacketHeader,
    /// What it carries, without headers and check.
    pub payload: &'a [u8],
    /// Its check, over headers and payload.
    pub check: u32,
    /// Whether it fills a gap that has been reported.
    pub late: bool,
}

/// What a stream holds, in order. The bytes of all events but [`Event::Gap`] and [`Event::Restart`] together are
/// those of the stream.
#[derive(Clone, Copy, Debug)]
#[non_exhaustive]
pub enum Event<'a> {
    /// A packet.
    Packet(Packet<'a>),
    /// A good packet that has been here before.
    Duplicate {
        /// Place in the stream.
        offset: u64,
        /// Its headers.
        header: PacketHeader,
    },
    /// A packet whose headers hold but whose body does not.
    Damaged {
        /// Place in the stream.
        offset: u64,
        /// Its headers.
        header: PacketHeader,
        /// Bytes passed over: the packet, or its headers alone when no other packet follows where it
        /// should end.
        bytes: u64,
    },
    /// Packets of a kind are missing, from the count `expected` to before that of the next packet.
    Gap {
        /// Place of the next packet.
        offset: u64,
        /// Headers of the next packet.
        header: PacketHeader,
        /// Count of the first missing packet.
        expected: u64,
    },
    /// The spacecraft has begun to count anew.
    Restart {
        /// Place of the next packet.
        offset: u64,
        /// Headers of the next packet.
        header: PacketHeader,
        /// Count that was due.
        expected: u64,
    },
    /// Bytes that belong to no packet.
    Garbage {
        /// Place in the stream.
        offset: u64,
        /// How many.
        bytes: u64,
    },
    /// The stream ends within a packet.
    Truncated {
        /// Place of the packet.
        offset: u64,
        /// Bytes of it that are there.
        bytes: u64,
    },
}

/// An event without its bytes. All but gaps consume what they cover when they are handed out.
#[derive(Clone, Copy, Debug)]
enum PendingEvent {
    Packet { header: PacketHeader, late: bool },
    Duplicate(PacketHeader),
    Damaged(PacketHeader, usize),
    Gap { header: PacketHeader, expected: u64 },
    Restart { header: PacketHeader, expected: u64 },
    Garbage { offset: u64, bytes: u64 },
    Truncated { bytes: usize },
}

/// What stands at some place of the buffer.
enum PacketMatch {
    /// A whole packet.
    Good(PacketHeader),
    /// Headers whose packet does not hold; bytes to pass over.
    Bad(PacketHeader, usize),
    /// Headers of a packet that the stream ends in.
    Cut,
    /// More bytes are needed to say.
    Unknown,
    /// Nothing of ours.
    Nothing,
}

/// Finds packets in a stream of bytes, given in chunks of any size.
///
/// Push bytes, then take events until there are none; at the end call [`PacketReceiver::finish`] and take the rest.
/// Then the memory stays below the greatest packet plus twice the greatest chunk.
///
/// After damage it looks for the next headers whose check holds. Time is linear in the stream: a body is
/// checked once for each headers with a good check of their own, which noise yields once in 10^11 bytes
/// and a forger at most once in 22.
#[derive(Debug, Default)]
pub struct PacketReceiver {
    buffer: Vec<u8>,
    /// Bytes of the buffer that are not yet consumed.
    begin: usize,
    end: usize,
    /// Place of `buffer[0]` in the stream.
    offset: u64,
    /// Where the present run of garbage began.
    garbage_from: Option<u64>,
    /// Where headers were met at the end whose packet is not all there.
    cut_at: Option<u64>,
    finished: bool,
    steps: VecDeque<PendingEvent>,
    sequences: [Sequence; Kind::ALL.len()],
    /// Whether whoever takes the events keeps the account of packet counts.
    unfiltered: bool,
}

impl PacketReceiver {
    /// A receiver at the start of a stream.
    #[must_use]
    pub fn new() -> Self {
        Self::default()
    }

    /// A receiver that hands out every good packet, however often it comes, and says nothing of gaps: for those
    /// who know better what has been here before.
    #[must_use]
    pub fn unfiltered() -> Self {
        Self { unfiltered: true, ..Self::default() }
    }

    /// Takes the next bytes of the stream.
    pub fn push(&mut self, bytes: &[u8]) {
        self.room(bytes.len()).copy_from_slice(bytes);
        self.end += bytes.len();
    }

    /// Takes the next bytes from a reader, without a copy in between; returns how many, 0 at its end.
    ///
    /// # Errors
    /// Those of the reader, interruptions excepted.
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

    /// Says that the stream is at its end.
    pub fn finish(&mut self) {
        self.finished = true;
    }

    /// Whether the stream is at its end.
    pub(crate) fn is_finished(&self) -> bool {
        self.finished
    }

    /// Whether headers of a packet, sound or damaged, are what comes next after garbage.
    pub(crate) fn has_header(&mut self) -> bool {
        if self.steps.is_empty() {
            self.look();
        }
        let of_packet = |step: &PendingEvent| {
            matches!(
                step,
                PendingEvent::Packet { .. } | PendingEvent::Duplicate(_) | PendingEvent::Damaged(..)
            )
        };
        self.steps.iter().any(of_packet)
    }

    /// Times that the spacecraft has begun to count packets of a kind anew, in whatever order they came.
    pub(crate) fn restarts(&self, kind: Kind) -> u64 {
        self.sequences[kind.index()].restarts()
    }

    /// Bytes taken so far.
    #[must_use]
    pub fn bytes(&self) -> u64 {
        self.offset + self.end as u64
    }

    /// Memory taken for bytes of the stream.
    #[must_use]
    pub fn held_bytes(&self) -> usize {
        self.buffer.capacity()
    }

    /// The next event; `None` until more bytes come, or when all is said.
    pub fn next_event(&mut self) -> Option<Event<'_>> {
        if self.steps.is_empty() {
            self.look();
        }
        let step = self.steps.pop_front()?;
        let offset = self.offset + self.begin as u64;
        Some(match step {
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
            PendingEvent::Truncated { bytes } => {
                self.begin += bytes;
                Event::Truncated { offset, bytes: bytes as u64 }
            }
            PendingEvent::Garbage { offset, bytes } => Event::Garbage { offset, bytes },
            PendingEvent::Gap { header, expected } => Event::Gap { offset, header, expected },
            PendingEvent::Restart { header, expected } => Event::Restart { offset, header, expected },
        })
    }

    /// Room for so many bytes behind those in the buffer.
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

    /// Moves on to the next packet, if it is there, and lays down what is to be said.
    fn look(&mut self) {
        while self.begin < self.end {
            match self.find() {
                PacketMatch::Good(header) => return self.take_good(header),
                PacketMatch::Bad(header, bytes) => return self.take_damaged(header, bytes),
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

    /// What stands at the beginning of the unconsumed bytes.
    fn find(&self) -> PacketMatch {
        let rest = &self.buffer[self.begin..self.end];
        let Some(bytes) = rest.get(..HEADER_BYTES) else {
            // Less than headers: the beginning of a packet if it follows one and looks like one.
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
        if packet_holds(packet) {
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

    /// Passes over one byte and on to the next that could begin a packet.
    fn pass_garbage(&mut self) {
        self.garbage_from.get_or_insert(self.offset + self.begin as u64);
        self.begin += 1;
        let rest = &self.buffer[self.begin..self.end];
        self.begin += rest.iter().position(|o| *o == PacketHeader::FIRST_BYTE).unwrap_or(rest.len());
    }

    fn end_garbage(&mut self, end: u64) {
        if let Some(offset) = self.garbage_from.take().filter(|offset| *offset < end) {
            self.steps.push_back(PendingEvent::Garbage { offset, bytes: end - offset });
        }
    }

    fn take_good(&mut self, header: PacketHeader) {
        let arrival = match self.unfiltered {
            true => Arrival::InOrder,
            false => self.sequences[header.kind.index()].receive(header.count, header.time),
        };
        self.announce(header, arrival);
        self.steps.push_back(match arrival {
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
        self.steps.push_back(PendingEvent::Damaged(header, bytes));
    }

    /// What is to be said before a packet.
    fn announce(&mut self, header: PacketHeader, arrival: Arrival) {
        self.cut_at = None;
        self.end_garbage(self.offset + self.begin as u64);
        match arrival {
            Arrival::AfterGap { expected } => self.steps.push_back(PendingEvent::Gap { header, expected }),
            Arrival::Restart { expected } => self.steps.push_back(PendingEvent::Restart { header, expected }),
            Arrival::InOrder | Arrival::Late | Arrival::Early | Arrival::Duplicate => {}
        }
    }

    /// The end of the stream: what is left is garbage, then perhaps the beginning of a packet.
    fn take_rest(&mut self) {
        let end = self.offset + self.end as u64;
        let cut_at = self.cut_at.take().unwrap_or(end);
        self.end_garbage(cut_at);
        if cut_at < end {
            let bytes = (end - cut_at) as usize;
            self.begin = self.end - bytes;
            self.steps.push_back(PendingEvent::Truncated { bytes });
        }
    }
}

#[cfg(test)]
mod tests {
    use rand::Rng;

    use super::*;
    use crate::downlink::wire::{CucTime, FORMAT_VERSION, PACKET_BYTES_MAX, PacketSegment};
    use crate::units::{StreamKind, random_stream};

    /// Bytes that a stream's events cover, and what the receiver ever held; it must have read all of it.
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
        // Each names the greatest packet, so that each makes the receiver check 64 KiB.
        let forged: Vec<u8> = (0..20_000)
            .flat_map(|count| {
                PacketHeader {
                    kind: Kind::Visibilities,
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
