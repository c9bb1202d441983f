//! Packets to frames, each once and in the order of sending, across files and sessions.

use std::collections::VecDeque;
use std::fs::File;
use std::path::Path;

use bincode::{Decode, Encode};

use super::counters::ReceptionCounters;
use super::decoder::{Decoder, DecoderState};
use super::error::DownlinkError;
use super::file::{io_error, require_packets};
use super::header::{PacketHeader, Segment};
use super::intake::Intake;
use super::kind::Kind;
use super::receiver::{Event, Packet};
use super::taken::Taken;
use super::waiting::{Waiting, WaitingPacket};
use crate::frames::{GroundFrame, Instrument};

/// Packets wait for an instrument description until there are so many times the bytes that wait otherwise.
const PATIENCE: u64 = 4;

/// What a collector knows, for another to go on with.
#[derive(Clone, Debug, PartialEq, Encode, Decode)]
pub struct CollectorState {
    taken: Vec<Taken>,
    waiting: Waiting,
    decoder: DecoderState,
}

impl CollectorState {
    /// The packets of a kind that have been taken.
    #[must_use]
    pub fn taken(&self, kind: Kind) -> Option<&Taken> {
        self.taken.get(kind.index())
    }
}

/// Takes bytes of a downlink as they come, and gives every frame once, in the order in which it was sent as far as
/// [`Waiting`] reaches; packets that come later than that are given as they come.
#[derive(Debug)]
pub struct Collector {
    intake: Intake,
    taken: [Taken; Kind::ALL.len()],
    waiting: Waiting,
    decoder: Decoder,
    /// Keeps the account of what is no new packet: of this session alone.
    link: Decoder,
    /// Packets that came too late to wait.
    late: VecDeque<WaitingPacket>,
}

impl Collector {
    /// A collector that knows nothing; packets wait for those before them until others of `wait_bytes` have come.
    #[must_use]
    pub fn new(wait_bytes: u64) -> Self {
        Self {
            intake: Intake::unjudged(),
            taken: Default::default(),
            waiting: Waiting::new(wait_bytes),
            decoder: Decoder::new(),
            link: Decoder::new(),
            late: VecDeque::new(),
        }
    }

    /// A collector at the beginning of a stream that knows what another knew.
    #[must_use]
    pub fn resume(state: CollectorState) -> Self {
        let CollectorState { mut taken, waiting, decoder } = state;
        taken.resize(Kind::ALL.len(), Taken::default());
        let taken = taken.try_into().unwrap_or_default();
        Self { taken, waiting, decoder: Decoder::resume(decoder), ..Self::new(0) }
    }

    /// What it knows; the bytes of an unfinished packet left out, which are no packet yet.
    #[must_use]
    pub fn state(&self) -> CollectorState {
        CollectorState {
            taken: self.taken.to_vec(),
            waiting: self.waiting.clone(),
            decoder: self.decoder.state(),
        }
    }

