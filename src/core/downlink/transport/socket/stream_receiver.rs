//! The receiver of one sender's stream: finds complete packets and decides whether to forward them.

use super::instrument_filter::{InstrumentFilter, SharedReception};
use super::preamble::Preamble;
use super::report::ConnectionEnd;
use crate::downlink::receive::{Decoder, DownlinkReceiver, Event, ReceptionCounters};
use crate::downlink::wire::{Format, PacketSegment};

/// Maximum length of a payload whose segments are forwarded together; the ephemeris of a window has a hundredth of this.
const PAYLOAD_BYTES_MAX: usize = 1 << 20;

/// Maximum number of bytes of packets that are kept until visibilities with positions confirm their instrument: four times
/// the bytes after which a spacecraft repeats description and ephemeris (1 MiB by default).
const UNCONFIRMED_BYTES_MAX: usize = 1 << 22;

/// The packets and frames found in a piece of a stream.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) struct Activity {
    /// Whether the piece had a valid packet or frame.
    pub(super) has_valid: bool,
    /// Whether the piece had a valid packet that no connection had delivered before.
    pub(super) has_new: bool,
}

/// The receiver of one sender's stream. Its reception counters leave out valid packets, which the ground counts; here these are only
/// forwarded or refused.
pub(super) struct StreamReceiver {
    preamble: Preamble,
    receiver: DownlinkReceiver,
    /// Counts events other than valid packets.
    decoder: Decoder,
    filter: InstrumentFilter,
    reception: SharedReception,
    /// Packets of a payload without its last segment, and their number.
    partial_payload: Vec<u8>,
    partial_packets: u64,
    /// Packets of complete payloads that wait until the instrument is confirmed, and their number.
    unconfirmed: Vec<u8>,
    unconfirmed_packets: u64,
    packets: u64,
    packets_refused: u64,
    has_new: bool,
    /// Number of valid packets and frames at the last check, and the bytes of the stream until the latest of them.
    valid_items: u64,
    bytes_at_valid: u64,
}

impl StreamReceiver {
    pub(super) fn new(reception: SharedReception, preamble: Preamble) -> Self {
        Self {
            preamble,
            receiver: DownlinkReceiver::unfiltered(),
            decoder: Decoder::new(),
            filter: InstrumentFilter::new(reception.clone()),
            reception,
            partial_payload: Vec::new(),
            partial_packets: 0,
            unconfirmed: Vec::new(),
            unconfirmed_packets: 0,
            packets: 0,
            packets_refused: 0,
            has_new: false,
            valid_items: 0,
            bytes_at_valid: 0,
        }
    }

    /// Takes the next bytes; appends the packets that they complete and that may be forwarded to `out`.
    ///
    /// # Errors
    /// The instrument or the preamble is refused, or the instrument was not confirmed in time. From then on no packet is
    /// appended.
    pub(super) fn receive(&mut self, bytes: &[u8], out: &mut Vec<u8>) -> Result<Activity, ConnectionEnd> {
        let (buffered, bytes) = self.preamble.take(bytes)?;
        self.receiver.push(&buffered);
        self.receiver.push(bytes);
        self.forward(out)
    }

    /// Takes a datagram with complete packets, as [`StreamReceiver::receive`] does.
    ///
    /// # Errors
    /// The instrument is refused, or was not confirmed in time.
    pub(super) fn receive_datagram(
        &mut self,
        bytes: &[u8],
        out: &mut Vec<u8>,
    ) -> Result<Activity, ConnectionEnd> {
        self.receiver = DownlinkReceiver::unfiltered();
        self.receiver.push(bytes);
        self.receiver.finish();
        self.forward(out)
    }

    /// Takes a datagram that begins with a frame and continues the previous one, as [`StreamReceiver::receive`] does.
    ///
    /// # Errors
    /// The instrument is refused, or was not confirmed in time.
    pub(super) fn receive_continued(
        &mut self,
        bytes: &[u8],
        out: &mut Vec<u8>,
    ) -> Result<Activity, ConnectionEnd> {
        self.receiver.push_frame(bytes);
        self.forward(out)
    }

    /// Ends the stream; appends the remaining packets to `out`.
    ///
    /// # Errors
    /// The instrument or the preamble is refused, or the instrument was not confirmed.
    pub(super) fn finish(&mut self, out: &mut Vec<u8>) -> Result<(), ConnectionEnd> {
        let buffered = self.preamble.finish()?;
        self.receiver.push(&buffered);
        self.receiver.finish();
        self.drain_events(out);
        self.close_payload();
        self.forward_confirmed(out);
        self.record_valid();
        let is_unconfirmed = self.unconfirmed_packets > 0;
        self.refuse_unconfirmed();
        match self.filter.refusal() {
            Some(end) => Err(end),
            None if is_unconfirmed => Err(ConnectionEnd::Unconfirmed),
            None => Ok(()),
        }
    }

