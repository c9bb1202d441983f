//! Octets to packets: the ground's end, robust against whatever a link or a disk does to them.

use std::collections::VecDeque;
use std::io::{self, Read};

use super::header::{HEADER_OCTETS, PacketHeader, TRAILER_OCTETS, packet_holds};
use super::kind::Kind;
use super::sequence::{Arrival, Sequence};

/// Octets that [`Receiver::fill_from`] asks for at a time.
const CHUNK_OCTETS: usize = 1 << 18;

/// A packet whose checks hold.
#[derive(Clone, Copy, Debug)]
pub struct Packet<'a> {
    /// Place in the stream.
    pub offset: u64,
    /// Its headers.
    pub header: PacketHeader,
    /// What it carries, without headers and check.
    pub payload: &'a [u8],
    /// Whether it fills a gap that has been reported.
    pub late: bool,
}

/// What a stream holds, in order. The octets of all events but [`Event::Gap`] and [`Event::Restart`] together are
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
        /// Octets passed over: the packet, or its headers alone when no other packet follows where it
        /// should end.
        octets: u64,
    },
    /// Packets `expected .. found` of a kind are missing before the next packet.
    Gap {
        /// Place of the next packet.
        offset: u64,
        /// Kind.
        kind: Kind,
        /// Count of the first missing packet.
        expected: u64,
        /// Count of the packet that came instead.
        found: u64,
    },
    /// The spacecraft has begun to count anew.
    Restart {
        /// Place of the next packet.
        offset: u64,
        /// Kind.
        kind: Kind,
        /// Count that was due.
        expected: u64,
        /// Count of the packet that came instead.
        found: u64,
    },
    /// Octets that belong to no packet.
    Garbage {
        /// Place in the stream.
        offset: u64,
        /// How many.
        octets: u64,
    },
    /// The stream ends within a packet.
    Truncated {
        /// Place of the packet.
        offset: u64,
        /// Octets of it that are there.
        octets: u64,
    },
}

/// An event without its octets. All but gaps consume what they cover when they are handed out.
#[derive(Clone, Copy, Debug)]
enum Step {
    Packet { header: PacketHeader, late: bool },
    Duplicate(PacketHeader),
    Damaged(PacketHeader, usize),
    Gap { kind: Kind, expected: u64, found: u64 },
    Restart { kind: Kind, expected: u64, found: u64 },
    Garbage { offset: u64, octets: u64 },
    Truncated { octets: usize },
}

/// What stands at some place of the buffer.
enum Found {
    /// A whole packet.
    Good(PacketHeader),
    /// Headers whose packet does not hold; octets to pass over.
    Bad(PacketHeader, usize),
    /// Headers of a packet that the stream ends in.
    Cut,
    /// More octets are needed to say.
    Unknown,
    /// Nothing of ours.
    Nothing,
}

/// Finds packets in a stream of octets, given in chunks of any size.
///
/// Push octets, then take events until there are none; at the end call [`Receiver::finish`] and take the rest.
/// Then the memory stays below the greatest packet plus twice the greatest chunk.
///
/// After damage it looks for the next headers whose check holds. Time is linear in the stream: a body is
/// checked once for each headers with a good check of their own, which noise yields once in 10^11 octets
/// and a forger at most once in 22.
#[derive(Debug, Default)]
pub struct Receiver {
    buffer: Vec<u8>,
    /// Octets of the buffer that are not yet consumed.
    begin: usize,
    end: usize,
    /// Place of `buffer[0]` in the stream.
    offset: u64,
    /// Where the present run of garbage began.
    garbage_from: Option<u64>,
    /// Where headers were met at the end whose packet is not all there.
    cut_at: Option<u64>,
    finished: bool,
    steps: VecDeque<Step>,
    sequences: [Sequence; Kind::ALL.len()],
}

impl Receiver {
    /// A receiver at the start of a stream.
    #[must_use]
    pub fn new() -> Self {
        Self::default()
    }

    /// Takes the next octets of the stream.
    pub fn push(&mut self, octets: &[u8]) {
        self.room(octets.len()).copy_from_slice(octets);
        self.end += octets.len();
    }

