//! Packets to frames, each once, across files and sessions.

use std::collections::VecDeque;
use std::path::Path;

use bincode::{Decode, Encode};

use super::hold_buffer::{Waiting, WaitingPacket};
use crate::downlink::error::{DownlinkError, require_packets};
use crate::downlink::receive::{ByteFeed, Decoder, DecoderState, Event, Intake, ReceptionCounters, Taken};
use crate::downlink::wire::payload::visibilities_span;
use crate::downlink::wire::{CucTime, Kind, PacketHeader, PacketSegment};
use crate::frames::{GroundFrame, Instrument, VisibilityBlock};
use crate::units::MissionTime;

/// What a collector knows, for another to go on with.
#[derive(Clone, Debug, PartialEq, Encode, Decode)]
pub struct CollectorState {
    taken: Vec<Taken>,
    waiting: Waiting,
    decoder: DecoderState,
}

/// What a collector knows, to be written as a [`CollectorState`] is, without a copy of what waits.
#[derive(Clone, Debug, PartialEq, Encode)]
pub struct CollectorView<'a> {
    taken: Vec<Taken>,
    waiting: &'a Waiting,
    decoder: DecoderState,
}

impl CollectorState {
    /// The packets of a kind that have been taken.
    #[must_use]
    pub fn taken(&self, kind: Kind) -> Option<&Taken> {
        self.taken.get(kind.index())
    }

    /// Packets that wait.
    #[must_use]
    pub fn waiting(&self) -> &Waiting {
        &self.waiting
    }

    /// Whether a collector can have left it, which of one that was read is not sure.
    #[must_use]
    pub fn is_sound(&self) -> bool {
        self.taken.len() <= Kind::ALL.len()
            && self.taken.iter().all(Taken::is_sound)
            && self.waiting.is_sound()
    }
}

/// Packets that have been read, and what they say.
#[derive(Clone, Debug, PartialEq)]
pub struct Delivery {
    /// Headers and check of each: one, or all those of a payload in segments.
    pub packets: Vec<(PacketHeader, u32)>,
    /// `None` if they say nothing new, or nothing that can be understood.
    pub frame: Option<GroundFrame>,
}

/// Whether positions are known over a stretch of time.
pub type Placed<'a> = &'a dyn Fn([MissionTime; 2]) -> bool;

/// Takes bytes of a downlink as they come, and gives what every packet says once: visibilities as soon as their positions
/// are known, as far as [`Waiting`] reaches, everything else as soon as it is there.
///
/// Until the description of the instrument has come, nobody can read anything, and all packets wait.
#[derive(Debug)]
pub struct Collector {
    intake: Intake,
    taken: [Taken; Kind::ALL.len()],
    waiting: Waiting,
    decoder: Decoder,
    /// Keeps the account of what is no new packet: of this session alone.
    link: Decoder,
    /// Packets that may wait although nothing keeps them from being read.
    again: VecDeque<PacketHeader>,
    /// Whether positions have come since visibilities that wait were looked at.
    has_new_positions: bool,
}

impl Collector {
    /// A collector that knows nothing; visibilities wait for their positions until so many bytes do.
    #[must_use]
    pub fn new(wait_bytes: u64) -> Self {
        Self {
            intake: Intake::unfiltered(),
            taken: Default::default(),
            waiting: Waiting::new(wait_bytes),
            decoder: Decoder::new(),
            link: Decoder::new(),
            again: VecDeque::new(),
            has_new_positions: false,
        }
    }

    /// A collector at the beginning of a stream that knows what another knew.
    #[must_use]
    pub fn resume(state: CollectorState) -> Self {
        let CollectorState { mut taken, waiting, decoder } = state;
        taken.resize(Kind::ALL.len(), Taken::default());
        let taken = taken.try_into().unwrap_or_default();
        let decoder = Decoder::resume(decoder);
        let again = headers(&waiting);
        Self { taken, waiting, decoder, again, ..Self::new(0) }
    }

