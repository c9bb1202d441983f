//! The bytes of one sender to whole packets.

use std::sync::{Arc, Mutex, PoisonError};

use super::report::ConnectionEnd;
use crate::downlink::receive::cadu::FrameCounters;
use crate::downlink::receive::{Decoder, Event, Intake, Packet, ReceptionCounters};
use crate::downlink::wire::{Format, HEADER_BYTES, Kind, PacketSegment, packet_check};
use crate::frames::{GroundFrame, Instrument};

/// Segments of a payload are kept together up to this number of bytes; the ephemeris of a window is a hundredth of it.
const GROUP_BYTES_MAX: usize = 1 << 20;

/// The ground's instrument: that of its state, or the first that a sender describes. Shared by all connections.
#[derive(Clone, Debug, Default)]
pub(super) struct Mission(Arc<Mutex<Option<Instrument>>>);

impl Mission {
    pub(super) fn of(instrument: Option<Instrument>) -> Self {
        Self(Arc::new(Mutex::new(instrument)))
    }

    /// Whether an instrument is the ground's. The first one becomes the ground's.
    fn agrees(&self, found: &Instrument) -> bool {
        let mut known = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        known.get_or_insert_with(|| found.clone()) == found
    }
}

/// The receiver of one connection. It counts everything but packets, which the ground counts.
#[derive(Debug)]
pub(super) struct SenderIntake {
    intake: Intake,
    stream: Decoder,
    /// Decodes instrument descriptions only.
    instruments: Decoder,
    mission: Mission,
    /// Packets of a payload that lacks its last segment.
    group: Vec<u8>,
    grouped: u64,
    packets: u64,
    packets_refused: u64,
    foreign: bool,
    /// Sound packets and frames at the last sign of life, and the bytes until then.
    signs: u64,
    bytes_at_sign: u64,
}

impl SenderIntake {
    pub(super) fn new(mission: Mission) -> Self {
        Self {
            intake: Intake::unfiltered(),
            stream: Decoder::new(),
            instruments: Decoder::new(),
            mission,
            group: Vec::new(),
            grouped: 0,
            packets: 0,
            packets_refused: 0,
            foreign: false,
            signs: 0,
            bytes_at_sign: 0,
        }
    }

    /// Takes the next bytes and appends the packets that they complete to `out`. Returns whether there was a sign of
    /// life: a sound packet or frame.
    ///
    /// # Errors
    /// [`ConnectionEnd::OtherInstrument`]: from then on no packet is appended.
    pub(super) fn take(&mut self, bytes: &[u8], out: &mut Vec<u8>) -> Result<bool, ConnectionEnd> {
        self.intake.push(bytes);
        self.hand_out(out);
        let alive = self.look_for_signs();
        if self.foreign { Err(ConnectionEnd::OtherInstrument) } else { Ok(alive) }
    }

    /// Ends the stream; appends the remaining packets.
    pub(super) fn finish(&mut self, out: &mut Vec<u8>) {
        self.intake.finish();
        self.hand_out(out);
        self.end_group(out);
        self.look_for_signs();
    }

    /// Whether a sound packet or frame has arrived since the last check.
    fn look_for_signs(&mut self) -> bool {
        // Blocks of equal octets and streams of markers are codewords too, so only valid frames count.
        let ours = |frames: FrameCounters| frames.frames - frames.frames_foreign - frames.frames_malformed;
        let frames = self.intake.frames().map_or(0, ours);
        let signs = self.packets + self.grouped + self.packets_refused + frames;
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
        self.intake.held_bytes() + self.group.capacity()
    }

    /// Counters of everything but packets.
    pub(super) fn stream(&self) -> ReceptionCounters {
        ReceptionCounters { frames: self.intake.frames(), ..self.stream.counters().clone() }
    }

