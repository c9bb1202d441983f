//! Fills the packet zones of one virtual channel's frames (CCSDS 732.0-B, section 4.1.4.2).

use super::frame::{FrameHeader, NO_HEADER, ZONE_START};

/// APID of idle packets: all ones. They have no secondary header.
pub(crate) const IDLE_APID: u16 = 0x7FF;
/// Octets of a space packet's primary header.
pub(crate) const PACKET_HEADER_BYTES: usize = 6;
/// Octet that fills idle packets; the randomizer provides bit transitions.
const IDLE_OCTET: u8 = 0x55;

const COUNT_BITS: u32 = 28;

/// Fills the frames of one virtual channel with packets.
#[derive(Debug)]
pub(super) struct Framer {
    spacecraft: u8,
    channel: u8,
    frame_bytes: usize,
    count: u32,
    /// The current frame, with its header still blank.
    frame: Vec<u8>,
    first_header: u16,
    idle: IdleData,
}

/// Content of idle frames: the pseudo-random sequence of x^32 + x^22 + x^2 + x + 1 from all ones, never restarted.
///
/// A block of equal octets would be a codeword at every depth of interleaving.
#[derive(Debug)]
struct IdleData(u32);

impl IdleData {
    fn octet(&mut self) -> u8 {
        let out = (self.0 >> 24) as u8;
        for _ in 0..8 {
            let next = (self.0 >> 31 ^ self.0 >> 21 ^ self.0 >> 1 ^ self.0) & 1;
            self.0 = self.0 << 1 | next;
        }
        out
    }
}

impl Framer {
    pub(super) fn new(spacecraft: u8, channel: u8, frame_bytes: usize) -> Self {
        let frame = vec![0; ZONE_START];
        Self {
            spacecraft,
            channel,
            frame_bytes,
            count: 0,
            frame,
            first_header: NO_HEADER,
            idle: IdleData(u32::MAX),
        }
    }

    /// Adds a packet; passes each frame that it fills to `send`.
    pub(super) fn add(&mut self, packet: &[u8], mut send: impl FnMut(&[u8])) {
        if self.first_header == NO_HEADER {
            self.first_header = (self.frame.len() - ZONE_START) as u16;
        }
        let mut rest = packet;
        while !rest.is_empty() {
            let (part, after) = rest.split_at(rest.len().min(self.frame_bytes - self.frame.len()));
            self.frame.extend_from_slice(part);
            rest = after;
            if self.frame.len() == self.frame_bytes {
                self.send_full(&mut send);
            }
        }
    }

    /// Pads the current frame with an idle packet, unless the frame is empty. The packet continues in a second frame if the
    /// first has no space for the shortest packet.
    pub(super) fn flush(&mut self, send: impl FnMut(&[u8])) {
        if self.frame.len() == ZONE_START {
            return;
        }
        let free = self.frame_bytes - self.frame.len();
        let zone = self.frame_bytes - ZONE_START;
        let length = if free > PACKET_HEADER_BYTES { free } else { free + zone };
        self.add(&idle_packet(length), send);
    }

    pub(super) fn send_idle(&mut self, mut send: impl FnMut(&[u8])) {
        // Idle data begins after the primary header, as there is no packet zone.
        let pointer = u16::from_be_bytes([self.idle.octet(), self.idle.octet()]);
        let rest = self.frame_bytes - ZONE_START;
        self.frame.extend((0..rest).map(|_| self.idle.octet()));
        self.write_headers(pointer);
        send(&self.frame);
        self.frame.truncate(ZONE_START);
    }

    fn send_full(&mut self, send: &mut impl FnMut(&[u8])) {
        self.write_headers(self.first_header);
        send(&self.frame);
        self.frame.truncate(ZONE_START);
        self.first_header = NO_HEADER;
    }

    /// Writes the headers of the frame, with the first header pointer or, in an idle frame, the octets in its place.
    fn write_headers(&mut self, pointer: u16) {
        let Self { spacecraft, channel, count, .. } = *self;
        let header = FrameHeader { spacecraft, channel, count, count_bits: COUNT_BITS };
        self.frame[..ZONE_START - 2].copy_from_slice(&header.to_bytes());
        self.frame[ZONE_START - 2..ZONE_START].copy_from_slice(&pointer.to_be_bytes());
        self.count = (count + 1) & ((1 << COUNT_BITS) - 1);
    }
}

/// An idle packet of `bytes` octets, which must be more than its header has.
fn idle_packet(bytes: usize) -> Vec<u8> {
    let mut packet = vec![IDLE_OCTET; bytes];
    let length = (bytes - PACKET_HEADER_BYTES - 1) as u16;
    packet[0..2].copy_from_slice(&IDLE_APID.to_be_bytes());
    packet[2..4].copy_from_slice(&(0b11_u16 << 14).to_be_bytes());
    packet[4..6].copy_from_slice(&length.to_be_bytes());
    packet
}
