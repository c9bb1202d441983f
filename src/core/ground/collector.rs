//! Turns bytes into frames, and delivers every packet once across files and sessions.

use std::collections::VecDeque;
use std::path::Path;

use super::collector_state::{CollectorState, CollectorView, headers};
use crate::downlink::error::{DownlinkError, require_packets};
use crate::downlink::receive::{
    ByteFeed, Decoder, DownlinkReceiver, Event, HeldPacket, HoldBuffer, IsDue, PacketInsertion,
    PacketOutcome, ReceivedSet, ReceptionCounters, SendingKey,
};
use crate::downlink::wire::payload::visibilities_outline;
use crate::downlink::wire::{PacketHeader, PacketKind, PacketSegment};
use crate::frames::{GroundFrame, Instrument, VisibilityBlock};

/// A packet that was delivered.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct DeliveredPacket {
    /// The headers of the packet.
    pub header: PacketHeader,
    /// The checksum of the packet.
    pub checksum: u32,
    /// The contribution of the packet to the counters.
    pub counts: PacketOutcome,
}

/// Maximum number of intervals in the received set of a kind, some 100 MB. An interval is a run of consecutive sequence counts with
/// the same creation time. A mission of 30 channels over 1.3 years has some tens of thousands, and 300,000 if a tenth of
/// its packets are lost.
const INTERVALS_MAX: usize = 1 << 20;

/// Maximum number of packets in a state. At some 200 bytes per record this is 3.4 GB. A mission of 30 channels over 1.3 years
/// has some four million packets: one for each window, channel and pair.
const PACKETS_MAX: u64 = 1 << 24;

/// Decoded packets and the frame in them.
#[derive(Clone, Debug, PartialEq)]
pub struct Delivery {
    /// One packet, or all packets of a segmented payload.
    pub packets: Vec<DeliveredPacket>,
    /// `None` if the content is already known or cannot be decoded.
    pub frame: Option<GroundFrame>,
}

/// Result of [`Collector::next_step`].
#[derive(Clone, Debug, PartialEq)]
pub enum CollectorStep {
    /// Packets to apply that were never held.
    Direct(Delivery),
    /// Packets to apply that were released from the hold buffer.
    Released(Delivery),
    /// A new packet of visibilities was put into the hold buffer.
    Held(PacketHeader),
    /// More bytes are needed.
    NeedsBytes,
}

/// Takes bytes of a downlink as they arrive, and delivers the content of every packet exactly once.
///
/// Visibilities are held until the ephemeris covers them or the [`HoldBuffer`] is full; other packets are delivered at
/// once. Until the description of the instrument arrives, no packet can be decoded, and all are held.
#[derive(Debug)]
pub struct Collector {
    receiver: DownlinkReceiver,
    received: [ReceivedSet; PacketKind::ALL.len()],
    held: HoldBuffer,
    decoder: Decoder,
    /// Counts duplicates, damaged bytes and bytes outside packets in this session.
    session_counts: Decoder,
    /// Held packets that may be released now.
    candidates: VecDeque<PacketHeader>,
    /// Whether held visibilities have to be checked again, as after a new ephemeris.
    must_recheck: bool,
    /// Whether visibilities are held although their positions are known, while there is room.
    holds_for_next_session: bool,
    intervals_max: usize,
    /// Packets received, of all kinds.
    packets: u64,
    packets_max: u64,
    refused: RefusedPackets,
}

#[derive(Clone, Copy, Debug, Default)]
struct RefusedPackets {
    packets: u64,
    bytes: u64,
}

impl Collector {
    /// A collector at the beginning of a stream. `wait_bytes` is the capacity for held visibilities.
    #[must_use]
    pub fn new(wait_bytes: u64) -> Self {
        Self {
            receiver: DownlinkReceiver::unfiltered(),
            received: Default::default(),
            held: HoldBuffer::new(wait_bytes),
            decoder: Decoder::new(),
            session_counts: Decoder::new(),
            candidates: VecDeque::new(),
            must_recheck: false,
            holds_for_next_session: false,
            intervals_max: INTERVALS_MAX,
            packets: 0,
            // Only the received set grows with the packets, and it has its own limit.
            packets_max: u64::MAX,
            refused: RefusedPackets::default(),
        }
    }

    /// Refuses new packets that would need more than `intervals_max` intervals in the received set of their kind.
    #[must_use]
    pub fn with_intervals_max(self, intervals_max: usize) -> Self {
        Self { intervals_max, ..self }
    }

    /// Refuses new packets beyond this number.
    #[must_use]
    pub fn with_packets_max(self, packets_max: u64) -> Self {
        Self { packets_max, ..self }
    }

    /// Resumes at the beginning of a stream with the state, delivered packets and counters of earlier sessions. The records of
    /// packets are in memory, so their number is limited.
    #[must_use]
    pub fn resume(
        state: CollectorState,
        delivered: impl Iterator<Item = (PacketKind, SendingKey)>,
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

    /// The state for a checkpoint. It does not contain the bytes of an incomplete packet.
    #[must_use]
    pub fn view(&self) -> CollectorView<'_> {
        CollectorView { held: &self.held, decoder: self.decoder.state() }
    }