    pub(super) fn preamble(&self) -> &Preamble {
        &self.preamble
    }

    /// Number of bytes since the last valid packet or frame.
    pub(super) fn bytes_since_valid(&self) -> u64 {
        self.receiver.bytes() - self.bytes_at_valid
    }

    /// Whether the stream has had a valid packet or frame.
    pub(super) fn has_had_valid(&self) -> bool {
        self.valid_items > 0
    }

    /// Numbers of packets forwarded and of packets refused.
    pub(super) fn packets(&self) -> (u64, u64) {
        (self.packets, self.packets_refused)
    }

    /// Whether the stream so far is empty, or a downlink that had packets for the ground.
    pub(super) fn is_empty_or_downlink(&self) -> bool {
        self.receiver.bytes() == 0 || (self.packets > 0 && self.receiver.unsupported_frames().is_none())
    }

    /// Identifies a stream that is not a downlink; `None` if it is not recognised.
    pub(super) fn foreign_format(&self) -> Option<String> {
        self.receiver.foreign_format()
    }

    pub(super) fn format(&self) -> Option<Format> {
        self.receiver.format()
    }

    pub(super) fn memory_bytes(&self) -> usize {
        self.receiver.memory_bytes() + self.partial_payload.capacity() + self.unconfirmed.capacity()
    }

    /// Counters of everything except valid packets.
    pub(super) fn stream_counters(&self) -> ReceptionCounters {
        ReceptionCounters { frames: self.receiver.frames(), ..self.decoder.counters().clone() }
    }

    /// Appends the packets that may be forwarded to `out`.
    fn forward(&mut self, out: &mut Vec<u8>) -> Result<Activity, ConnectionEnd> {
        self.drain_events(out);
        let has_valid = self.record_valid();
        let has_new = std::mem::take(&mut self.has_new);
        match self.filter.refusal() {
            Some(end) => Err(end),
            None if self.unconfirmed.len() > UNCONFIRMED_BYTES_MAX => Err(ConnectionEnd::Unconfirmed),
            None => Ok(Activity { has_valid, has_new }),
        }
    }

    /// Records the number of valid packets and frames; returns whether it has increased since the last call.
    fn record_valid(&mut self) -> bool {
        // A run of one byte value or of sync markers can be a codeword, so only frames with a valid header count.
        let frames = self
            .receiver
            .frames()
            .map_or(0, |frames| frames.frames - frames.frames_foreign - frames.frames_malformed);
        let packets = self.packets + self.partial_packets + self.unconfirmed_packets + self.packets_refused;
        let has_valid = packets + frames > self.valid_items;
        if has_valid {
            (self.valid_items, self.bytes_at_valid) = (packets + frames, self.receiver.bytes());
        }
        has_valid
    }

    fn drain_events(&mut self, out: &mut Vec<u8>) {
        while let Some(event) = self.receiver.next_event() {
            let Event::Packet(packet) = event else {
                self.decoder.accept(&event);
                continue;
            };
            self.has_new |= self.reception.record_packet(&packet.header);
            self.filter.inspect(&event, packet.header.kind);
            if self.filter.refusal().is_some() {
                self.packets_refused += 1;
                continue;
            }
            packet.append_to(&mut self.partial_payload);
            self.partial_packets += 1;
            let is_last = matches!(packet.header.segment, PacketSegment::Whole | PacketSegment::Last);
            if is_last || self.partial_payload.len() > PAYLOAD_BYTES_MAX {
                self.close_payload();
                self.forward_confirmed(out);
            }
        }
        if self.filter.refusal().is_some() {
            self.close_payload();
            self.refuse_unconfirmed();
        }
    }

    /// Moves the packets of the partial payload to those that wait for confirmation.
    fn close_payload(&mut self) {
        self.unconfirmed.append(&mut self.partial_payload);
        self.unconfirmed_packets += std::mem::take(&mut self.partial_packets);
    }

    /// Forwards the packets of complete payloads, if the verdict allows it.
    fn forward_confirmed(&mut self, out: &mut Vec<u8>) {
        if self.filter.is_confirmed_after_update() {
            out.append(&mut self.unconfirmed);
            self.packets += std::mem::take(&mut self.unconfirmed_packets);
        }
    }

