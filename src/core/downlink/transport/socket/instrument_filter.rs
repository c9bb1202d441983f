//! Decides by its instrument whether a sender's packets are forwarded to the ground.

use std::sync::{Arc, Mutex, PoisonError};

use super::report::ConnectionEnd;
use crate::downlink::receive::{Decoder, Event, ReceivedSet};
use crate::downlink::wire::{PacketHeader, PacketKind};
use crate::frames::{GroundFrame, Instrument, VisibilityBlock};
use crate::units::MissionTime;

/// Maximum number of ephemeris spans that are kept to check that a visibility has positions.
const EPHEMERIS_SPANS_MAX: usize = 1 << 10;

/// Maximum number of packet intervals that are kept per kind to recognise replayed packets: a few MB.
const SEEN_MAX: usize = 1 << 16;

/// A function that returns whether the ground can map an instrument.
pub type InstrumentCheck = Arc<dyn Fn(&Instrument) -> bool + Send + Sync>;

/// State that all connections share: the ground's instrument and the packets received so far.
///
/// The instrument is that of the ground's checkpoint, or the first one that visibilities with positions confirm.
#[derive(Clone)]
pub(super) struct SharedReception {
    instrument: Arc<Mutex<Option<Instrument>>>,
    is_supported: InstrumentCheck,
    seen: Arc<Mutex<[ReceivedSet; PacketKind::ALL.len()]>>,
}

impl Default for SharedReception {
    fn default() -> Self {
        Self { instrument: Arc::default(), is_supported: Arc::new(|_| true), seen: Arc::default() }
    }
}

impl SharedReception {
    /// Sets the check for the first instrument.
    pub(super) fn set_instrument_check(&mut self, is_supported: InstrumentCheck) {
        self.is_supported = is_supported;
    }

    /// Adopts an instrument if there is none; returns whether it is the ground's instrument.
    pub(super) fn adopt_or_compare(&self, found: &Instrument) -> bool {
        let mut instrument = self.instrument.lock().unwrap_or_else(PoisonError::into_inner);
        instrument.get_or_insert_with(|| found.clone()) == found
    }

    /// Records a packet; returns whether no connection had delivered it before.
    pub(super) fn record_packet(&self, header: &PacketHeader) -> bool {
        let mut seen = self.seen.lock().unwrap_or_else(PoisonError::into_inner);
        let seen = &mut seen[header.kind.index()];
        let is_new = seen.insert(header.count, header.time);
        seen.remove_oldest(SEEN_MAX);
        is_new
    }
}

/// The result of checking a sender's instrument.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum InstrumentVerdict {
    /// The sender has not described its instrument, or the ground has none and nothing has confirmed the sender's.
    Undecided,
    /// It is the ground's instrument.
    Accepted,
    /// The packets are refused from the description on.
    Refused(ConnectionEnd),
}

/// The check of one sender's instrument.
pub(super) struct InstrumentFilter {
    reception: SharedReception,
    verdict: InstrumentVerdict,
    decoder: Decoder,
    /// Time spans of the ephemeris received.
    ephemeris_spans: Vec<[MissionTime; 2]>,
}

impl InstrumentFilter {
    pub(super) fn new(reception: SharedReception) -> Self {
        let verdict = InstrumentVerdict::Undecided;
        Self { reception, verdict, decoder: Decoder::new(), ephemeris_spans: Vec::new() }
    }

    /// Updates the verdict; returns whether all packets so far may be forwarded.
    pub(super) fn is_confirmed_after_update(&mut self) -> bool {
        if self.verdict == InstrumentVerdict::Undecided {
            let instrument = self.reception.instrument.lock().unwrap_or_else(PoisonError::into_inner);
            match (&*instrument, self.decoder.instrument()) {
                (Some(instrument), Some(found)) if instrument != found => {
                    self.verdict = InstrumentVerdict::Refused(ConnectionEnd::OtherInstrument);
                }
                (Some(_), Some(_)) => self.verdict = InstrumentVerdict::Accepted,
                // Without a description yet: it may have come over another connection.
                (Some(_), None) => return true,
                (None, _) => {}
            }
        }
        self.verdict == InstrumentVerdict::Accepted
    }

    /// Why the sender is refused; `None` if it is not.
    pub(super) fn refusal(&self) -> Option<ConnectionEnd> {
        match self.verdict {
            InstrumentVerdict::Refused(end) => Some(end),
            _ => None,
        }
    }

    /// Inspects a valid packet.
    pub(super) fn inspect(&mut self, event: &Event<'_>, kind: PacketKind) {
        let is_description = kind == PacketKind::Instrument;
        if self.refusal().is_some() || (self.verdict == InstrumentVerdict::Accepted && !is_description) {
            return;
        }
        let frame = self.decoder.accept(event);
        if self.decoder.counters().instruments_contradictory > 0 {
            self.verdict = InstrumentVerdict::Refused(ConnectionEnd::OtherInstrument);
            return;
        }
        match frame {
            Some(GroundFrame::Instrument(found)) => {
                self.is_confirmed_after_update();
                if self.verdict == InstrumentVerdict::Undecided && !(self.reception.is_supported)(&found) {
                    self.verdict = InstrumentVerdict::Refused(ConnectionEnd::UnfitInstrument);
                }
            }
            Some(GroundFrame::Ephemeris(segment)) if self.ephemeris_spans.len() < EPHEMERIS_SPANS_MAX => {
                self.ephemeris_spans.push([segment.start, segment.end()]);
            }
            Some(GroundFrame::Visibilities(block)) => self.inspect_block(&block),
            _ => {}
        }
    }

    /// Confirms the sender's instrument if visibilities have positions.
    fn inspect_block(&mut self, block: &VisibilityBlock) {
        let Some(&offset) = block.offset_ticks.first() else { return };
        let first = block.start.plus_ticks(i64::from(offset));
        let has_positions = self.ephemeris_spans.iter().any(|[from, to]| (*from..=*to).contains(&first));
        if let Some(found) = self.decoder.instrument().filter(|_| has_positions) {
            self.verdict = match self.reception.adopt_or_compare(found) {
                true => InstrumentVerdict::Accepted,
                false => InstrumentVerdict::Refused(ConnectionEnd::OtherInstrument),
            };
            self.ephemeris_spans = Vec::new();
        }
    }
}