    /// Takes all that another knows. Packets that wait in it come as frames as if they had just arrived.
    ///
    /// # Errors
    /// Another instrument; visibilities that have been decoded by both; packet counts that have begun anew.
    pub fn absorb(&mut self, other: CollectorState) -> Result<(), DownlinkError> {
        let CollectorState { taken: mut theirs, waiting: mut their_waiting, mut decoder } = other;
        theirs.resize(Kind::ALL.len(), Taken::default());
        // A payload that is half put together there is gone on with here, unless it is known here.
        let mut unfinished = decoder.take_partials();
        unfinished.retain(|packet| {
            let WaitingPacket { header, .. } = packet;
            !self.taken[header.kind.index()].contains(header.count, header.time)
                || self.waiting.headers().any(|ours| (ours.kind, ours.count) == (header.kind, header.count))
        });
        // What one has decoded need not wait in the other.
        for header in their_waiting.headers().collect::<Vec<_>>() {
            if self.taken[header.kind.index()].contains(header.count, header.time) {
                their_waiting.drop_packet(&header);
                theirs[header.kind.index()].forget(header.count, header.time);
            }
        }
        for header in self.waiting.headers().collect::<Vec<_>>() {
            if theirs[header.kind.index()].contains(header.count, header.time) {
                self.waiting.drop_packet(&header);
                self.taken[header.kind.index()].forget(header.count, header.time);
            }
        }
        for kind in Kind::ALL {
            let (ours, theirs) = (&mut self.taken[kind.index()], &theirs[kind.index()]);
            if kind == Kind::Visibilities
                && let Some(count) = ours.common(theirs)
            {
                return Err(DownlinkError::TakenTwice { apid: kind.apid(), count });
            }
            if !ours.absorb(theirs) {
                return Err(DownlinkError::Restarted { kind });
            }
        }
        if !self.decoder.absorb(decoder) {
            return Err(DownlinkError::OtherInstrument { offset: 0 });
        }
        for packet in unfinished {
            self.late.extend(self.waiting.put(packet));
        }
        while let Some(packet) = their_waiting.next_waiting() {
            self.late.extend(self.waiting.put(packet));
        }
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

    /// The next frame and the headers of the packet that completed it; `None` until more bytes come.
    ///
    /// # Errors
    /// [`DownlinkError::OtherInstrument`].
    pub fn next_frame(&mut self) -> Result<Option<(PacketHeader, GroundFrame)>, DownlinkError> {
        loop {
            let found = match self.late.pop_front() {
                Some(packet) => self.decode(&packet),
                None => match self.next_due() {
                    Some(packet) => self.decode(&packet),
                    None => match self.take_event()? {
                        Some(found) => found,
                        None => return Ok(None),
                    },
                },
            };
            if found.is_some() {
                return Ok(found);
            }
        }
    }

    /// The next frame of those that still wait; not to be followed by a [`Collector::state`] that is kept.
    pub fn next_waiting(&mut self) -> Option<(PacketHeader, GroundFrame)> {
        while let Some(packet) = self.waiting.next_waiting() {
            let found = self.decode(&packet);
            if found.is_some() {
                return found;
            }
        }
        None
    }

    /// Takes all of a file and gives every frame to `take`, those that wait at its end too.
    ///
    /// # Errors
    /// A file that cannot be read, is empty, or does not hold a packet of ours.
    pub fn read_file(
        &mut self,
        path: &Path,
        take: &mut dyn FnMut(PacketHeader, &GroundFrame),
    ) -> Result<(), DownlinkError> {
        let mut file = File::open(path).map_err(io_error(path, "open the file"))?;
        loop {
            let read = self.intake.fill_from(&mut file).map_err(io_error(path, "read"))?;
            if read == 0 {
                self.finish();
            }
            while let Some((header, frame)) = self.next_frame()? {
                take(header, &frame);
            }
            if read == 0 {
                break;
            }
        }
        while let Some((header, frame)) = self.next_waiting() {
            take(header, &frame);
        }
        require_packets(path, self.bytes(), self.taken.iter().map(Taken::len).sum())
    }

    /// The account: of packets that were decoded at any time, of gaps in all that was taken, and of what else was in
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
            let missing = self.taken[kind.index()].missing();
            counts.restarts = missing.len().saturating_sub(1) as u64;
            let gaps = missing.into_iter().flatten();
            (counts.gaps, counts.missing) =
                gaps.fold((0, 0), |(n, sum), gap| (n + 1, sum + gap.end - gap.start));
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

    fn next_due(&mut self) -> Option<WaitingPacket> {
        let patience = if self.knows_instrument() { 1 } else { PATIENCE };
        self.waiting.next_due(patience)
    }

    fn decode(&mut self, packet: &WaitingPacket) -> Option<(PacketHeader, GroundFrame)> {
        let header = packet.header;
        if !self.knows_instrument() && header.kind != Kind::Instrument {
            // Nobody can read it; it may come again when somebody can.
            self.taken[header.kind.index()].forget(header.count, header.time);
        }
        self.decoder.accept(&packet.event()).map(|frame| (header, frame))
    }

    /// Takes one event of the stream; `None` if there is none, else what it completes.
    #[allow(clippy::type_complexity)] // Nothing to take, and nothing made of it, are not the same.
    fn take_event(&mut self) -> Result<Option<Option<(PacketHeader, GroundFrame)>>, DownlinkError> {
        let Some(event) = self.intake.next_event() else { return Ok(None) };
        let Event::Packet(Packet { offset, header, payload, .. }) = event else {
            self.link.accept(&event);
            return Ok(Some(None));
        };
        let describes = header.kind == Kind::Instrument && header.segment == Segment::Whole;
        if describes && self.decoder.contradicts(payload) {
            return Err(DownlinkError::OtherInstrument { offset });
        }
        if !self.taken[header.kind.index()].take(header.count, header.time) {
            self.link.accept(&Event::Duplicate { offset, header });
            return Ok(Some(None));
        }
        let packet = WaitingPacket { header, payload: payload.to_vec() };
        if describes {
            // Everything waits for it.
            return Ok(Some(self.decode(&packet)));
        }
        self.late.extend(self.waiting.put(packet));
        Ok(Some(None))
    }
}