    /// Takes the next octets from a reader, without a copy in between; returns how many, 0 at its end.
    ///
    /// # Errors
    /// Those of the reader, interruptions excepted.
    pub fn fill_from(&mut self, reader: &mut impl Read) -> io::Result<usize> {
        loop {
            match reader.read(self.room(CHUNK_OCTETS)) {
                Ok(octets) => {
                    self.end += octets;
                    return Ok(octets);
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

    /// Octets taken so far.
    #[must_use]
    pub fn octets(&self) -> u64 {
        self.offset + self.end as u64
    }

    /// The next event; `None` until more octets come, or when all is said.
    pub fn next_event(&mut self) -> Option<Event<'_>> {
        if self.steps.is_empty() {
            self.look();
        }
        let step = self.steps.pop_front()?;
        let offset = self.offset + self.begin as u64;
        Some(match step {
            Step::Packet { header, late } => {
                let packet = &self.buffer[self.begin..self.begin + header.octets];
                self.begin += header.octets;
                let payload = &packet[HEADER_OCTETS..packet.len() - TRAILER_OCTETS];
                Event::Packet(Packet { offset, header, payload, late })
            }
            Step::Duplicate(header) => {
                self.begin += header.octets;
                Event::Duplicate { offset, header }
            }
            Step::Damaged(header, octets) => {
                self.begin += octets;
                Event::Damaged { offset, header, octets: octets as u64 }
            }
            Step::Truncated { octets } => {
                self.begin += octets;
                Event::Truncated { offset, octets: octets as u64 }
            }
            Step::Garbage { offset, octets } => Event::Garbage { offset, octets },
            Step::Gap { kind, expected, found } => Event::Gap { offset, kind, expected, found },
            Step::Restart { kind, expected, found } => Event::Restart { offset, kind, expected, found },
        })
    }

    /// Room for so many octets behind those in the buffer.
    fn room(&mut self, octets: usize) -> &mut [u8] {
        if self.end + octets > self.buffer.len() {
            self.buffer.copy_within(self.begin..self.end, 0);
            self.offset += self.begin as u64;
            self.end -= self.begin;
            self.begin = 0;
            if self.end + octets > self.buffer.len() {
                self.buffer.resize(self.end + octets, 0);
            }
        }
        &mut self.buffer[self.end..self.end + octets]
    }

    /// Moves on to the next packet, if it is there, and lays down what is to be said.
    fn look(&mut self) {
        while self.begin < self.end {
            match self.find() {
                Found::Good(header) => return self.take_good(header),
                Found::Bad(header, octets) => return self.take_damaged(header, octets),
                Found::Unknown => return,
                Found::Cut => {
                    self.cut_at.get_or_insert(self.offset + self.begin as u64);
                    self.pass_garbage();
                }
                Found::Nothing => self.pass_garbage(),
            }
        }
        if self.finished {
            self.take_rest();
        }
    }

    /// What stands at the beginning of the unconsumed octets.
    fn find(&self) -> Found {
        let rest = &self.buffer[self.begin..self.end];
        let Some(octets) = rest.get(..HEADER_OCTETS) else {
            // Less than headers: the beginning of a packet if it follows one and looks like one.
            return match (self.finished, rest[0] == PacketHeader::FIRST_OCTET) {
                (_, false) => Found::Nothing,
                (false, true) => Found::Unknown,
                (true, true) if self.garbage_from.is_none() => Found::Cut,
                (true, true) => Found::Nothing,
            };
        };
        let Some(header) = PacketHeader::parse(octets) else { return Found::Nothing };
        let Some(packet) = rest.get(..header.octets) else {
            return if self.finished { Found::Cut } else { Found::Unknown };
        };
        if packet_holds(packet) {
            return Found::Good(header);
        }
        let after = &rest[header.octets..];
        if after.len() < HEADER_OCTETS && !self.finished {
            return Found::Unknown;
        }
        let another_follows = match after.first() {
            None => true,
            Some(first) if after.len() < HEADER_OCTETS => *first == PacketHeader::FIRST_OCTET,
            Some(_) => PacketHeader::parse(after).is_some(),
        };
        Found::Bad(header, if another_follows { header.octets } else { HEADER_OCTETS })
    }

    /// Passes over one octet and on to the next that could begin a packet.
    fn pass_garbage(&mut self) {
        self.garbage_from.get_or_insert(self.offset + self.begin as u64);
        self.begin += 1;
        let rest = &self.buffer[self.begin..self.end];
        self.begin += rest.iter().position(|o| *o == PacketHeader::FIRST_OCTET).unwrap_or(rest.len());
    }

    fn end_garbage(&mut self, end: u64) {
        if let Some(offset) = self.garbage_from.take().filter(|offset| *offset < end) {
            self.steps.push_back(Step::Garbage { offset, octets: end - offset });
        }
    }

    fn take_good(&mut self, header: PacketHeader) {
        let arrival = self.sequences[header.kind.index()].receive(header.count, header.time);
        self.announce(header, arrival);
        self.steps.push_back(match arrival {
            Arrival::Duplicate => Step::Duplicate(header),
            other => Step::Packet { header, late: other == Arrival::Late },
        });
    }

    fn take_damaged(&mut self, header: PacketHeader, octets: usize) {
        let arrival = self.sequences[header.kind.index()].pass_damaged(header.count, header.time);
        self.announce(header, arrival);
        self.steps.push_back(Step::Damaged(header, octets));
    }

    /// What is to be said before a packet.
    fn announce(&mut self, header: PacketHeader, arrival: Arrival) {
        self.cut_at = None;
        self.end_garbage(self.offset + self.begin as u64);
        let (kind, found) = (header.kind, header.count);
        match arrival {
            Arrival::AfterGap { expected } => self.steps.push_back(Step::Gap { kind, expected, found }),
            Arrival::Restart { expected } => self.steps.push_back(Step::Restart { kind, expected, found }),
            Arrival::InOrder | Arrival::Late | Arrival::Duplicate => {}
        }
    }

    /// The end of the stream: what is left is garbage, then perhaps the beginning of a packet.
    fn take_rest(&mut self) {
        let end = self.offset + self.end as u64;
        let cut_at = self.cut_at.take().unwrap_or(end);
        self.end_garbage(cut_at);
        if cut_at < end {
            let octets = (end - cut_at) as usize;
            self.begin = self.end - octets;
            self.steps.push_back(Step::Truncated { octets });
        }
    }
}
