//! The bytes of one sender to whole packets.

use std::sync::{Arc, Mutex, PoisonError};

use super::preamble::Preamble;
use super::report::ConnectionEnd;
use crate::downlink::receive::cadu::FrameCounters;
use crate::downlink::receive::{Decoder, DownlinkReceiver, Event, ReceivedSet, ReceptionCounters};
use crate::downlink::wire::{Format, PacketHeader, PacketKind, PacketSegment};
use crate::frames::{GroundFrame, Instrument, VisibilityBlock};
use crate::units::MissionTime;

/// Segments of a payload are kept together up to this number of bytes; the ephemeris of a window is a hundredth of it.
const GROUP_BYTES_MAX: usize = 1 << 20;

/// Bytes of packets held back until visibilities with positions confirm their instrument: several times those after which
/// description and positions are repeated (1 MiB).
const UNCONFIRMED_BYTES_MAX: usize = 1 << 22;

/// Segments of positions among which those of a visibility are looked for.
const POSITIONS_MAX: usize = 1 << 10;

/// Intervals of packets that are remembered of each kind, to tell new packets from replayed ones: a few MB.
const SEEN_MAX: usize = 1 << 16;

/// Whether the ground can make maps of an instrument.
pub type InstrumentCheck = Arc<dyn Fn(&Instrument) -> bool + Send + Sync>;

/// What all connections know of the ground: its instrument, that of its state or the first that visibilities with
/// positions confirm; and the packets that came from any of them.
#[derive(Clone)]
pub(super) struct Mission {
    known: Arc<Mutex<Option<Instrument>>>,
    fits: InstrumentCheck,
    seen: Arc<Mutex<[ReceivedSet; PacketKind::ALL.len()]>>,
}

impl Default for Mission {
    fn default() -> Self {
        Self { known: Arc::default(), fits: Arc::new(|_| true), seen: Arc::default() }
    }
}

impl Mission {
    /// Accepts a first instrument only if it fits.
    pub(super) fn with_instrument_check(self, fits: InstrumentCheck) -> Self {
        Self { fits, ..self }
    }

    /// Whether an instrument is the ground's. The ground adopts the first one.
    pub(super) fn confirm(&self, found: &Instrument) -> bool {
        let mut known = self.known.lock().unwrap_or_else(PoisonError::into_inner);
        known.get_or_insert_with(|| found.clone()) == found
    }

    /// Whether no connection has delivered a packet before.
    fn is_new(&self, header: &PacketHeader) -> bool {
        let mut seen = self.seen.lock().unwrap_or_else(PoisonError::into_inner);
        let seen = &mut seen[header.kind.index()];
        let is_new = seen.insert(header.count, header.time);
        seen.remove_oldest(SEEN_MAX);
        is_new
    }
}

/// What is known of a sender's instrument.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum SenderStanding {
    /// It has not described its instrument, or the ground knows none and nothing has confirmed this one.
    Open,
    /// It is the ground's.
    Ours,
    /// It is refused, from the description on.
    Refused(ConnectionEnd),
}

/// Judges a sender by its instrument.
struct SenderCheck {
    mission: Mission,
    standing: SenderStanding,
    decoder: Decoder,
    /// Spans of the positions received.
    positions: Vec<[MissionTime; 2]>,
}

impl SenderCheck {
    fn new(mission: Mission) -> Self {
        Self { mission, standing: SenderStanding::Open, decoder: Decoder::new(), positions: Vec::new() }
    }

    /// Whether packets may be passed on; if so, all that came before may be, too.
    fn passes(&mut self) -> bool {
        if self.standing == SenderStanding::Open {
            let known = self.mission.known.lock().unwrap_or_else(PoisonError::into_inner);
            match (&*known, self.decoder.instrument()) {
                (Some(known), Some(found)) if known != found => {
                    self.standing = SenderStanding::Refused(ConnectionEnd::OtherInstrument);
                }
                (Some(_), Some(_)) => self.standing = SenderStanding::Ours,
                // Headers may lack it.
                (Some(_), None) => return true,
                (None, _) => {}
            }
        }
        self.standing == SenderStanding::Ours
    }

