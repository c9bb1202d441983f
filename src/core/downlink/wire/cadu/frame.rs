//! Headers of AOS transfer frames (CCSDS 732.0-B, section 4.1).

/// Octets of a frame's primary header.
pub const FRAME_HEADER_BYTES: usize = 6;

/// Offset of the packet zone: the octets of the primary header and of the packet zone's header.
pub(crate) const ZONE_START: usize = FRAME_HEADER_BYTES + 2;

/// Virtual channel of instrument descriptions, ephemeris and visibilities.
pub const SCIENCE: u8 = 1;
/// Virtual channel of housekeeping.
pub const HOUSEKEEPING: u8 = 2;
/// Virtual channel of idle frames: all ones, as the standard requires.
pub const IDLE: u8 = 0x3F;

/// First header pointer of a zone in which no packet begins.
pub(crate) const NO_HEADER: u16 = 0x7FF;
/// First header pointer of a zone of idle data.
pub(crate) const IDLE_ZONE: u16 = 0x7FE;

const VERSION: u8 = 0b01;
const CYCLE_USED: u8 = 0x40;

/// A frame's primary header.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct FrameHeader {
    /// Spacecraft identifier.
    pub spacecraft: u8,
    /// Virtual channel, 6 bits.
    pub channel: u8,
    /// Number of frames of this virtual channel sent before this one, modulo `count_bits` bits.
    pub count: u32,
    /// Bits of the count: 24, or 28 with the count cycle, which the encoder uses.
    pub count_bits: u32,
}

impl FrameHeader {
    /// Encodes the header.
    #[must_use]
    pub fn to_bytes(self) -> [u8; FRAME_HEADER_BYTES] {
        let identification =
            u16::from(VERSION) << 14 | u16::from(self.spacecraft) << 6 | u16::from(self.channel);
        let [id_0, id_1] = identification.to_be_bytes();
        let [cycle, c0, c1, c2] = self.count.to_be_bytes();
        let signaling = if self.count_bits > 24 { CYCLE_USED | (cycle & 0x0F) } else { 0 };
        [id_0, id_1, c0, c1, c2, signaling]
    }

    /// Parses the header at the beginning of `bytes`; `None` for another frame version.
    #[must_use]
    pub fn parse(bytes: &[u8]) -> Option<Self> {
        let &[id_0, id_1, c0, c1, c2, signaling] = bytes.first_chunk()?;
        let identification = u16::from_be_bytes([id_0, id_1]);
        if identification >> 14 != u16::from(VERSION) {
            return None;
        }
        let has_cycle = signaling & CYCLE_USED != 0;
        let cycle = if has_cycle { signaling & 0x0F } else { 0 };
        Some(Self {
            spacecraft: (identification >> 6) as u8,
            channel: (identification & 0x3F) as u8,
            count: u32::from_be_bytes([cycle, c0, c1, c2]),
            count_bits: if has_cycle { 28 } else { 24 },
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn fields_are_at_their_standard_positions() {
        let header = FrameHeader { spacecraft: 0xA5, channel: 0x2A, count: 0xB12_3456, count_bits: 28 };
        // 01 10100101 101010 | 12 34 56 | replay 0, usage 1, spare 00, cycle 1011.
        assert_eq!(header.to_bytes(), [0b0110_1001, 0b0110_1010, 0x12, 0x34, 0x56, 0x4B]);
        assert_eq!(FrameHeader::parse(&header.to_bytes()), Some(header));
    }

    #[test]
    fn without_the_cycle_the_count_has_24_bits() {
        let header = FrameHeader { spacecraft: 1, channel: 2, count: 0xFF_FFFF, count_bits: 24 };
        assert_eq!(header.to_bytes()[5], 0);
        assert_eq!(FrameHeader::parse(&header.to_bytes()), Some(header));
        assert_eq!(FrameHeader::parse(&[0x20, 0, 0, 0, 0, 0]), None);
        assert_eq!(FrameHeader::parse(&[0x40]), None);
    }
}
