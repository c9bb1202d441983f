//! Bytes to frames: every packet once, across files and sessions.

use std::collections::VecDeque;
use std::path::Path;

use bincode::{Decode, Encode};

use super::hold_buffer::{HeldPacket, HoldBuffer, IsDue, Sent};
use crate::downlink::error::{DownlinkError, require_packets};
use crate::downlink::receive::{
    ByteFeed, Decoder, DecoderState, DownlinkReceiver, Event, PacketInsertion, PacketOutcome, ReceivedSet,
    ReceptionCounters,
};
use crate::downlink::wire::payload::visibilities_outline;
use crate::downlink::wire::{PacketHeader, PacketKind, PacketSegment};
use crate::frames::{GroundFrame, Instrument, VisibilityBlock};

/// What a checkpoint keeps of a collector: the packets it holds, and its instrument. Packets that were delivered are in
/// the journal.
#[derive(Clone, Debug, Default, PartialEq, Encode, Decode)]
pub struct CollectorState {
    held: HoldBuffer,
    decoder: DecoderState,
}

/// A [`CollectorState`] to be written, without a copy of the held packets.
#[derive(Clone, Debug, PartialEq, Encode)]
pub struct CollectorView<'a> {
    held: &'a HoldBuffer,
    decoder: DecoderState,
}

impl CollectorState {
    /// The state of a collector that has received nothing.
    #[must_use]
    pub(super) fn new(wait_bytes: u64) -> Self {
        Self { held: HoldBuffer::new(wait_bytes), decoder: DecoderState::default() }
    }

    /// The instrument, if it is known.
    pub(super) fn instrument(&self) -> Option<&Instrument> {
        self.decoder.instrument()
    }

    /// Adds the packets that another collector holds, without those already delivered.
    pub(super) fn merge(
        &mut self,
        other: Self,
        is_delivered: impl Fn(&PacketHeader) -> bool,
    ) -> Result<(), DownlinkError> {
        if !self.decoder.merge(other.decoder) {
            return Err(DownlinkError::OtherInstrument { offset: 0 });
        }
        for packet in other.held.packets() {
            if self.held.get(&packet.header).is_none() {
                self.held.insert(packet.clone());
            }
        }
        for header in headers(&self.held).iter().filter(|header| is_delivered(header)) {
            self.held.remove(header);
        }
        Ok(())
    }

    /// Whether the state is reachable by a collector; a forged checkpoint may hold anything.
    #[must_use]
    pub fn is_sound(&self) -> bool {
        self.held.is_sound()
    }
}

/// A packet that was delivered.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct DeliveredPacket {
    /// Its headers.
    pub header: PacketHeader,
    /// Its checksum.
    pub check: u32,
    /// Its contribution to the counters.
    pub reading: PacketOutcome,
}

/// Most intervals of the received set of a kind: packets of consecutive counts made at one time are one. A pass has a few,
/// so a mission of 30 channels over 1.3 years has some tens of thousands, and 300,000 if a tenth of its packets are
/// lost. Some 100 MB a kind, whatever a forger sends.
const INTERVALS_MAX: usize = 1 << 20;

/// Most packets of a state: it has a record of some 200 bytes of each, so 3.4 GB, whatever a forger sends. The mission has
/// one packet for each window, channel and pair: 30 channels over 1.3 years make some four million.
const PACKETS_MAX: u64 = 1 << 24;

/// Packets that have been decoded, and what they say.
#[derive(Clone, Debug, PartialEq)]
pub struct Delivery {
    /// One packet, or all those of a payload in segments.
    pub packets: Vec<DeliveredPacket>,
    /// `None` if they say nothing new, or cannot be understood.
    pub frame: Option<GroundFrame>,
}

/// The last step of a collector.
#[derive(Clone, Debug, PartialEq)]
pub enum CollectorStep {
    /// Packets are to be applied that have not waited.
    Delivery(Delivery),
    /// Packets are to be applied that were held.
    Waited(Delivery),
    /// A new packet of visibilities is held.
    Held(PacketHeader),
    /// It needs more bytes.
    Nothing,
}

