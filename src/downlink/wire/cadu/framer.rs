//! Packs packets into the packet zones of one virtual channel's frames (CCSDS 732.0-B, section 4.1.4.2).

use super::frame::{FrameHeader, NO_HEADER, ZONE_START};

/// Identification of idle packets: APID all ones, no secondary header.
pub(crate) const IDLE_APID: u16 = 0x7FF;
/// Octets of a space packet's primary header.
pub(crate) const PACKET_HEADER_BYTES: usize = 6;
/// Content of idle packets; the randomizer provides bit transitions.
const IDLE_OCTET: u8 = 0x55;

/// Bits of a frame count.
const COUNT_BITS: u32 = 28;

/// Fills the frames of one virtual channel.
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

/// Content of idle frames: the sequence of x^32 + x^22 + x^2 + x + 1 from all ones, never restarted.
///
/// A constant will not do: a block of equal octets is a codeword at every depth of interleaving.
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
                self.seal(&mut send);
            }
        }
    }

    /// Pads the current frame, unless it is empty, with an idle packet, which runs into a second frame if the room left is
    /// shorter than the shortest packet.
    pub(super) fn flush(&mut self, send: impl FnMut(&[u8])) {
        if self.frame.len() == ZONE_START {
            return;
        }
        let room = self.frame_bytes - self.frame.len();
        let zone = self.frame_bytes - ZONE_START;
        let length = if room > PACKET_HEADER_BYTES { room } else { room + zone };
        self.add(&idle_packet(length), send);
    }

    /// Sends a frame of idle data only.
    pub(super) fn idle(&mut self, mut send: impl FnMut(&[u8])) {
        // There is no packet zone: idle data begins after the primary header.
        let pointer = u16::from_be_bytes([self.idle.octet(), self.idle.octet()]);
        let rest = self.frame_bytes - ZONE_START;
        self.frame.extend((0..rest).map(|_| self.idle.octet()));
        self.head(pointer);
        send(&self.frame);
        self.frame.truncate(ZONE_START);
    }

    fn seal(&mut self, send: &mut impl FnMut(&[u8])) {
        self.head(self.first_header);
        send(&self.frame);
        self.frame.truncate(ZONE_START);
        self.first_header = NO_HEADER;
    }

    fn head(&mut self, pointer: u16) {
        let Self { spacecraft, channel, count, .. } = *self;
        let header = FrameHeader { spacecraft, channel, count, count_bits: COUNT_BITS };
        self.frame[..ZONE_START - 2].copy_from_slice(&header.to_bytes());
        self.frame[ZONE_START - 2..ZONE_START].copy_from_slice(&pointer.to_be_bytes());
        self.count = (count + 1) & ((1 << COUNT_BITS) - 1);
    }
}

/// An idle packet of `bytes` octets, which must exceed its header.
fn idle_packet(bytes: usize) -> Vec<u8> {
    let mut packet = vec![IDLE_OCTET; bytes];
    let length = (bytes - PACKET_HEADER_BYTES - 1) as u16;
    packet[0..2].copy_from_slice(&IDLE_APID.to_be_bytes());
    packet[2..4].copy_from_slice(&(0b11_u16 << 14).to_be_bytes());
    packet[4..6].copy_from_slice(&length.to_be_bytes());
    packet
}
