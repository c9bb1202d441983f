//! Decodes packets into ground frames.

use super::{Event, Packet, PacketOutcome, PayloadOutcome, ReceptionCounters};
use crate::downlink::error::PayloadFault;
use crate::downlink::wire::payload::{
    count_visibilities, decode_ephemeris, decode_housekeeping, decode_instrument, decode_visibilities,
};
use crate::downlink::wire::{CucTime, FORMAT_VERSION, PacketHeader, PacketKind, PacketSegment};
use crate::frames::{GroundFrame, Instrument};

/// Maximum length of a payload that is assembled from segments; the ephemeris of a window has a thousandth of this.
const PAYLOAD_BYTES_MAX: usize = 1 << 24;

/// A payload without its last segments.
#[derive(Clone, Debug)]
struct PartialPayload {
    /// Packet count of the next segment.
    next: u64,
    time: CucTime,
    bytes: Vec<u8>,
}

/// Whether the instrument is known, and whether the latest description agrees.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, bincode::Encode, bincode::Decode)]
enum DescriptionState {
    #[default]
    Unknown,
    Known,
    /// The latest description contradicts the first, so that the packets after it belong to another array.
    Contradicted,
}

/// The state of a decoder, without its counters and partial payloads.
#[derive(Clone, Debug, Default, PartialEq, bincode::Encode, bincode::Decode)]
pub struct DecoderState {
    instrument: Option<Instrument>,
    description: DescriptionState,
}

impl DecoderState {
    /// Adopts the instrument of `other` if this state has none; returns whether both agree.
    #[must_use]
    pub fn merge(&mut self, other: Self) -> bool {
        match (&self.instrument, &other.instrument) {
            (Some(instrument), Some(other)) => return instrument == other,
            (None, Some(_)) => *self = other,
            _ => {}
        }
        true
    }

    /// The instrument.
    #[must_use]
    pub fn instrument(&self) -> Option<&Instrument> {
        self.instrument.as_ref()
    }
}

/// Decodes packets into ground frames, and counts events.
///
/// The first instrument description is the valid one. Identical repeats are skipped. After a contradictory description
/// all payloads are refused until the first description is repeated.
#[derive(Debug, Default)]
pub struct Decoder {
    instrument: Option<Instrument>,
    description: DescriptionState,
    partial: [Option<PartialPayload>; PacketKind::ALL.len()],
    counters: ReceptionCounters,
    /// Outcome of the packet that is being decoded, or was decoded last.
    outcome: PacketOutcome,
    fault: Option<(u64, PayloadFault)>,
}

impl Decoder {
    /// A decoder without an instrument.
    #[must_use]
    pub fn new() -> Self {
        Self::default()
    }

    /// The state, with which [`Decoder::resume`] continues.
    #[must_use]
    pub fn state(&self) -> DecoderState {
        DecoderState { instrument: self.instrument.clone(), description: self.description }
    }

    /// A decoder that continues from a state and the counters so far.
    #[must_use]
    pub fn resume(state: DecoderState, counters: ReceptionCounters) -> Self {
        let DecoderState { instrument, description } = state;
        Self { instrument, description, counters, ..Self::new() }
    }

    /// Whether a payload describes another instrument than the valid one.
    #[must_use]
    pub fn contradicts(&self, payload: &[u8]) -> bool {
        let valid = self.instrument.as_ref();
        valid.is_some_and(|valid| decode_instrument(payload).is_ok_and(|found| found != *valid))
    }

    /// Counts an event; returns the frame that it completes.
    pub fn accept(&mut self, event: &Event<'_>) -> Option<GroundFrame> {
        let counters = &mut self.counters;
        match *event {
            Event::Packet(packet) => return self.decode(packet, false).0,
            Event::Duplicate { header, .. } => {
                counters.bytes += header.bytes as u64;
                counters.bytes_duplicate += header.bytes as u64;
                counters.kind_mut(header.kind).duplicates += 1;
            }
            Event::Damaged { header, bytes, .. } => {
                counters.bytes += bytes;
                counters.bytes_damaged += bytes;
                counters.kind_mut(header.kind).damaged += 1;
            }
            Event::Gap { header, expected, .. } => {
                let counts = counters.kind_mut(header.kind);
                counts.gaps += 1;
                counts.missing += header.count - expected;
            }
            Event::Restart { header, .. } => counters.kind_mut(header.kind).restarts += 1,
            Event::Idle { .. } => {}
            Event::Garbage { bytes, .. } => {
                counters.bytes += bytes;
                counters.bytes_garbage += bytes;
                counters.garbage_stretches += 1;
            }
            Event::Truncated { bytes, .. } => {
                counters.bytes += bytes;
                counters.bytes_truncated += bytes;
            }
        }
        None
    }

    /// Ends the stream: discards partial payloads. Another stream may follow.
    pub fn finish(&mut self) {
        for kind in PacketKind::ALL {
            let orphans = self.drop_partial(kind);
            self.counters.kind_mut(kind).orphans += u64::from(orphans);
        }
    }

    /// Decodes a packet; returns the frame that it completes and what it adds to the counters.
    ///
    /// With `is_last` the stream ends, so a partial payload is discarded.
    pub(crate) fn decode(
        &mut self,
        packet: Packet<'_>,
        is_last: bool,
    ) -> (Option<GroundFrame>, PacketOutcome) {
        self.outcome = PacketOutcome::default();
        let PacketHeader { kind, bytes, .. } = packet.header;
        let frame = self.decode_packet(packet);
        if is_last {
            self.discard_partial(kind);
        }
        self.counters.add_packet(kind, bytes as u32, &self.outcome);
        self.counters.kind_mut(kind).late += u64::from(packet.late);
        (frame, self.outcome)
    }