/// Takes bytes of a downlink as they arrive, and delivers what every packet says once: visibilities as soon as their
/// positions are known, as far as the [`HoldBuffer`] reaches, everything else at once.
///
/// Until the description of the instrument arrives, nothing can be decoded, and all packets are held.
#[derive(Debug)]
pub struct Collector {
    receiver: DownlinkReceiver,
    received: [ReceivedSet; PacketKind::ALL.len()],
    held: HoldBuffer,
    decoder: Decoder,
    /// Counts what is no new packet, in this session alone.
    link: Decoder,
    /// Held packets that may be due.
    candidates: VecDeque<PacketHeader>,
    /// Whether positions have arrived since held visibilities were last considered.
    has_new_positions: bool,
    /// Whether visibilities are held, as far as there is room, although their positions are known.
    sets_aside: bool,
    /// Most intervals of the received set of a kind.
    intervals_max: usize,
    /// Packets received, of all kinds, and the most of them.
    packets: u64,
    packets_max: u64,
    /// New packets for which the received set has no room, and their bytes.
    beyond: [u64; 2],
}

impl Collector {
    /// A collector at the beginning of a stream; `wait_bytes` of visibilities may wait for their positions.
    #[must_use]
    pub fn new(wait_bytes: u64) -> Self {
        Self {
            receiver: DownlinkReceiver::unfiltered(),
            received: Default::default(),
            held: HoldBuffer::new(wait_bytes),
            decoder: Decoder::new(),
            link: Decoder::new(),
            candidates: VecDeque::new(),
            has_new_positions: false,
            sets_aside: false,
            intervals_max: INTERVALS_MAX,
            packets: 0,
            // Nothing but the received set grows with them.
            packets_max: u64::MAX,
            beyond: [0; 2],
        }
    }

    /// Refuses new packets that would need more than `intervals_max` intervals in the received set of their kind.
    #[must_use]
    pub fn with_intervals(self, intervals_max: usize) -> Self {
        Self { intervals_max, ..self }
    }

    /// Refuses new packets beyond this number.
    #[must_use]
    pub fn with_packets(self, packets_max: u64) -> Self {
        Self { packets_max, ..self }
    }

    /// Resumes at the beginning of a stream, with packets that were delivered in earlier sessions and their counters. Their
    /// records are in memory, so the number of packets is limited.
    #[must_use]
    pub fn resume(
        state: CollectorState,
        delivered: impl Iterator<Item = (PacketKind, Sent)>,
        counters: ReceptionCounters,
    ) -> Self {
        let CollectorState { held, decoder } = state;
        let candidates = headers(&held);
        let decoder = Decoder::resume(decoder, counters);
        let mut collector = Self { held, decoder, candidates, packets_max: PACKETS_MAX, ..Self::new(0) };
        let waiting = collector.candidates.iter().map(|header| (header.kind, (header.time, header.count)));
        for (kind, (time, count)) in delivered.chain(waiting) {
            collector.packets += u64::from(collector.received[kind.index()].insert(count, time));
        }
        collector
    }

