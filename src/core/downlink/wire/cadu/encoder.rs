//! Encodes packets as CADUs, on the spacecraft.

use super::framer::{Framer, PACKET_HEADER_BYTES};
use super::reed_solomon::ReedSolomon;
use super::{HOUSEKEEPING, IDLE, SCIENCE, SYNC_MARKER, randomize};
use crate::downlink::config::{DownlinkConfig, Format};
use crate::downlink::wire::PacketKind;

impl DownlinkConfig {
    /// The Reed-Solomon code of the frames; `None` for plain packets.
    #[must_use]
    #[doc(hidden)]
    pub fn code(&self) -> Option<ReedSolomon> {
        ReedSolomon::new(self.interleave).filter(|_| self.format == Format::Cadu)
    }

    /// The frame encoder of the configured format; `None` for plain packets.
    #[must_use]
    #[doc(hidden)]
    pub fn encoder(&self) -> Option<CaduEncoder> {
        self.code().map(|code| CaduEncoder::new(code, self.spacecraft_id, self.idle_frames))
    }
}

/// Fills transfer frames with packets and encodes the frames as CADUs.
#[derive(Debug)]
pub struct CaduEncoder {
    code: ReedSolomon,
    idle_frames: u32,
    science: Framer,
    housekeeping: Framer,
    idle: Framer,
    in_pass: bool,
}

impl CaduEncoder {
    /// An encoder whose counts start at 0; each pass starts with `idle_frames` frames of idle data.
    #[must_use]
    pub fn new(code: ReedSolomon, spacecraft: u8, idle_frames: u32) -> Self {
        let framer = |channel| Framer::new(spacecraft, channel, code.data_bytes());
        Self {
            code,
            idle_frames,
            science: framer(SCIENCE),
            housekeeping: framer(HOUSEKEEPING),
            idle: framer(IDLE),
            in_pass: false,
        }
    }

    /// Appends the CADUs that the packets fill. Ignores an incomplete packet at the end.
    pub fn encode(&mut self, packets: &[u8], out: &mut Vec<u8>) {
        let code = self.code;
        if !std::mem::replace(&mut self.in_pass, true) {
            for _ in 0..self.idle_frames {
                self.idle.send_idle(|frame| code_frame(code, frame, out));
            }
        }
        let mut rest = packets;
        while let Some(header) = rest.first_chunk::<PACKET_HEADER_BYTES>() {
            let bytes = PACKET_HEADER_BYTES + 1 + usize::from(u16::from_be_bytes([header[4], header[5]]));
            let Some((packet, after)) = rest.split_at_checked(bytes) else { return };
            rest = after;
            let apid = u16::from_be_bytes([header[0], header[1]]) & 0x7FF;
            let is_housekeeping = apid == PacketKind::Housekeeping.apid();
            let framer = if is_housekeeping { &mut self.housekeeping } else { &mut self.science };
            framer.add(packet, |frame| code_frame(code, frame, out));
        }
    }

    /// Appends the partial frames, padded with idle packets, so that the start of a pass does not wait for its end. The
    /// science channel comes first, as it has the instrument description.
    pub fn flush(&mut self, out: &mut Vec<u8>) {
        let code = self.code;
        self.science.flush(|frame| code_frame(code, frame, out));
        self.housekeeping.flush(|frame| code_frame(code, frame, out));
    }

    /// Ends a pass: flushes the partial frames. The next pass begins with idle frames.
    pub fn end_pass(&mut self, out: &mut Vec<u8>) {
        self.flush(out);
        self.in_pass = false;
    }
}

fn code_frame(code: ReedSolomon, frame: &[u8], out: &mut Vec<u8>) {
    out.extend_from_slice(&SYNC_MARKER.to_be_bytes());
    let start = out.len();
    out.extend_from_slice(frame);
    out.resize(start + code.block_bytes(), 0);
    code.encode(&mut out[start..]);
    randomize(&mut out[start..]);
}
