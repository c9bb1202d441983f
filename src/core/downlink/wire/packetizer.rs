//! Encodes ground frames as packets, on the spacecraft.

use super::payload::{
    VISIBILITY_BYTES, check_visibilities, encode_ephemeris, encode_housekeeping, encode_instrument,
    encode_visibilities, visibilities_in,
};
use super::{
    COUNT_MAX, CucTime, FORMAT_VERSION, HEADER_BYTES, PacketHeader, PacketKind, PacketSegment, TRAILER_BYTES,
    packet_checksum,
};
use crate::downlink::config::DownlinkConfig;
use crate::downlink::error::DownlinkError;
use crate::frames::{EphemerisSegment, GroundFrame, Instrument, VisibilityBlock};
use crate::units::MissionTime;

/// Maximum number of ephemeris segments that are repeated: a window's, split at the formation's turnarounds.
const REPEATED_SEGMENTS_MAX: usize = 8;

impl DownlinkConfig {
    /// Rate available to visibilities, without headers and coding, bytes per second; `None` for no limit.
    #[must_use]
    #[doc(hidden)]
    pub fn payload_bytes_per_s(&self) -> Option<f64> {
        let payload = self.packet_bytes_max.saturating_sub(HEADER_BYTES + TRAILER_BYTES);
        let visibilities = VISIBILITY_BYTES * visibilities_in(payload).max(1);
        let overhead = self.expansion() * self.packet_bytes_max as f64 / visibilities as f64;
        (self.rate_bits_per_s_max > 0.0).then(|| self.rate_bits_per_s_max / 8.0 / overhead)
    }
}

/// Encodes ground frames as packets.
///
/// A visibility block becomes packets that can each be decoded alone, so that a lost one costs only its own
/// visibilities. Other payloads are segmented if they exceed a packet. The instrument description and the latest
/// ephemeris segments are repeated at intervals.
#[derive(Debug)]
pub struct Packetizer {
    packet_bytes_max: usize,
    repeat_bytes: u64,
    instrument: Option<Instrument>,
    /// The latest run of ephemeris segments, which is repeated.
    ephemeris: Vec<EphemerisSegment>,
    /// Whether the next segment continues this run, as no other data were sent since.
    continues_ephemeris: bool,
    /// Whether positions or visibilities were sent since the last housekeeping report.
    in_pass: bool,
    bytes_since_repeat: u64,
    /// Creation time of packets: the latest time of the data sampled so far.
    now: Option<MissionTime>,
    counts: [u64; PacketKind::ALL.len()],
    payload: Vec<u8>,
}

impl Packetizer {
    /// A packetizer whose counts start at 0.
    ///
    /// # Errors
    /// The first of [`DownlinkConfig::problems`].
    pub fn new(config: &DownlinkConfig) -> Result<Self, DownlinkError> {
        if let Some(problem) = config.problems().into_iter().next() {
            return Err(problem.into());
        }
        Ok(Self {
            packet_bytes_max: config.packet_bytes_max,
            repeat_bytes: config.repeat_bytes,
            instrument: None,
            ephemeris: Vec::new(),
            continues_ephemeris: false,
            in_pass: false,
            bytes_since_repeat: 0,
            now: None,
            counts: [0; PacketKind::ALL.len()],
            payload: Vec::new(),
        })
    }

    /// Appends the packets of a frame to `out`; leaves `out` unchanged on an error.
    ///
    /// # Errors
    /// [`DownlinkError::NoInstrument`] before the instrument description; [`DownlinkError::Frame`] for a frame that the
    /// ground would refuse; [`DownlinkError::Time`] for a time outside 1958-2094.
    pub fn encode(&mut self, frame: &GroundFrame, out: &mut Vec<u8>) -> Result<(), DownlinkError> {
        let (start, counts, now, in_pass) = (out.len(), self.counts, self.now, self.in_pass);
        let result = self.repeat(out).and_then(|()| self.send(frame, out));
        if result.is_err() {
            out.truncate(start);
            (self.counts, self.now, self.in_pass) = (counts, now, in_pass);
        }
        self.bytes_since_repeat += (out.len() - start) as u64;
        result
    }

    /// Repeats the instrument description and the ephemeris if they are due.
    fn repeat(&mut self, out: &mut Vec<u8>) -> Result<(), DownlinkError> {
        if self.bytes_since_repeat < self.repeat_bytes {
            return Ok(());
        }
        self.bytes_since_repeat = 0;
        if let Some(instrument) = self.instrument.clone() {
            self.send_instrument(&instrument, out)?;
        }
        let ephemeris = std::mem::take(&mut self.ephemeris);
        let sent = ephemeris.iter().try_for_each(|segment| self.send_ephemeris(segment, out));
        self.ephemeris = ephemeris;
        sent
    }

    /// Whether positions or visibilities were sent since the last housekeeping report, so that the next one ends the pass.
    #[must_use]
    pub fn is_in_pass(&self) -> bool {
        self.in_pass
    }