    fn refused(&self) -> Option<ConnectionEnd> {
        match self.standing {
            SenderStanding::Refused(end) => Some(end),
            _ => None,
        }
    }

    /// Takes a sound packet.
    fn see(&mut self, event: &Event<'_>, kind: PacketKind) {
        let describes = kind == PacketKind::Instrument;
        if self.refused().is_some() || (self.standing == SenderStanding::Ours && !describes) {
            return;
        }
        let found = self.decoder.accept(event);
        if self.decoder.counters().instruments_contradictory > 0 {
            self.standing = SenderStanding::Refused(ConnectionEnd::OtherInstrument);
            return;
        }
        match found {
            Some(GroundFrame::Instrument(found)) => {
                self.passes();
                if self.standing == SenderStanding::Open && !(self.mission.fits)(&found) {
                    self.standing = SenderStanding::Refused(ConnectionEnd::UnfitInstrument);
                }
            }
            Some(GroundFrame::Ephemeris(segment)) if self.positions.len() < POSITIONS_MAX => {
                self.positions.push([segment.start, segment.end()]);
            }
            Some(GroundFrame::Visibilities(block)) => self.see_block(&block),
            _ => {}
        }
    }

    /// Visibilities with positions confirm the instrument.
    fn see_block(&mut self, block: &VisibilityBlock) {
        let Some(&offset) = block.offset_ticks.first() else { return };
        let first = block.start.plus_ticks(i64::from(offset));
        let has_positions = self.positions.iter().any(|[from, to]| (*from..=*to).contains(&first));
        if let Some(found) = self.decoder.instrument().filter(|_| has_positions) {
            self.standing = match self.mission.confirm(found) {
                true => SenderStanding::Ours,
                false => SenderStanding::Refused(ConnectionEnd::OtherInstrument),
            };
            self.positions = Vec::new();
        }
    }
}

/// Signs of life in a piece of a stream.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) struct Signs {
    /// It had a sound packet or frame.
    pub(super) is_alive: bool,
    /// It had a sound packet that no connection had delivered before.
    pub(super) is_new: bool,
}

/// The receiver of one connection. It counts everything but packets, which the ground counts.
pub(super) struct SenderIntake {
    preamble: Preamble,
    intake: DownlinkReceiver,
    stream: Decoder,
    judge: SenderCheck,
    /// Packets of a payload that lacks its last segment.
    group: Vec<u8>,
    grouped: u64,
    /// Whole payloads that wait until the instrument is confirmed.
    held: Vec<u8>,
    held_packets: u64,
    packets: u64,
    packets_refused: u64,
    has_new: bool,
    /// Sound packets and frames at the last sign of life, and the bytes until then.
    signs: u64,
    bytes_at_sign: u64,
}

impl SenderIntake {
    pub(super) fn new(mission: Mission, preamble: Preamble) -> Self {
        Self {
            preamble,
            intake: DownlinkReceiver::unfiltered(),
            stream: Decoder::new(),
            judge: SenderCheck::new(mission),
            group: Vec::new(),
            grouped: 0,
            held: Vec::new(),
            held_packets: 0,
            packets: 0,
            packets_refused: 0,
            has_new: false,
            signs: 0,
            bytes_at_sign: 0,
        }
    }

    /// Takes the next bytes and appends the packets that they complete and that may be passed on to `out`.
    ///
    /// # Errors
    /// The instrument is refused, or not confirmed in time, or the preamble is: from then on no packet is appended.
    pub(super) fn take(&mut self, bytes: &[u8], out: &mut Vec<u8>) -> Result<Signs, ConnectionEnd> {
        let (before, bytes) = self.preamble.take(bytes)?;
        self.intake.push(&before);
        self.intake.push(bytes);
        self.judge_taken(out)
    }