    /// The counters so far.
    #[must_use]
    pub fn counters(&self) -> &ReceptionCounters {
        &self.counters
    }

    /// The valid instrument description.
    #[must_use]
    pub fn instrument(&self) -> Option<&Instrument> {
        self.instrument.as_ref()
    }

    /// The payload that was refused last: offset of its last packet, and the reason. Each is returned once.
    pub fn take_fault(&mut self) -> Option<(u64, PayloadFault)> {
        self.fault.take()
    }

    fn decode_packet(&mut self, packet: Packet<'_>) -> Option<GroundFrame> {
        let PacketHeader { kind, segment, version, .. } = packet.header;
        if version != FORMAT_VERSION {
            return self.refuse(packet, PayloadFault::Version { found: version, expected: FORMAT_VERSION });
        }
        if segment == PacketSegment::Whole {
            self.discard_partial(kind);
            return self.decode_payload(packet, packet.payload);
        }
        let payload = self.assemble(packet)?;
        self.decode_payload(packet, &payload)
    }

    /// Adds a segment; returns the payload if it is complete.
    fn assemble(&mut self, packet: Packet<'_>) -> Option<Vec<u8>> {
        let PacketHeader { kind, segment, count, time, .. } = packet.header;
        if segment == PacketSegment::First {
            self.discard_partial(kind);
            let bytes = packet.payload.to_vec();
            self.partial[kind.index()] = Some(PartialPayload { next: count + 1, time, bytes });
            return None;
        }
        let fits = |partial: &PartialPayload| {
            partial.next == count
                && partial.time == time
                && partial.bytes.len() + packet.payload.len() <= PAYLOAD_BYTES_MAX
        };
        let Some(mut partial) = self.partial[kind.index()].take_if(|partial| fits(partial)) else {
            self.discard_partial(kind);
            self.outcome.orphans += 1;
            return None;
        };
        partial.bytes.extend_from_slice(packet.payload);
        partial.next += 1;
        if segment == PacketSegment::Last {
            return Some(partial.bytes);
        }
        self.partial[kind.index()] = Some(partial);
        None
    }

    /// Discards a partial payload and counts it as an orphan of this packet.
    fn discard_partial(&mut self, kind: PacketKind) {
        self.outcome.orphans += self.drop_partial(kind);
    }

    /// Drops the partial payload of a kind; returns 1 if there was one, otherwise 0.
    fn drop_partial(&mut self, kind: PacketKind) -> u32 {
        u32::from(self.partial[kind.index()].take().is_some())
    }

    fn decode_payload(&mut self, packet: Packet<'_>, payload: &[u8]) -> Option<GroundFrame> {
        let kind = packet.header.kind;
        let decoded = match kind {
            PacketKind::Instrument => decode_instrument(payload).map(|found| self.take_instrument(found)),
            _ if self.description != DescriptionState::Known => {
                self.count_undecodable(kind, payload);
                return None;
            }
            PacketKind::Ephemeris => self.take_ephemeris(payload).map(Some),
            PacketKind::Visibilities => self.take_visibilities(payload).map(Some),
            PacketKind::Housekeeping => {
                decode_housekeeping(payload).map(|counts| Some(GroundFrame::Housekeeping(counts)))
            }
            PacketKind::Calibration => return None,
        };
        decoded.unwrap_or_else(|fault| {
            if kind == PacketKind::Visibilities {
                self.outcome.visibilities_unread = count_visibilities(payload) as u32;
            }
            self.refuse(packet, fault)
        })
    }

    fn take_instrument(&mut self, found: Instrument) -> Option<GroundFrame> {
        let is_first = match &self.instrument {
            None => true,
            Some(valid) if *valid == found => false,
            Some(_) => {
                self.description = DescriptionState::Contradicted;
                self.outcome.payload = PayloadOutcome::Contradictory;
                return None;
            }
        };
        self.description = DescriptionState::Known;
        if !is_first {
            return None;
        }
        self.instrument = Some(found.clone());
        Some(GroundFrame::Instrument(found))
    }

    fn take_ephemeris(&self, payload: &[u8]) -> Result<GroundFrame, PayloadFault> {
        let instrument = self.instrument.as_ref().ok_or(PayloadFault::Record { what: "instrument" })?;
        decode_ephemeris(payload, instrument).map(GroundFrame::Ephemeris)
    }

    fn take_visibilities(&mut self, payload: &[u8]) -> Result<GroundFrame, PayloadFault> {
        let instrument = self.instrument.as_ref().ok_or(PayloadFault::Record { what: "instrument" })?;
        let (block, bad) = decode_visibilities(payload, instrument)?;
        self.outcome.visibilities_bad_value = bad as u32;
        self.outcome.visibilities_decoded = block.len() as u32;
        Ok(GroundFrame::Visibilities(block))
    }

    /// Counts a payload that cannot be decoded because no valid instrument description precedes it.
    fn count_undecodable(&mut self, kind: PacketKind, payload: &[u8]) {
        self.outcome.visibilities_unread =
            if kind == PacketKind::Visibilities { count_visibilities(payload) as u32 } else { 0 };
        self.outcome.payload = match self.description {
            DescriptionState::Unknown => PayloadOutcome::BeforeInstrument,
            _ => PayloadOutcome::Foreign,
        };
    }

    fn refuse(&mut self, packet: Packet<'_>, fault: PayloadFault) -> Option<GroundFrame> {
        self.outcome.payload = PayloadOutcome::Refused((&fault).into());
        self.fault = Some((packet.offset, fault));
        None
    }
}