    /// What it knows; the bytes of an unfinished packet left out, which are no packet yet.
    #[must_use]
    pub fn view(&self) -> CollectorView<'_> {
        CollectorView { taken: self.taken.to_vec(), waiting: &self.waiting, decoder: self.decoder.state() }
    }

    /// What it knows, as [`Collector::view`].
    #[must_use]
    pub fn into_state(self) -> CollectorState {
        CollectorState { taken: self.taken.to_vec(), waiting: self.waiting, decoder: self.decoder.state() }
    }

    /// Takes all that another knows, of which no visibilities have been read by both.
    ///
    /// # Errors
    /// Another instrument.
    pub fn absorb(&mut self, other: CollectorState) -> Result<(), DownlinkError> {
        let CollectorState { taken: mut theirs, waiting: mut their_waiting, decoder } = other;
        theirs.resize(Kind::ALL.len(), Taken::default());
        // What one has read need not wait in the other; what waits in both does so once.
        for header in headers(&self.waiting) {
            let has_come = theirs[header.kind.index()].contains(header.count, header.time);
            if has_come && their_waiting.get(&header).is_none() {
                self.waiting.take_out(&header);
            }
        }
        for header in headers(&their_waiting) {
            if self.has_taken(&header) {
                their_waiting.take_out(&header);
            }
        }
        for kind in Kind::ALL {
            self.taken[kind.index()].absorb(&theirs[kind.index()]);
        }
        if !self.decoder.absorb(decoder) {
            return Err(DownlinkError::OtherInstrument { offset: 0 });
        }
        for packet in their_waiting.packets() {
            self.waiting.put(packet.clone());
        }
        self.again = headers(&self.waiting);
        Ok(())
    }

    /// Takes the next bytes of the stream.
    pub fn push(&mut self, bytes: &[u8]) {
        self.intake.push(bytes);
    }

    /// Says that the stream is at its end.
    pub fn finish(&mut self) {
        self.intake.finish();
    }

    /// Bytes of this session.
    #[must_use]
    pub fn bytes(&self) -> u64 {
        self.intake.bytes()
    }

    /// What is to be read next; `None` until more bytes come.
    ///
    /// # Errors
    /// [`DownlinkError::OtherInstrument`].
    pub fn next_delivery(&mut self, placed: Placed<'_>) -> Result<Option<Delivery>, DownlinkError> {
        loop {
            if self.knows_instrument() {
                if let Some(found) = self.next_due(placed) {
                    return Ok(Some(found));
                }
            } else {
                self.set_aside_unread();
            }
            match self.take_event(placed)? {
                // Looked at once for all positions of a piece of the stream: of what waits there may be much.
                Taking::Nothing if self.look_again() => {}
                Taking::Nothing => return Ok(None),
                Taking::Event => {}
                Taking::Delivery(found) => return Ok(Some(found)),
            }
        }
    }

    /// The next of what still waits; not to be followed by a [`Collector::view`] that is kept.
    pub fn next_waiting(&mut self) -> Option<Delivery> {
        if let Some(packet) = self.waiting.first_visibilities() {
            return Some(self.read(&[packet]));
        }
        let packet = self.waiting.first_other()?;
        Some(self.give_up(packet))
    }

    /// Takes all of a file and gives everything to `take`, what waits at its end too.
    ///
    /// # Errors
    /// A file that cannot be read, is empty, or does not hold a packet of ours.
    pub fn read_file(&mut self, path: &Path, take: &mut dyn FnMut(Delivery)) -> Result<(), DownlinkError> {
        let mut file = ByteFeed::open(path)?;
        while file.feed(&mut self.intake)? {
            while let Some(found) = self.next_delivery(&|_| true)? {
                take(found);
            }
        }
        while let Some(found) = self.next_waiting() {
            take(found);
        }
        require_packets(path, self.bytes(), self.taken.iter().map(Taken::len).sum())
    }

    /// Whether a packet has come, be it read or waiting.
    #[must_use]
    pub fn has_taken(&self, header: &PacketHeader) -> bool {
        self.taken[header.kind.index()].contains(header.count, header.time)
    }

    /// Packets that wait.
    #[must_use]
    pub fn waiting(&self) -> &Waiting {
        &self.waiting
    }

    /// Lets go of a packet that waits.
    pub fn take_out(&mut self, header: &PacketHeader) -> Option<WaitingPacket> {
        self.waiting.take_out(header)
    }

    /// The visibilities of a packet, of no account.
    #[must_use]
    pub fn read_again(&self, packet: &WaitingPacket) -> Option<VisibilityBlock> {
        match self.decoder.uncounted().accept(&packet.event()) {
            Some(GroundFrame::Visibilities(block)) if !block.is_empty() => Some(block),
            _ => None,
        }
    }

    /// Takes packets that were read together off the account; what they said. To be concluded by [`Collector::retake`].
    pub fn take_back(&mut self, packets: &[WaitingPacket]) -> Option<GroundFrame> {
        let mut reader = self.decoder.uncounted();
        let mut frame = None;
        for packet in packets {
            frame = reader.accept(&packet.event()).or(frame);
        }
        reader.finish();
        self.decoder.uncount(reader.counters());
        frame
    }

    /// Takes packets that another collector has read as well, and counted, off the account.
    pub fn uncount(&mut self, kind: Kind, packets: u64, bytes: u64) {
        let mut counters = ReceptionCounters { bytes, ..ReceptionCounters::default() };
        (counters.kind_mut(kind).packets, counters.kind_mut(kind).bytes) = (packets, bytes);
        self.decoder.uncount(&counters);
    }

    /// Says anew which packets of a kind have been read; those that wait have come too.
    pub fn retake(&mut self, kind: Kind, read: impl Iterator<Item = (CucTime, u64)>) {
        let waiting = self.waiting.packets().map(|packet| packet.header).filter(|header| header.kind == kind);
        let mut taken = Taken::default();
        for (time, count) in read.chain(waiting.map(|header| (header.time, header.count))) {
            taken.take(count, time);
        }
        self.taken[kind.index()] = taken;
    }

    /// Forgets the instrument and everything else if no packet is left.
    pub fn begin_anew_if_empty(&mut self) -> bool {
        let is_empty = self.taken.iter().all(Taken::is_empty);
        if is_empty {
            self.decoder = Decoder::new();
        }
        is_empty
    }

    /// The account: of packets that were read at any time, of gaps in all that was taken, and of what else was in
    /// the streams of this session.
    #[must_use]
    pub fn counters(&self) -> ReceptionCounters {
        let mut counters = self.decoder.counters().clone();
        let link = self.link.counters();
        counters.frames = self.intake.frames();
        counters.bytes += link.bytes;
        counters.bytes_garbage = link.bytes_garbage;
        counters.garbage_stretches = link.garbage_stretches;
        counters.bytes_truncated = link.bytes_truncated;
        counters.bytes_damaged = link.bytes_damaged;
        counters.bytes_duplicate = link.bytes_duplicate;
        for kind in Kind::ALL {
            let counts = counters.kind_mut(kind);
            counts.duplicates = link.kind(kind).duplicates;
            counts.damaged = link.kind(kind).damaged;
            let eras = self.taken[kind.index()].eras();
            counts.restarts = eras.len().saturating_sub(1) as u64;
            let gaps = eras.into_iter().flat_map(|era| era.missing);
            (counts.gaps, counts.missing) =
                gaps.fold((0, 0_u64), |(n, sum), gap| (n + 1, sum.saturating_add(gap.end - gap.start)));
        }
        counters
    }

    /// The instrument that it knows.
    #[must_use]
    pub fn instrument(&self) -> Option<&Instrument> {
        self.decoder.instrument()
    }

    fn knows_instrument(&self) -> bool {
        self.decoder.instrument().is_some()
    }

    /// What waits and need not, once the instrument is known.
    fn next_due(&mut self, placed: Placed<'_>) -> Option<Delivery> {
        loop {
            while let Some(header) = self.again.pop_front() {
                let found = match header.kind {
                    Kind::Visibilities => {
                        self.waiting.placed_visibilities(&header, placed).map(|packet| vec![packet])
                    }
                    _ => self.waiting.payload_of(&header),
                };
                if let Some(packets) = found {
                    return Some(self.read(&packets));
                }
            }
            if !self.waiting.is_full() {
                let packet = self.waiting.next_given_up()?;
                return Some(self.give_up(packet));
            }
            if !self.look_again() {
                let packet = self.waiting.first_visibilities()?;
                return Some(self.read(&[packet]));
            }
        }
    }

    /// Whether visibilities that wait are to be looked at again.
    fn look_again(&mut self) -> bool {
        let is_due = std::mem::take(&mut self.has_new_positions) && self.knows_instrument();
        if is_due {
            self.again = headers(&self.waiting);
        }
        is_due
    }

    /// Nobody can read what has waited too long for a description; it may come again when somebody can.
    fn set_aside_unread(&mut self) {
        while let Some(packet) = self.waiting.next_unread() {
            let header = packet.header;
            self.taken[header.kind.index()].forget(header.count, header.time);
            self.decoder.accept(&packet.event());
        }
    }

    fn read(&mut self, packets: &[WaitingPacket]) -> Delivery {
        let mut frame = None;
        for packet in packets {
            frame = self.decoder.accept(&packet.event()).or(frame);
        }
        self.has_new_positions |= matches!(frame, Some(GroundFrame::Ephemeris(_)));
        Delivery { packets: packets.iter().map(|packet| (packet.header, packet.check)).collect(), frame }
    }

    /// Reads a segment without those that it needs.
    fn give_up(&mut self, packet: WaitingPacket) -> Delivery {
        let found = self.read(&[packet]);
        self.decoder.finish();
        found
    }

    /// Takes one event of the stream.
    fn take_event(&mut self, placed: Placed<'_>) -> Result<Taking, DownlinkError> {
        let Some(event) = self.intake.next_event() else { return Ok(Taking::Nothing) };
        let Event::Packet(packet) = event else {
            self.link.accept(&event);
            return Ok(Taking::Event);
        };
        let (offset, header) = (packet.offset, packet.header);
        let describes = header.kind == Kind::Instrument;
        if describes && header.segment == PacketSegment::Whole && self.decoder.contradicts(packet.payload) {
            return Err(DownlinkError::OtherInstrument { offset });
        }
        if !self.taken[header.kind.index()].take(header.count, header.time) {
            self.link.accept(&Event::Duplicate { offset, header });
            return Ok(Taking::Event);
        }
        // As nearly all are: not kept even for a moment.
        if header.kind == Kind::Visibilities
            && self.decoder.instrument().is_some()
            && visibilities_span(packet.payload).is_none_or(placed)
        {
            let frame = self.decoder.accept(&event);
            return Ok(Taking::Delivery(Delivery { packets: vec![(header, packet.check)], frame }));
        }
        self.waiting.put(WaitingPacket::of(&packet));
        if !describes && !self.knows_instrument() {
            return Ok(Taking::Event);
        }
        if header.kind == Kind::Visibilities {
            self.again.push_back(header);
            return Ok(Taking::Event);
        }
        let Some(payload) = self.waiting.payload_of(&header) else { return Ok(Taking::Event) };
        if describes {
            let whole: Vec<u8> = payload.iter().flat_map(|packet| packet.payload.iter().copied()).collect();
            if self.decoder.contradicts(&whole) {
                return Err(DownlinkError::OtherInstrument { offset });
            }
        }
        if !self.knows_instrument() {
            // Everything else has waited for it.
            self.again = headers(&self.waiting);
        }
        Ok(Taking::Delivery(self.read(&payload)))
    }
}

/// What an event of a stream comes to.
enum Taking {
    /// There is none.
    Nothing,
    /// Nothing to be read yet.
    Event,
    Delivery(Delivery),
}

fn headers(waiting: &Waiting) -> VecDeque<PacketHeader> {
    waiting.packets().map(|packet| packet.header).collect()
}