    fn judge_taken(&mut self, out: &mut Vec<u8>) -> Result<Signs, ConnectionEnd> {
        self.release(out);
        let is_alive = self.look_for_signs();
        let is_new = std::mem::take(&mut self.has_new);
        match self.judge.refused() {
            Some(end) => Err(end),
            None if self.held.len() > UNCONFIRMED_BYTES_MAX => Err(ConnectionEnd::Unconfirmed),
            None => Ok(Signs { is_alive, is_new }),
        }
    }

    /// As [`SenderIntake::take`], for a datagram that holds whole packets.
    ///
    /// # Errors
    /// The instrument is refused, or not confirmed in time.
    pub(super) fn take_packet(&mut self, bytes: &[u8], out: &mut Vec<u8>) -> Result<Signs, ConnectionEnd> {
        self.intake = DownlinkReceiver::unfiltered();
        self.intake.push(bytes);
        self.intake.finish();
        self.judge_taken(out)
    }

    /// As [`SenderIntake::take`], for a datagram that goes on where the one before it ended.
    ///
    /// # Errors
    /// The instrument is refused, or not confirmed in time.
    pub(super) fn take_frame(&mut self, bytes: &[u8], out: &mut Vec<u8>) -> Result<Signs, ConnectionEnd> {
        self.intake.push(bytes);
        self.judge_taken(out)
    }

    /// Ends the stream; appends the remaining packets.
    ///
    /// # Errors
    /// The instrument is refused, or was not confirmed; or the preamble is refused.
    pub(super) fn finish(&mut self, out: &mut Vec<u8>) -> Result<(), ConnectionEnd> {
        let before = self.preamble.finish()?;
        self.intake.push(&before);
        self.intake.finish();
        self.release(out);
        self.end_group();
        self.pass_on(out);
        self.look_for_signs();
        let is_unconfirmed = self.held_packets > 0;
        self.refuse_held();
        match self.judge.refused() {
            Some(end) => Err(end),
            None if is_unconfirmed => Err(ConnectionEnd::Unconfirmed),
            None => Ok(()),
        }
    }

    /// What came before the packets.
    pub(super) fn preamble(&self) -> &Preamble {
        &self.preamble
    }

    /// Whether a sound packet or frame has arrived since the last check.
    fn look_for_signs(&mut self) -> bool {
        // Blocks of equal octets and streams of markers are codewords too, so only valid frames count.
        let ours = |frames: FrameCounters| frames.frames - frames.frames_foreign - frames.frames_malformed;
        let frames = self.intake.frames().map_or(0, ours);
        let signs = self.packets + self.grouped + self.held_packets + self.packets_refused + frames;
        let alive = signs > self.signs;
        if alive {
            (self.signs, self.bytes_at_sign) = (signs, self.intake.bytes());
        }
        alive
    }

    /// Bytes since the last sign of life.
    pub(super) fn bytes_in_vain(&self) -> u64 {
        self.intake.bytes() - self.bytes_at_sign
    }

    /// Whether there was any sign of life.
    pub(super) fn is_alive(&self) -> bool {
        self.signs > 0
    }

    /// Numbers of packets passed on and of packets refused.
    pub(super) fn packets(&self) -> (u64, u64) {
        (self.packets, self.packets_refused)
    }

    pub(super) fn format(&self) -> Option<Format> {
        self.intake.format()
    }

    /// Memory held, bytes.
    pub(super) fn held_bytes(&self) -> usize {
        self.intake.held_bytes() + self.group.capacity() + self.held.capacity()
    }

    /// Counters of everything but packets.
    pub(super) fn stream(&self) -> ReceptionCounters {
        ReceptionCounters { frames: self.intake.frames(), ..self.stream.counters().clone() }
    }