    /// What a checkpoint keeps; the bytes of an unfinished packet are not part of it.
    #[must_use]
    pub fn view(&self) -> CollectorView<'_> {
        CollectorView { held: &self.held, decoder: self.decoder.state() }
    }

    /// From now on holds visibilities for the next session, as far as there is room.
    pub fn set_aside(&mut self) {
        self.sets_aside = true;
    }

    /// Appends the next bytes of the stream.
    pub fn push(&mut self, bytes: &[u8]) {
        self.receiver.push(bytes);
    }

    /// Ends the stream.
    pub fn finish(&mut self) {
        self.receiver.finish();
    }

    /// Bytes of this session.
    #[must_use]
    pub fn bytes(&self) -> u64 {
        self.receiver.bytes()
    }

    /// The next delivery; `None` until more bytes arrive.
    ///
    /// # Errors
    /// [`DownlinkError::OtherInstrument`].
    pub fn next_delivery(&mut self, is_due: IsDue<'_>) -> Result<Option<Delivery>, DownlinkError> {
        loop {
            match self.next_step(is_due)? {
                CollectorStep::Delivery(found) | CollectorStep::Waited(found) => return Ok(Some(found)),
                CollectorStep::Held(_) => {}
                CollectorStep::Nothing => return Ok(None),
            }
        }
    }

    /// Goes on to the next delivery, or to the next packet of visibilities that has to wait.
    ///
    /// # Errors
    /// [`DownlinkError::OtherInstrument`].
    pub fn next_step(&mut self, is_due: IsDue<'_>) -> Result<CollectorStep, DownlinkError> {
        loop {
            if self.knows_instrument() {
                if let Some(found) = self.next_due(is_due) {
                    return Ok(CollectorStep::Waited(found));
                }
            } else {
                self.drop_unreadable();
            }
            match self.take_event(is_due)? {
                // Once for all positions of a piece of the stream: much may be held.
                EventOutcome::Nothing if self.reconsider() => {}
                EventOutcome::Nothing => return Ok(CollectorStep::Nothing),
                EventOutcome::Event => {}
                EventOutcome::Held(header) => return Ok(CollectorStep::Held(header)),
                EventOutcome::Delivery(found) => return Ok(CollectorStep::Delivery(found)),
            }
        }
    }

    /// The next of the held packets that are due; takes nothing from the stream.
    pub fn next_waiting(&mut self, is_due: IsDue<'_>) -> Option<Delivery> {
        if self.knows_instrument() { self.next_due(is_due) } else { None }
    }

    /// All held packets may be due.
    pub fn consider_held(&mut self) {
        self.has_new_positions = true;
        self.reconsider();
    }

    /// Delivers the next held packet, due or not. A checkpoint must be written before.
    pub fn flush_next(&mut self) -> Option<Delivery> {
        if let Some(packet) = self.held.pop_visibilities() {
            return Some(self.deliver(&[packet]));
        }
        let packet = self.held.pop_other()?;
        Some(self.give_up(packet))
    }

    /// Delivers all of a file to `take`, and finally the held packets.
    ///
    /// # Errors
    /// A file that cannot be read, is empty, or does not hold a packet of ours.
    pub fn read_file(&mut self, path: &Path, take: &mut dyn FnMut(Delivery)) -> Result<(), DownlinkError> {
        let mut file = ByteFeed::open(path)?;
        while file.feed(&mut self.receiver)? {
            while let Some(found) = self.next_delivery(&|_| true)? {
                take(found);
            }
        }
        while let Some(found) = self.flush_next() {
            take(found);
        }
        require_packets(path, self.bytes(), self.received.iter().map(ReceivedSet::len).sum(), || None)
    }

    /// The instrument that a file describes first, read no further than that; `None` if it describes none.
    ///
    /// # Errors
    /// A file that cannot be read.
    pub fn instrument_of(path: &Path) -> Result<Option<Instrument>, DownlinkError> {
        let (mut file, mut collector) = (ByteFeed::open(path)?, Self::new(0));
        while file.feed(&mut collector.receiver)? {
            while collector.next_delivery(&|_| true)?.is_some() {}
            if let Some(instrument) = collector.instrument() {
                return Ok(Some(instrument.clone()));
            }
        }
        Ok(None)
    }

    /// Packets received of each kind.
    pub fn received(&self) -> impl Iterator<Item = (PacketKind, &ReceivedSet)> {
        PacketKind::ALL.into_iter().map(|kind| (kind, &self.received[kind.index()]))
    }

    /// Packets of all kinds received so far, without duplicates.
    #[must_use]
    pub fn packets(&self) -> u64 {
        self.packets
    }

    /// Packets held.
    #[must_use]
    pub fn held(&self) -> &HoldBuffer {
        &self.held
    }

    /// Removes a held packet, as if it had never been received.
    pub fn remove_held(&mut self, header: &PacketHeader) -> Option<HeldPacket> {
        let removed = self.held.remove(header)?;
        self.received[header.kind.index()].remove(header.count, header.time);
        self.packets = self.packets.saturating_sub(1);
        Some(removed)
    }

    /// The visibilities of a packet; changes nothing.
    #[must_use]
    pub fn decoded(&self, packet: &HeldPacket) -> Option<VisibilityBlock> {
        let mut decoder = Decoder::resume(self.decoder.state(), ReceptionCounters::default());
        match decoder.decode(packet.packet(), true).0 {
            Some(GroundFrame::Visibilities(block)) if !block.is_empty() => Some(block),
            _ => None,
        }
    }

    /// Counters: of packets delivered in any session, of gaps in the received set, and of what else was in the streams of
    /// this session.
    #[must_use]
    pub fn counters(&self) -> ReceptionCounters {
        let mut counters = self.decoder.counters().clone();
        let link = self.link.counters();
        counters.frames = self.receiver.frames();
        let [packets_beyond, bytes_beyond] = self.beyond;
        counters.bytes += link.bytes + bytes_beyond;
        (counters.packets_beyond, counters.bytes_beyond) = (packets_beyond, bytes_beyond);
        counters.bytes_garbage = link.bytes_garbage;
        counters.garbage_stretches = link.garbage_stretches;
        counters.bytes_truncated = link.bytes_truncated;
        counters.bytes_damaged = link.bytes_damaged;
        counters.bytes_duplicate = link.bytes_duplicate;
        for kind in PacketKind::ALL {
            let counts = counters.kind_mut(kind);
            counts.duplicates = link.kind(kind).duplicates;
            counts.damaged = link.kind(kind).damaged;
            let eras = self.received[kind.index()].eras();
            counts.restarts = eras.len().saturating_sub(1) as u64;
            let gaps = eras.into_iter().flat_map(|era| era.missing);
            (counts.gaps, counts.missing) =
                gaps.fold((0, 0_u64), |(n, sum), gap| (n + 1, sum.saturating_add(gap.end - gap.start)));
        }
        counters
    }

    /// The instrument, once it is known.
    #[must_use]
    pub fn instrument(&self) -> Option<&Instrument> {
        self.decoder.instrument()
    }

    fn knows_instrument(&self) -> bool {
        self.decoder.instrument().is_some()
    }

    /// The next held packets that are due; the instrument is known.
    fn next_due(&mut self, is_due: IsDue<'_>) -> Option<Delivery> {
        loop {
            while let Some(header) = self.candidates.pop_front() {
                let found = match header.kind {
                    // The next session considers all of them.
                    PacketKind::Visibilities if self.sets_aside => None,
                    PacketKind::Visibilities => self.held.release(&header, is_due).map(|packet| vec![packet]),
                    _ => self.held.take_payload(&header),
                };
                if let Some(packets) = found {
                    return Some(self.deliver(&packets));
                }
            }
            if !self.held.is_full() {
                let packet = self.held.pop_excess_segment()?;
                return Some(self.give_up(packet));
            }
            if !self.reconsider() {
                let packet = self.held.pop_visibilities()?;
                return Some(self.deliver(&[packet]));
            }
        }
    }

    /// Makes all held packets candidates if positions have arrived; returns whether.
    fn reconsider(&mut self) -> bool {
        let is_due = std::mem::take(&mut self.has_new_positions) && self.knows_instrument();
        if is_due {
            self.candidates = headers(&self.held);
        }
        is_due
    }

    /// Drops packets beyond the capacity while no instrument is known; they may be received again later.
    fn drop_unreadable(&mut self) {
        while let Some(packet) = self.held.pop_unreadable() {
            let header = packet.header;
            self.received[header.kind.index()].remove(header.count, header.time);
            self.decoder.decode(packet.packet(), true);
        }
    }

    fn deliver(&mut self, packets: &[HeldPacket]) -> Delivery {
        self.decode(packets, false)
    }

    /// Delivers a segment without the rest of its payload.
    fn give_up(&mut self, packet: HeldPacket) -> Delivery {
        self.decode(&[packet], true)
    }

    fn decode(&mut self, packets: &[HeldPacket], is_given_up: bool) -> Delivery {
        let mut delivery = Delivery { packets: Vec::with_capacity(packets.len()), frame: None };
        for packet in packets {
            let (frame, reading) = self.decoder.decode(packet.packet(), is_given_up);
            let (header, check) = (packet.header, packet.check);
            delivery.packets.push(DeliveredPacket { header, check, reading });
            delivery.frame = frame.or(delivery.frame);
        }
        self.has_new_positions |= matches!(delivery.frame, Some(GroundFrame::Ephemeris(_)));
        delivery
    }

    /// Takes one event of the stream.
    fn take_event(&mut self, is_due: IsDue<'_>) -> Result<EventOutcome, DownlinkError> {
        let Some(event) = self.receiver.next_event() else { return Ok(EventOutcome::Nothing) };
        let Event::Packet(packet) = event else {
            self.link.accept(&event);
            return Ok(EventOutcome::Event);
        };
        let (offset, header) = (packet.offset, packet.header);
        let describes = header.kind == PacketKind::Instrument;
        if describes && header.segment == PacketSegment::Whole && self.decoder.contradicts(packet.payload) {
            return Err(DownlinkError::OtherInstrument { offset });
        }
        let received = &mut self.received[header.kind.index()];
        let insertion = match self.packets < self.packets_max || received.contains(header.count, header.time)
        {
            true => received.insert_bounded(header.count, header.time, self.intervals_max),
            false => PacketInsertion::Full,
        };
        match insertion {
            PacketInsertion::New => self.packets += 1,
            PacketInsertion::Known => {
                self.link.accept(&Event::Duplicate { offset, header });
                return Ok(EventOutcome::Event);
            }
            PacketInsertion::Full => {
                self.beyond = [self.beyond[0] + 1, self.beyond[1] + header.bytes as u64];
                return Ok(EventOutcome::Event);
            }
        }
        // As nearly all are: never copied into the hold buffer.
        if header.kind == PacketKind::Visibilities
            && !(self.sets_aside && self.held.has_room(&header))
            && self.decoder.instrument().is_some()
            && visibilities_outline(packet.payload).as_ref().is_none_or(is_due)
        {
            let (frame, reading) = self.decoder.decode(packet, false);
            let packets = vec![DeliveredPacket { header, check: packet.check, reading }];
            return Ok(EventOutcome::Delivery(Delivery { packets, frame }));
        }
        self.held.insert(HeldPacket::of(&packet));
        if !describes && !self.knows_instrument() {
            return Ok(EventOutcome::Event);
        }
        if header.kind == PacketKind::Visibilities {
            self.candidates.push_back(header);
            return Ok(EventOutcome::Held(header));
        }
        let Some(payload) = self.held.take_payload(&header) else { return Ok(EventOutcome::Event) };
        if describes {
            let whole: Vec<u8> = payload.iter().flat_map(|packet| packet.payload.iter().copied()).collect();
            if self.decoder.contradicts(&whole) {
                return Err(DownlinkError::OtherInstrument { offset });
            }
        }
        if !self.knows_instrument() {
            // Everything else is held until then.
            self.candidates = headers(&self.held);
        }
        Ok(EventOutcome::Delivery(self.deliver(&payload)))
    }
}

/// Outcome of one event of a stream.
enum EventOutcome {
    /// No event.
    Nothing,
    /// Nothing to deliver yet.
    Event,
    /// Visibilities wait.
    Held(PacketHeader),
    Delivery(Delivery),
}

fn headers(held: &HoldBuffer) -> VecDeque<PacketHeader> {
    held.packets().map(|packet| packet.header).collect()
}