    /// Drops and counts the packets that wait for confirmation.
    fn refuse_unconfirmed(&mut self) {
        self.unconfirmed = Vec::new();
        self.packets_refused += std::mem::take(&mut self.unconfirmed_packets);
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use proptest::prelude::*;

    use super::super::answers::HELD_REQUEST;
    use super::*;
    use crate::downlink::{DownlinkConfig, Transmission};
    use crate::frames::{
        AntennaResponse, Channel, EphemerisSegment, GroundFrame, Housekeeping, Instrument, VisibilityBlock,
    };
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

    /// A preamble without stations, with checkpoints.
    fn preamble() -> Preamble {
        Preamble::new(None, true)
    }

    /// The state of a ground with an instrument.
    fn reception() -> SharedReception {
        let reception = SharedReception::default();
        assert!(reception.adopt_or_compare(&instrument("ours")));
        reception
    }

    /// A downlink with a description, an ephemeris in many segments, and housekeeping.
    fn sent(name: &str, format: Format) -> Vec<u8> {
        transmit(name, format, None)
    }

    /// A downlink with visibilities that begin at `start` in addition.
    fn with_block(name: &str, start: i64) -> Vec<u8> {
        transmit(name, Format::Packets, Some(block(start)))
    }

    fn transmit(name: &str, format: Format, block: Option<GroundFrame>) -> Vec<u8> {
        transmit_with(name, &DownlinkConfig { format, ..DownlinkConfig::default() }, block)
    }

    fn transmit_with(name: &str, config: &DownlinkConfig, block: Option<GroundFrame>) -> Vec<u8> {
        let config = DownlinkConfig { packet_bytes_max: 512, ..config.clone() };
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

    /// The packets that are forwarded for each piece, and whether the sender is refused.
    fn through(sender: &mut StreamReceiver, bytes: &[u8], piece: usize) -> (Vec<Vec<u8>>, bool) {
        let (mut pieces, mut refused) = (Vec::new(), false);
        for bytes in bytes.chunks(piece) {
            let mut out = Vec::new();
            refused |= sender.receive(bytes, &mut out).is_err();
            pieces.push(out);
        }
        let mut out = Vec::new();
        let _ = sender.finish(&mut out);
        pieces.push(out);
        (pieces, refused)
    }

    #[test]
    fn packets_are_forwarded_unchanged_and_segments_together() {
        let plain = sent("ours", Format::Packets);
        for format in [Format::Packets, Format::Cadu] {
            for piece in [1, 100, 1 << 16] {
                let mut sender = StreamReceiver::new(reception(), preamble());
                let (pieces, refused) = through(&mut sender, &sent("ours", format), piece);
                assert!(!refused && pieces.concat() == plain);
                // The description, the ephemeris and the counts: no payload is divided for any piece size.
                let forwarded = pieces.iter().filter(|piece| !piece.is_empty()).count();
                assert!(forwarded <= 3, "{forwarded}");
                assert_eq!(sender.format(), Some(format));
            }
        }
    }

    #[test]
    fn every_frame_in_a_datagram_of_its_own_is_taken_at_once() {
        for frame_bytes in [4 + 255, 4 + 5 * 255, 4 + 8 * 255] {
            let interleave = (frame_bytes - 4) / 255;
            let config = DownlinkConfig { interleave, format: Format::Cadu, ..DownlinkConfig::default() };
            let frames = transmit_with("ours", &config, None);
            let mut sender = StreamReceiver::new(reception(), preamble());
            let mut out = Vec::new();
            // Bad ones first: half a frame, and a whole one that cannot be corrected.
            let mut bad = frames[..frame_bytes].to_vec();
            bad[4..].fill(0x55);
            for datagram in [&frames[..frame_bytes / 2], &bad] {
                assert!(!sender.receive_continued(datagram, &mut out).unwrap().has_valid);
            }
            for frame in frames.chunks(frame_bytes) {
                assert!(sender.receive_continued(frame, &mut out).unwrap().has_valid, "{frame_bytes}");
            }
            assert!(out == sent("ours", Format::Packets));
        }
    }

    #[test]
    fn another_instrument_is_refused_from_its_description_on() {
        for format in [Format::Packets, Format::Cadu] {
            let reception = self::reception();
            let mut sender = StreamReceiver::new(reception.clone(), preamble());
            let (pieces, refused) = through(&mut sender, &sent("theirs", format), 1000);
            assert!(refused && pieces.concat().is_empty());
            assert!(sender.packets().0 == 0 && sender.packets().1 > 10);
            // Also after the description of the right instrument.
            let mut sender = StreamReceiver::new(reception, preamble());
            let both = [sent("ours", format), sent("theirs", format)].concat();
            let (pieces, refused) = through(&mut sender, &both, 1000);
            assert!(refused && pieces.concat() == sent("ours", Format::Packets));
        }
    }

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
    fn only_visibilities_with_positions_confirm_an_instrument() {
        let format = Format::Packets;
        for (start, confirms) in [(5, true), (-7, false)] {
            let reception = SharedReception::default();
            // Any number of descriptions and positions alone does not.
            for name in ["forged", "more", "theirs"] {
                let mut sender = StreamReceiver::new(reception.clone(), preamble());
                let (pieces, refused) = through(&mut sender, &sent(name, format), 1000);
                assert!(!refused && pieces.concat().is_empty() && sender.packets().1 > 10);
            }
            let bytes = with_block("ours", start);
            let mut sender = StreamReceiver::new(reception.clone(), preamble());
            let (pieces, refused) = through(&mut sender, &bytes, 1000);
            assert!(!refused);
            match confirms {
                true => assert!(pieces.concat() == bytes),
                false => assert!(pieces.concat().is_empty()),
            }
            let mut sender = StreamReceiver::new(reception, preamble());
            assert_eq!(through(&mut sender, &with_block("theirs", 5), 1000).1, confirms);
        }
    }

    #[test]
    fn unconfirmed_packets_are_kept_up_to_a_limit() {
        let mut sender = StreamReceiver::new(SharedReception::default(), preamble());
        let bytes = sent("forged", Format::Packets);
        let mut ends = Vec::new();
        for _ in 0..=UNCONFIRMED_BYTES_MAX / bytes.len() {
            ends.extend(sender.receive(&bytes, &mut Vec::new()).err());
        }
        assert_eq!(ends, [ConnectionEnd::Unconfirmed]);
        assert!(sender.finish(&mut Vec::new()) == Err(ConnectionEnd::Unconfirmed) && sender.packets().0 == 0);
    }

    #[test]
    fn an_unsupported_instrument_is_refused_and_replayed_packets_are_not_new() {
        let mut reception = SharedReception::default();
        reception.set_instrument_check(Arc::new(|found| found.name != "unfit"));
        let mut sender = StreamReceiver::new(reception.clone(), preamble());
        let bytes = with_block("unfit", 5);
        assert_eq!(sender.receive(&bytes, &mut Vec::new()), Err(ConnectionEnd::UnfitInstrument));
        let bytes = with_block("ours", 900);
        for has_new in [true, false] {
            let mut sender = StreamReceiver::new(reception.clone(), preamble());
            assert_eq!(sender.receive(&bytes, &mut Vec::new()), Ok(Activity { has_valid: true, has_new }));
        }
    }

    #[test]
    fn a_request_is_recognised_only_before_the_packets() {
        let bytes = sent("ours", Format::Packets);
        let requesting = [HELD_REQUEST, &bytes].concat();
        for piece in [1, 5, HELD_REQUEST.len(), 1000] {
            let mut sender = StreamReceiver::new(reception(), preamble());
            let (pieces, _) = through(&mut sender, &requesting, piece);
            assert!(sender.preamble.requests_held() && sender.preamble.bytes() == HELD_REQUEST.len() as u64);
            // The line is not part of the stream.
            assert!(pieces.concat() == bytes && sender.receiver.bytes() == bytes.len() as u64);
            // Any other beginning is part of the stream, and counts as garbage.
            for start in [&HELD_REQUEST[..7], b"answer hold\n", b"\nanswer held\n"] {
                let mut sender = StreamReceiver::new(reception(), preamble());
                let (pieces, _) = through(&mut sender, &[start, &bytes].concat(), piece);
                assert!(!sender.preamble.requests_held() && pieces.concat() == bytes);
                assert_eq!(sender.stream_counters().bytes_garbage, start.len() as u64);
            }
        }
        // Only the beginning of the line.
        let mut sender = StreamReceiver::new(reception(), preamble());
        through(&mut sender, &HELD_REQUEST[..4], 4);
        assert!(!sender.preamble.requests_held() && sender.receiver.bytes() == 4);
    }

    #[test]
    fn without_checkpoints_a_sender_that_requests_held_is_refused() {
        let requesting = [HELD_REQUEST, &sent("ours", Format::Packets)].concat();
        let (mut sender, mut out) =
            (StreamReceiver::new(reception(), Preamble::new(None, false)), Vec::new());
        assert_eq!(sender.receive(&requesting, &mut out), Err(ConnectionEnd::NoState));
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
            let mut sender = StreamReceiver::new(reception(), preamble());
            let (pieces, _) = through(&mut sender, &bytes, piece);
            let counters = sender.stream_counters();
            let others = counters.bytes_garbage + counters.bytes_damaged + counters.bytes_truncated;
            prop_assert_eq!(pieces.concat().len() as u64 + others, bytes.len() as u64);
            prop_assert_eq!(sender.receiver.bytes(), bytes.len() as u64);
        }
    }
}