    fn release(&mut self, out: &mut Vec<u8>) {
        while let Some(event) = self.intake.next_event() {
            let Event::Packet(packet) = event else {
                self.stream.accept(&event);
                continue;
            };
            self.has_new |= self.judge.mission.is_new(&packet.header);
            self.judge.see(&event, packet.header.kind);
            if self.judge.refused().is_some() {
                self.packets_refused += 1;
                continue;
            }
            packet.append_to(&mut self.group);
            self.grouped += 1;
            let ends = matches!(packet.header.segment, PacketSegment::Whole | PacketSegment::Last);
            if ends || self.group.len() > GROUP_BYTES_MAX {
                self.end_group();
                self.pass_on(out);
            }
        }
        if self.judge.refused().is_some() {
            self.end_group();
            self.refuse_held();
        }
    }

    /// Passes whole payloads on, if the instrument allows.
    fn pass_on(&mut self, out: &mut Vec<u8>) {
        if self.judge.passes() {
            out.append(&mut self.held);
            self.packets += std::mem::take(&mut self.held_packets);
        }
    }

    fn refuse_held(&mut self) {
        self.held = Vec::new();
        self.packets_refused += std::mem::take(&mut self.held_packets);
    }

    fn end_group(&mut self) {
        self.held.append(&mut self.group);
        self.held_packets += std::mem::take(&mut self.grouped);
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::super::answers::ASKS_HELD;
    use super::*;
    use crate::downlink::{DownlinkConfig, Transmission};
    use crate::frames::{AntennaResponse, Channel, EphemerisSegment, Housekeeping};

    fn instrument(name: &str) -> Instrument {
        Instrument {
            name: name.to_owned(),
            epoch_tai_s: 2_493_072_037.25,
            moon_radius_m: 1_737_100.0,
            satellites: 8,
            channels: vec![Channel { frequency_hz: 3e6, width_hz: 8e3 }],
            response: AntennaResponse::Isotropic,
            seed: 7,
            configuration_hash: 1,
            spectrometer: None,
            noiseless: false,
        }
    }

    /// Anyone may send, and ask.
    fn anyone() -> Preamble {
        Preamble::new(None, true)
    }

    /// A ground whose instrument is known.
    fn ours() -> Mission {
        let mission = Mission::default();
        assert!(mission.confirm(&instrument("ours")));
        mission
    }

    /// A description, positions in many segments, and housekeeping.
    fn sent(name: &str, format: Format) -> Vec<u8> {
        transmit(name, format, None)
    }

    /// The same, with visibilities that begin at `start`.
    fn with_block(name: &str, start: i64) -> Vec<u8> {
        transmit(name, Format::Packets, Some(block(start)))
    }

    fn transmit(name: &str, format: Format, block: Option<GroundFrame>) -> Vec<u8> {
        let config = DownlinkConfig { packet_bytes_max: 512, format, ..DownlinkConfig::default() };
        let (mut transmission, mut bytes) = (Transmission::new(&config).unwrap(), Vec::new());
        let positions_m = (0..8 * 40).map(|k| [f64::from(k), -2e6, 0.5]).collect();
        let frames = [
            GroundFrame::Instrument(instrument(name)),
            GroundFrame::Ephemeris(EphemerisSegment {
                start: MissionTime(0),
                step_ticks: 60_000_000,
                satellites: 8,
                positions_m,
            }),
            GroundFrame::Housekeeping(Housekeeping { time: MissionTime(9), sampled: 0, dropped: 0 }),
        ];
        for frame in frames.into_iter().chain(block) {
            transmission.send(&frame, &mut bytes).unwrap();
        }
        transmission.finish(&mut bytes);
        bytes
    }

    /// Everything that an intake passes on, piece by piece.
    fn through(sender: &mut SenderIntake, bytes: &[u8], piece: usize) -> (Vec<Vec<u8>>, bool) {
        let (mut pieces, mut foreign) = (Vec::new(), false);
        for bytes in bytes.chunks(piece) {
            let mut out = Vec::new();
            foreign |= sender.take(bytes, &mut out).is_err();
            pieces.push(out);
        }
        let mut out = Vec::new();
        let _ = sender.finish(&mut out);
        pieces.push(out);
        (pieces, foreign)
    }

    #[test]
    fn packets_come_out_as_they_were_sent_and_segments_together() {
        let plain = sent("ours", Format::Packets);
        for format in [Format::Packets, Format::Cadu] {
            for piece in [1, 100, 1 << 16] {
                let mut sender = SenderIntake::new(ours(), anyone());
                let (pieces, foreign) = through(&mut sender, &sent("ours", format), piece);
                assert!(!foreign && pieces.concat() == plain);
                // The description, the positions and the counts: for any pieces, no payload is divided.
                let handed = pieces.iter().filter(|piece| !piece.is_empty()).count();
                assert!(handed <= 3, "{handed}");
                assert_eq!(sender.format(), Some(format));
            }
        }
    }

    #[test]
    fn another_instrument_is_refused_from_its_description_on() {
        for format in [Format::Packets, Format::Cadu] {
            let mission = ours();
            let mut sender = SenderIntake::new(mission.clone(), anyone());
            let (pieces, foreign) = through(&mut sender, &sent("theirs", format), 1000);
            assert!(foreign && pieces.concat().is_empty());
            assert!(sender.packets().0 == 0 && sender.packets().1 > 10);
            // Also from a sender that began with the right one.
            let mut sender = SenderIntake::new(mission, anyone());
            let both = [sent("ours", format), sent("theirs", format)].concat();
            let (pieces, foreign) = through(&mut sender, &both, 1000);
            assert!(foreign && pieces.concat() == sent("ours", Format::Packets));
        }
    }

    /// Visibilities that begin at `start`.
    fn block(start: i64) -> GroundFrame {
        GroundFrame::Visibilities(VisibilityBlock {
            pair: crate::units::Pair { i: 0, j: 1 },
            start: MissionTime(start),
            offset_ticks: vec![0],
            duration_ticks: vec![10],
            value_k_sr: vec![num_complex::Complex32::ONE],
            weight: vec![1.0],
            flags: vec![crate::frames::Flags::GOOD],
            ..VisibilityBlock::default()
        })
    }

    #[test]
    fn only_visibilities_with_positions_make_an_instrument_the_grounds() {
        let format = Format::Packets;
        for (start, confirms) in [(5, true), (-7, false)] {
            let mission = Mission::default();
            // Descriptions and positions alone do not, however many.
            for name in ["forged", "more", "theirs"] {
                let mut sender = SenderIntake::new(mission.clone(), anyone());
                let (pieces, refused) = through(&mut sender, &sent(name, format), 1000);
                assert!(!refused && pieces.concat().is_empty() && sender.packets().1 > 10);
            }
            let bytes = with_block("ours", start);
            let mut sender = SenderIntake::new(mission.clone(), anyone());
            let (pieces, refused) = through(&mut sender, &bytes, 1000);
            assert!(!refused);
            match confirms {
                true => assert!(pieces.concat() == bytes),
                false => assert!(pieces.concat().is_empty()),
            }
            let mut sender = SenderIntake::new(mission, anyone());
            assert_eq!(through(&mut sender, &with_block("theirs", 5), 1000).1, confirms);
        }
    }

    #[test]
    fn what_is_not_confirmed_is_not_kept_for_long() {
        let mut sender = SenderIntake::new(Mission::default(), anyone());
        let bytes = sent("forged", Format::Packets);
        let mut ends = Vec::new();
        for _ in 0..=UNCONFIRMED_BYTES_MAX / bytes.len() {
            ends.extend(sender.take(&bytes, &mut Vec::new()).err());
        }
        assert_eq!(ends, [ConnectionEnd::Unconfirmed]);
        assert!(sender.finish(&mut Vec::new()) == Err(ConnectionEnd::Unconfirmed) && sender.packets().0 == 0);
    }

    #[test]
    fn an_instrument_that_does_not_fit_is_refused_and_replayed_packets_are_not_new() {
        let mission = Mission::default().with_instrument_check(Arc::new(|found| found.name != "unfit"));
        let mut sender = SenderIntake::new(mission.clone(), anyone());
        let bytes = with_block("unfit", 5);
        assert_eq!(sender.take(&bytes, &mut Vec::new()), Err(ConnectionEnd::UnfitInstrument));
        let bytes = with_block("ours", 900);
        for is_new in [true, false] {
            let mut sender = SenderIntake::new(mission.clone(), anyone());
            assert_eq!(sender.take(&bytes, &mut Vec::new()), Ok(Signs { is_alive: true, is_new }));
        }
    }

    #[test]
    fn a_sender_asks_before_its_packets_or_not_at_all() {
        let bytes = sent("ours", Format::Packets);
        let asking = [ASKS_HELD, &bytes].concat();
        for piece in [1, 5, ASKS_HELD.len(), 1000] {
            let mut sender = SenderIntake::new(ours(), anyone());
            let (pieces, _) = through(&mut sender, &asking, piece);
            assert!(sender.preamble.asks_held() && sender.preamble.bytes() == ASKS_HELD.len() as u64);
            // The line is no part of the stream.
            assert!(pieces.concat() == bytes && sender.intake.bytes() == bytes.len() as u64);
            // Whoever begins in another way sends packets, and what is not a packet is counted.
            for start in [&ASKS_HELD[..7], b"answer hold\n", b"\nanswer held\n"] {
                let mut sender = SenderIntake::new(ours(), anyone());
                let (pieces, _) = through(&mut sender, &[start, &bytes].concat(), piece);
                assert!(!sender.preamble.asks_held() && pieces.concat() == bytes);
                assert_eq!(sender.stream().bytes_garbage, start.len() as u64);
            }
        }
        // The beginning of the line alone.
        let mut sender = SenderIntake::new(ours(), anyone());
        through(&mut sender, &ASKS_HELD[..4], 4);
        assert!(!sender.preamble.asks_held() && sender.intake.bytes() == 4);
    }

    #[test]
    fn without_checkpoints_nothing_is_taken_of_a_sender_that_asks_for_them() {
        let asking = [ASKS_HELD, &sent("ours", Format::Packets)].concat();
        let (mut sender, mut out) = (SenderIntake::new(ours(), Preamble::new(None, false)), Vec::new());
        assert_eq!(sender.take(&asking, &mut out), Err(ConnectionEnd::NoState));
        let _ = sender.finish(&mut out);
        assert!(out.is_empty() && sender.packets() == (0, 0));
    }

    proptest! {
        #[test]
        fn no_byte_is_unaccounted_for(
            damage in proptest::collection::vec((any::<prop::sample::Index>(), any::<u8>()), 0..6),
            cut in any::<prop::sample::Index>(),
            piece in 1..3000_usize,
        ) {
            let mut bytes = sent("ours", Format::Packets);
            for (at, octet) in damage {
                let at = at.index(bytes.len());
                bytes[at] ^= octet;
            }
            bytes.truncate(1 + cut.index(bytes.len()));
            let mut sender = SenderIntake::new(ours(), anyone());
            let (pieces, _) = through(&mut sender, &bytes, piece);
            let counters = sender.stream();
            let others = counters.bytes_garbage + counters.bytes_damaged + counters.bytes_truncated;
            prop_assert_eq!(pieces.concat().len() as u64 + others, bytes.len() as u64);
            prop_assert_eq!(sender.intake.bytes(), bytes.len() as u64);
        }
    }
}