    fn send(&mut self, frame: &GroundFrame, out: &mut Vec<u8>) -> Result<(), DownlinkError> {
        match frame {
            GroundFrame::Instrument(instrument) => {
                let previous = self.instrument.replace(instrument.clone());
                self.send_instrument(instrument, out).inspect_err(|_| self.instrument = previous)
            }
            GroundFrame::Ephemeris(segment) => {
                self.send_ephemeris(segment, out)?;
                self.in_pass = true;
                self.keep_for_repeat(segment);
                Ok(())
            }
            GroundFrame::Visibilities(block) => {
                self.continues_ephemeris = false;
                self.send_visibilities(block, out)?;
                self.in_pass = true;
                Ok(())
            }
            GroundFrame::Housekeeping(counts) => {
                self.continues_ephemeris = false;
                self.payload.clear();
                encode_housekeeping(counts, &mut self.payload)?;
                let ends_pass = std::mem::take(&mut self.in_pass);
                let now = match (ends_pass && !counts.is_last(), self.now) {
                    (true, _) => self.advance(counts.time),
                    // These counts include data that are sent later, so they do not advance the clock.
                    (false, Some(now)) => now,
                    (false, None) => MissionTime::default().min(counts.time),
                };
                self.send_payload(PacketKind::Housekeeping, now, out)
            }
        }
    }

    fn send_instrument(&mut self, instrument: &Instrument, out: &mut Vec<u8>) -> Result<(), DownlinkError> {
        self.payload.clear();
        encode_instrument(instrument, &mut self.payload)?;
        self.send_payload(PacketKind::Instrument, self.now.unwrap_or_default(), out)
    }

    fn send_ephemeris(&mut self, segment: &EphemerisSegment, out: &mut Vec<u8>) -> Result<(), DownlinkError> {
        let instrument = self.instrument.as_ref().ok_or(DownlinkError::NoInstrument)?;
        self.payload.clear();
        encode_ephemeris(segment, instrument, &mut self.payload)?;
        // Positions are predictions, so they do not advance the clock.
        let now = *self.now.get_or_insert(segment.start);
        self.send_payload(PacketKind::Ephemeris, now, out)
    }

    fn keep_for_repeat(&mut self, segment: &EphemerisSegment) {
        if !std::mem::replace(&mut self.continues_ephemeris, true) {
            self.ephemeris.clear();
        }
        if self.ephemeris.len() < REPEATED_SEGMENTS_MAX {
            self.ephemeris.push(segment.clone());
        }
    }

    fn send_visibilities(&mut self, block: &VisibilityBlock, out: &mut Vec<u8>) -> Result<(), DownlinkError> {
        let instrument = self.instrument.as_ref().ok_or(DownlinkError::NoInstrument)?;
        check_visibilities(block, instrument)?;
        let per_packet = visibilities_in(self.packet_bytes_max - HEADER_BYTES - TRAILER_BYTES);
        for first in (0..block.len()).step_by(per_packet) {
            let range = first..block.len().min(first + per_packet);
            let last = range.end - 1;
            let end = i64::from(block.offset_ticks[last]) + i64::from(block.duration_ticks[last]);
            let now = self.advance(block.start.plus_ticks(end));
            let time = self.time_code(now)?;
            let start = out.len();
            out.resize(start + HEADER_BYTES, 0);
            encode_visibilities(block, range, out)?;
            self.seal(PacketKind::Visibilities, PacketSegment::Whole, time, start, out);
        }
        Ok(())
    }

    /// Sends `self.payload` in as many segments as needed.
    fn send_payload(
        &mut self,
        kind: PacketKind,
        time: MissionTime,
        out: &mut Vec<u8>,
    ) -> Result<(), DownlinkError> {
        let time = self.time_code(time)?;
        let payload = std::mem::take(&mut self.payload);
        let part_bytes = self.packet_bytes_max - HEADER_BYTES - TRAILER_BYTES;
        let segments = payload.len().div_ceil(part_bytes);
        for (k, part) in payload.chunks(part_bytes).enumerate() {
            let segment = match (k == 0, k + 1 == segments) {
                (true, true) => PacketSegment::Whole,
                (true, false) => PacketSegment::First,
                (false, true) => PacketSegment::Last,
                (false, false) => PacketSegment::Continuation,
            };
            let start = out.len();
            out.resize(start + HEADER_BYTES, 0);
            out.extend_from_slice(part);
            self.seal(kind, segment, time, start, out);
        }
        self.payload = payload;
        Ok(())
    }

    /// Fills in the headers of the packet that begins at `start` and appends its checksum.
    fn seal(
        &mut self,
        kind: PacketKind,
        segment: PacketSegment,
        time: CucTime,
        start: usize,
        out: &mut Vec<u8>,
    ) {
        let bytes = out.len() - start + TRAILER_BYTES;
        let count = &mut self.counts[kind.index()];
        let header = PacketHeader { kind, segment, count: *count, time, version: FORMAT_VERSION, bytes };
        *count = (*count + 1) & COUNT_MAX;
        out[start..start + HEADER_BYTES].copy_from_slice(&header.to_bytes());
        let check = packet_checksum(&out[start..]);
        out.extend_from_slice(&check);
    }

    /// Advances the clock to `time`, but never back; returns its time.
    fn advance(&mut self, time: MissionTime) -> MissionTime {
        *self.now.insert(self.now.map_or(time, |now| now.max(time)))
    }

    fn time_code(&self, time: MissionTime) -> Result<CucTime, DownlinkError> {
        let epoch_tai_s = self.instrument.as_ref().ok_or(DownlinkError::NoInstrument)?.epoch_tai_s;
        let error = || DownlinkError::Time { epoch_tai_s, time_s: time.seconds() };
        CucTime::new(epoch_tai_s, time).ok_or_else(error)
    }
}