    /// From now on holds visibilities for the next session, while there is room.
    pub fn hold_for_next_session(&mut self) {
        self.holds_for_next_session = true;
    }

    /// Appends the next bytes of the stream.
    pub fn push(&mut self, bytes: &[u8]) {
        self.receiver.push(bytes);
    }

    /// Ends the stream.
    pub fn finish(&mut self) {
        self.receiver.finish();
    }

    /// Bytes received in this session.
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
                CollectorStep::Direct(found) | CollectorStep::Released(found) => return Ok(Some(found)),
                CollectorStep::Held(_) => {}
                CollectorStep::NeedsBytes => return Ok(None),
            }
        }
    }

    /// Advances to the next delivery, or to the next packet of visibilities that has to be held.
    ///
    /// # Errors
    /// [`DownlinkError::OtherInstrument`].
    pub fn next_step(&mut self, is_due: IsDue<'_>) -> Result<CollectorStep, DownlinkError> {
        loop {
            if self.knows_instrument() {
                if let Some(found) = self.next_due(is_due) {
                    return Ok(CollectorStep::Released(found));
                }
            } else {
                self.drop_unreadable();
            }
            match self.take_event(is_due)? {
                EventOutcome::NeedsBytes => {
                    // Once per chunk of the stream, not per ephemeris packet, as many packets may be held.
                    if !self.make_candidates() {
                        return Ok(CollectorStep::NeedsBytes);
                    }
                }
                EventOutcome::Consumed => {}
                EventOutcome::Held(header) => return Ok(CollectorStep::Held(header)),
                EventOutcome::Delivery(found) => return Ok(CollectorStep::Direct(found)),
            }
        }
    }

    /// Releases the next held packet that is due, without reading the stream.
    pub fn next_released(&mut self, is_due: IsDue<'_>) -> Option<Delivery> {
        if self.knows_instrument() { self.next_due(is_due) } else { None }
    }

    /// Checks all held packets for release again.
    pub fn recheck_held(&mut self) {
        self.must_recheck = true;
        self.make_candidates();
    }

    /// Delivers the next held packet, due or not. Call it after the last checkpoint is written.
    pub fn flush_next(&mut self) -> Option<Delivery> {
        if let Some(packet) = self.held.pop_visibilities() {
            return Some(self.deliver(&[packet]));
        }
        let packet = self.held.pop_other()?;
        Some(self.deliver_incomplete(packet))
    }

    /// Passes all deliveries of a file to `take`, then the held packets.
    ///
    /// # Errors
    /// A file that cannot be read, is empty, or holds no packet of this format.
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

    /// Reads a file up to its first description of an instrument; `None` if it has none.
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

    /// The set of packets received of each kind.
    pub fn received(&self) -> impl Iterator<Item = (PacketKind, &ReceivedSet)> {
        PacketKind::ALL.into_iter().map(|kind| (kind, &self.received[kind.index()]))
    }

    /// Number of packets of all kinds received so far, without duplicates.
    #[must_use]
    pub fn packets(&self) -> u64 {
        self.packets
    }

    /// The buffer of held packets.
    #[must_use]
    pub fn held(&self) -> &HoldBuffer {
        &self.held
    }

    /// Removes a held packet from the buffer and from the received set.
    pub fn remove_held(&mut self, header: &PacketHeader) -> Option<HeldPacket> {
        let removed = self.held.remove(header)?;
        self.received[header.kind.index()].remove(header.count, header.time);
        self.packets = self.packets.saturating_sub(1);
        Some(removed)
    }

    /// Decodes the visibilities of a packet without changing the counters.
    #[must_use]
    pub fn decoded(&self, packet: &HeldPacket) -> Option<VisibilityBlock> {
        let mut decoder = Decoder::resume(self.decoder.state(), ReceptionCounters::default());
        match decoder.decode(packet.packet(), true).0 {
            Some(GroundFrame::Visibilities(block)) if !block.is_empty() => Some(block),
            _ => None,
        }
    }

    /// Counters of packets delivered in any session, of gaps in the received set, and of other bytes in this session.
    #[must_use]
    pub fn counters(&self) -> ReceptionCounters {
        let mut counters = self.decoder.counters().clone();
        let session = self.session_counts.counters();
        counters.frames = self.receiver.frames();
        counters.bytes += session.bytes + self.refused.bytes;
        (counters.packets_beyond, counters.bytes_beyond) = (self.refused.packets, self.refused.bytes);
        counters.bytes_garbage = session.bytes_garbage;
        counters.garbage_stretches = session.garbage_stretches;
        counters.bytes_truncated = session.bytes_truncated;
        counters.bytes_damaged = session.bytes_damaged;
        counters.bytes_duplicate = session.bytes_duplicate;
        for kind in PacketKind::ALL {
            let counts = counters.kind_mut(kind);
            counts.duplicates = session.kind(kind).duplicates;
            counts.damaged = session.kind(kind).damaged;
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

    /// Releases the next held packets that are due. The instrument must be known.
    fn next_due(&mut self, is_due: IsDue<'_>) -> Option<Delivery> {
        loop {
            while let Some(header) = self.candidates.pop_front() {
                let found = match header.kind {
                    // The next session checks all of them.
                    PacketKind::Visibilities if self.holds_for_next_session => None,
                    PacketKind::Visibilities => self.held.release(&header, is_due).map(|packet| vec![packet]),
                    _ => self.held.take_payload(&header),
                };
                if let Some(packets) = found {
                    return Some(self.deliver(&packets));
                }
            }
            if !self.held.is_full() {
                return self.release_excess_segment();
            }
            if !self.make_candidates() {
                return self.release_oldest_visibilities();
            }
        }
    }

    fn release_excess_segment(&mut self) -> Option<Delivery> {
        let packet = self.held.pop_excess_segment()?;
        Some(self.deliver_incomplete(packet))
    }

    fn release_oldest_visibilities(&mut self) -> Option<Delivery> {
        let packet = self.held.pop_visibilities()?;
        Some(self.deliver(&[packet]))
    }

    /// Makes all held packets candidates if they have to be checked again. Returns whether they had.
    fn make_candidates(&mut self) -> bool {
        let is_needed = std::mem::take(&mut self.must_recheck) && self.knows_instrument();
        if is_needed {
            self.candidates = headers(&self.held);
        }
        is_needed
    }

    /// Drops packets beyond the capacity while the instrument is unknown. They may be received again later.
    fn drop_unreadable(&mut self) {
        while let Some(packet) = self.held.pop_before_instrument() {
            let header = packet.header;
            self.received[header.kind.index()].remove(header.count, header.time);
            self.packets = self.packets.saturating_sub(1);
            // Only to count it.
            self.decoder.decode(packet.packet(), true);
        }
    }

    fn deliver(&mut self, packets: &[HeldPacket]) -> Delivery {
        self.decode(packets, false)
    }

    /// Delivers a segment without the rest of its payload.
    fn deliver_incomplete(&mut self, packet: HeldPacket) -> Delivery {
        self.decode(&[packet], true)
    }

    fn decode(&mut self, packets: &[HeldPacket], is_incomplete: bool) -> Delivery {
        let mut delivery = Delivery { packets: Vec::with_capacity(packets.len()), frame: None };
        for packet in packets {
            let (frame, counts) = self.decoder.decode(packet.packet(), is_incomplete);
            let (header, checksum) = (packet.header, packet.checksum);
            delivery.packets.push(DeliveredPacket { header, checksum, counts });
            delivery.frame = frame.or(delivery.frame);
        }
        self.must_recheck |= matches!(delivery.frame, Some(GroundFrame::Ephemeris(_)));
        delivery
    }

    fn take_event(&mut self, is_due: IsDue<'_>) -> Result<EventOutcome, DownlinkError> {
        let Some(event) = self.receiver.next_event() else { return Ok(EventOutcome::NeedsBytes) };
        let Event::Packet(packet) = event else {
            self.session_counts.accept(&event);
            return Ok(EventOutcome::Consumed);
        };
        let (offset, header) = (packet.offset, packet.header);
        let is_instrument = header.kind == PacketKind::Instrument;
        if is_instrument && header.segment == PacketSegment::Whole && self.decoder.contradicts(packet.payload)
        {
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
                self.session_counts.accept(&Event::Duplicate { offset, header });
                return Ok(EventOutcome::Consumed);
            }
            PacketInsertion::Full => {
                self.refused.packets += 1;
                self.refused.bytes += header.bytes as u64;
                return Ok(EventOutcome::Consumed);
            }
        }
        // The common case: delivered without a copy into the hold buffer.
        if header.kind == PacketKind::Visibilities
            && !(self.holds_for_next_session && self.held.has_room(&header))
            && self.decoder.instrument().is_some()
            && visibilities_outline(packet.payload).as_ref().is_none_or(is_due)
        {
            let (frame, counts) = self.decoder.decode(packet, false);
            let packets = vec![DeliveredPacket { header, checksum: packet.checksum, counts }];
            return Ok(EventOutcome::Delivery(Delivery { packets, frame }));
        }
        self.held.insert(HeldPacket::new(&packet));
        if !is_instrument && !self.knows_instrument() {
            return Ok(EventOutcome::Consumed);
        }
        if header.kind == PacketKind::Visibilities {
            self.candidates.push_back(header);
            return Ok(EventOutcome::Held(header));
        }
        let Some(payload) = self.held.take_payload(&header) else { return Ok(EventOutcome::Consumed) };
        if is_instrument {
            let whole: Vec<u8> = payload.iter().flat_map(|packet| packet.payload.iter().copied()).collect();
            if self.decoder.contradicts(&whole) {
                return Err(DownlinkError::OtherInstrument { offset });
            }
        }
        if !self.knows_instrument() {
            // All other packets were held for the instrument.
            self.candidates = headers(&self.held);
        }
        Ok(EventOutcome::Delivery(self.deliver(&payload)))
    }
}

enum EventOutcome {
    /// There is no complete event.
    NeedsBytes,
    /// An event was taken that delivers nothing yet.
    Consumed,
    Held(PacketHeader),
    Delivery(Delivery),
}
