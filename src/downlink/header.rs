//! Packet headers: CCSDS 133.0-B, section 4.1, and our own fields behind them.

use crc_fast::{CrcAlgorithm, checksum};

use super::cuc::CucTime;
use super::kind::Kind;

/// Version of headers and payloads; a receiver skips packets of another one and counts them.
pub const FORMAT_VERSION: u8 = 1;

/// Octets before the payload.
pub const HEADER_OCTETS: usize = 22;

/// Octets after the payload: CRC-32C.
pub const TRAILER_OCTETS: usize = 4;

/// Greatest packet that the 16-bit length field allows.
pub const PACKET_OCTETS_MAX: usize = 65_542;

const PRIMARY_OCTETS: usize = 6;
const MAGIC: u8 = 0x4C;
/// Version 000, telemetry, secondary header: the bits above the APID.
const IDENTIFICATION: u16 = 1 << 11;
const COUNT_BITS: u32 = 14;

/// Bits of a packet count.
pub(super) const COUNT_MAX: u64 = (1 << 46) - 1;

/// Segmentation flags: where in its payload a packet stands.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u8)]
pub enum Segment {
    /// Neither first nor last.
    Continuation = 0b00,
    /// The first of several.
    First = 0b01,
    /// The last of several.
    Last = 0b10,
    /// The whole payload.
    Whole = 0b11,
}

/// The headers of one packet.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct PacketHeader {
    /// Kind, by APID.
    pub kind: Kind,
    /// Place in the payload.
    pub segment: Segment,
    /// Packets of this kind sent before this one, 46 bits.
    pub count: u64,
    /// Time at which the packet was made.
    pub time: CucTime,
    /// Format version.
    pub version: u8,
    /// Octets of the packet from the first of its headers to the last of its check.
    pub octets: usize,
}

impl PacketHeader {
    /// The headers as they are sent.
    ///
    /// `octets` must be in `HEADER_OCTETS + TRAILER_OCTETS ..= PACKET_OCTETS_MAX`.
    #[must_use]
    pub fn to_octets(&self) -> [u8; HEADER_OCTETS] {
        let identification = IDENTIFICATION | self.kind.apid();
        let low = (self.count & ((1 << COUNT_BITS) - 1)) as u16;
        let sequence = u16::from(self.segment as u8) << COUNT_BITS | low;
        let length = self.octets.saturating_sub(PRIMARY_OCTETS + 1) as u16;
        let high = (self.count >> COUNT_BITS) as u32;
        let mut out = [0; HEADER_OCTETS];
        out[0..2].copy_from_slice(&identification.to_be_bytes());
        out[2..4].copy_from_slice(&sequence.to_be_bytes());
        out[4..6].copy_from_slice(&length.to_be_bytes());
        out[6..14].copy_from_slice(&self.time.to_octets());
        out[14] = MAGIC;
        out[15] = self.version;
        out[16..20].copy_from_slice(&high.to_be_bytes());
        let check = header_check(&out);
        out[20..22].copy_from_slice(&check.to_be_bytes());
        out
    }

    /// The headers that `octets` begin with; `None` if they are not ours or their check fails.
    #[must_use]
    pub fn parse(octets: &[u8]) -> Option<Self> {
        let octets: &[u8; HEADER_OCTETS] = octets.first_chunk()?;
        let word = |at: usize| u16::from_be_bytes([octets[at], octets[at + 1]]);
        let kind = Kind::of_apid(word(0) ^ IDENTIFICATION)?;
        let length = usize::from(word(4)) + PRIMARY_OCTETS + 1;
        if octets[14] != MAGIC || length < HEADER_OCTETS + TRAILER_OCTETS {
            return None;
        }
        let time = CucTime::from_octets(*octets[6..].first_chunk()?)?;
        if word(20) != header_check(octets) {
            return None;
        }
        let high = u32::from_be_bytes(*octets[16..].first_chunk()?);
        Some(Self {
            kind,
            segment: match word(2) >> COUNT_BITS {
                0b00 => Segment::Continuation,
                0b01 => Segment::First,
                0b10 => Segment::Last,
                _ => Segment::Whole,
            },
            count: u64::from(high) << COUNT_BITS | u64::from(word(2) & ((1 << COUNT_BITS) - 1)),
            time,
            version: octets[15],
            octets: length,
        })
    }

    /// First octet of every packet: the APIDs have their upper three bits in common.
    pub(super) const FIRST_OCTET: u8 = ((IDENTIFICATION | super::kind::APID_BASE) >> 8) as u8;
}

/// CRC-16 as CCSDS has it (0x1021, start 0xFFFF, not reflected) of the octets before the check.
fn header_check(octets: &[u8; HEADER_OCTETS]) -> u16 {
    checksum(CrcAlgorithm::Crc16Ibm3740, &octets[..HEADER_OCTETS - 2]) as u16
}

/// CRC-32C of a packet without its last four octets.
pub(super) fn packet_check(octets: &[u8]) -> [u8; TRAILER_OCTETS] {
    crc_fast::crc32_iscsi(octets).to_be_bytes()
}

/// Whether the last four octets of a packet are the check of the others.
pub(super) fn packet_holds(octets: &[u8]) -> bool {
    octets.split_last_chunk().is_some_and(|(body, check)| packet_check(body) == *check)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn header() -> PacketHeader {
        PacketHeader {
            kind: Kind::Visibilities,
            segment: Segment::Whole,
            count: (5 << 14) | 7,
            time: CucTime(0x749E_3B80 << 24),
            version: FORMAT_VERSION,
            octets: 100,
        }
    }

    #[test]
    fn fields_stand_where_the_standard_puts_them() {
        let octets = header().to_octets();
        // Version 000, type 0, secondary header 1, APID 0x103; flags 11, count 7; length 100 - 7.
        assert_eq!(octets[..6], [0x09, 0x03, 0xC0, 0x07, 0x00, 93]);
        assert_eq!(octets[0], PacketHeader::FIRST_OCTET);
        assert_eq!(octets[16..20], [0, 0, 0, 5]);
        assert_eq!(PacketHeader::parse(&octets), Some(header()));
    }

    #[test]
    fn checks_are_the_published_ones() {
        // Catalogue of parametrised CRC algorithms: check values of "123456789".
        assert_eq!(checksum(CrcAlgorithm::Crc16Ibm3740, b"123456789"), 0x29B1);
        assert_eq!(packet_check(b"123456789"), 0xE306_9283_u32.to_be_bytes());
    }

    #[test]
    fn any_flipped_bit_of_the_header_is_noticed() {
        let octets = header().to_octets();
        for bit in 0..8 * HEADER_OCTETS {
            let mut flipped = octets;
            flipped[bit / 8] ^= 1 << (bit % 8);
            assert_eq!(PacketHeader::parse(&flipped), None, "bit {bit}");
        }
    }

    #[test]
    fn greatest_count_and_length_survive() {
        let header =
            PacketHeader { count: COUNT_MAX, octets: PACKET_OCTETS_MAX, segment: Segment::Last, ..header() };
        assert_eq!(PacketHeader::parse(&header.to_octets()), Some(header));
    }
}