    fn hand_out(&mut self, out: &mut Vec<u8>) {
        while let Some(event) = self.intake.next_event() {
            let Event::Packet(packet) = event else {
                self.stream.accept(&event);
                continue;
            };
            if packet.header.kind == Kind::Instrument && !self.foreign {
                let found = self.instruments.accept(&event);
                let other =
                    |frame| matches!(frame, GroundFrame::Instrument(found) if !self.mission.agrees(&found));
                let contradicts = self.instruments.counters().instruments_contradictory > 0;
                self.foreign = contradicts || found.is_some_and(other);
            }
            if self.foreign {
                self.packets_refused += 1;
                continue;
            }
            append(&packet, &mut self.group);
            self.grouped += 1;
            let ends = matches!(packet.header.segment, PacketSegment::Whole | PacketSegment::Last);
            if ends || self.group.len() > GROUP_BYTES_MAX {
                out.append(&mut self.group);
                self.packets += std::mem::take(&mut self.grouped);
            }
        }
        if self.foreign {
            self.group.clear();
            self.packets_refused += std::mem::take(&mut self.grouped);
        }
    }

    fn end_group(&mut self, out: &mut Vec<u8>) {
        out.append(&mut self.group);
        self.packets += std::mem::take(&mut self.grouped);
    }
}

/// Appends a packet as it was sent. Parsed headers hold every bit of the originals.
fn append(packet: &Packet<'_>, out: &mut Vec<u8>) {
    let start = out.len();
    out.reserve(packet.header.bytes.min(HEADER_BYTES + packet.payload.len() + 4));
    out.extend_from_slice(&packet.header.to_bytes());
    out.extend_from_slice(packet.payload);
    let check = packet_check(&out[start..]);
    out.extend_from_slice(&check);
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;
    use crate::downlink::{DownlinkConfig, Transmission};
    use crate::frames::{AntennaResponse, Channel, EphemerisSegment, Housekeeping};
    use crate::units::MissionTime;

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

    /// A description, positions in many segments, and housekeeping.
    fn sent(name: &str, format: Format) -> Vec<u8> {
        let config = DownlinkConfig { packet_bytes_max: 512, format, ..DownlinkConfig::default() };
        let (mut transmission, mut bytes) = (Transmission::new(&config).unwrap(), Vec::new());
        let positions_m = (0..8 * 40).map(|k| [f64::from(k), -2e6, 0.5]).collect();
        for frame in [
            GroundFrame::Instrument(instrument(name)),
            GroundFrame::Ephemeris(EphemerisSegment {
                start: MissionTime(0),
                step_ticks: 60_000_000,
                satellites: 8,
                positions_m,
            }),
            GroundFrame::Housekeeping(Housekeeping { time: MissionTime(9), sampled: 0, dropped: 0 }),
        ] {
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
        sender.finish(&mut out);
        pieces.push(out);
        (pieces, foreign)
    }

    #[test]
    fn packets_come_out_as_they_were_sent_and_segments_together() {
        let plain = sent("ours", Format::Packets);
        for format in [Format::Packets, Format::Cadu] {
            for piece in [1, 100, 1 << 16] {
                let mut sender = SenderIntake::new(Mission::default());
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
            let mission = Mission::default();
            through(&mut SenderIntake::new(mission.clone()), &sent("ours", format), 1000);
            let mut sender = SenderIntake::new(mission.clone());
            let (pieces, foreign) = through(&mut sender, &sent("theirs", format), 1000);
            assert!(foreign && pieces.concat().is_empty());
            assert!(sender.packets().0 == 0 && sender.packets().1 > 10);
            // Also from a sender that began with the right one.
            let mut sender = SenderIntake::new(mission);
            let both = [sent("ours", format), sent("theirs", format)].concat();
            let (pieces, foreign) = through(&mut sender, &both, 1000);
            assert!(foreign && pieces.concat() == sent("ours", Format::Packets));
        }
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
            let mut sender = SenderIntake::new(Mission::default());
            let (pieces, _) = through(&mut sender, &bytes, piece);
            let counters = sender.stream();
            let others = counters.bytes_garbage + counters.bytes_damaged + counters.bytes_truncated;
            prop_assert_eq!(pieces.concat().len() as u64 + others, bytes.len() as u64);
            prop_assert_eq!(sender.intake.bytes(), bytes.len() as u64);
        }
    }
}
