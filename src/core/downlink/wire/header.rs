//! Packet headers: the primary header of CCSDS 133.0-B, section 4.1, and a mission-specific secondary header.

use crc_fast::{CrcAlgorithm, checksum};

use super::{CucTime, PacketKind};

/// Version of headers and payloads. A receiver skips packets of another version and counts them.
pub const FORMAT_VERSION: u8 = 1;

/// Bytes before the payload.
pub const HEADER_BYTES: usize = 22;

/// Bytes after the payload: CRC-32C.
pub const TRAILER_BYTES: usize = 4;

const PRIMARY_BYTES: usize = 6;
const MAGIC: u8 = 0x4C;
/// Bits above the APID: version 000, telemetry, secondary header present.
const IDENTIFICATION: u16 = 1 << 11;
const COUNT_BITS: u32 = 14;

/// Largest packet count: 46 bits.
pub const COUNT_MAX: u64 = (1 << 46) - 1;

/// Segmentation flags: which part of a payload a packet carries.
#[derive(Clone, Copy, Debug, PartialEq, Eq, bincode::Encode, bincode::Decode)]
#[repr(u8)]
pub enum PacketSegment {
    /// A segment between the first and the last.
    Continuation = 0b00,
    /// The first of several segments.
    First = 0b01,
    /// The last of several segments.
    Last = 0b10,
    /// The complete payload.
    Whole = 0b11,
}

/// The headers of one packet.
#[derive(Clone, Copy, Debug, PartialEq, Eq, bincode::Encode, bincode::Decode)]
pub struct PacketHeader {
    /// Kind, by APID.
    pub kind: PacketKind,
    /// Segmentation flags.
    pub segment: PacketSegment,
    /// Number of packets of this kind sent before this one, 46 bits.
    pub count: u64,
    /// Creation time of the packet.
    pub time: CucTime,
    /// Format version.
    pub version: u8,
    /// Length of the packet from its first header byte to the last checksum byte.
    pub bytes: usize,
}

impl PacketHeader {
    /// Encodes the headers; `bytes` must be in `HEADER_BYTES + TRAILER_BYTES ..= PACKET_BYTES_MAX`.
    #[must_use]
    pub fn to_bytes(&self) -> [u8; HEADER_BYTES] {
        let identification = IDENTIFICATION | self.kind.apid();
        let low = (self.count & ((1 << COUNT_BITS) - 1)) as u16;
        let sequence = u16::from(self.segment as u8) << COUNT_BITS | low;
        let length = self.bytes.saturating_sub(PRIMARY_BYTES + 1) as u16;
        let high = (self.count >> COUNT_BITS) as u32;
        let mut out = [0; HEADER_BYTES];
        out[0..2].copy_from_slice(&identification.to_be_bytes());
        out[2..4].copy_from_slice(&sequence.to_be_bytes());
        out[4..6].copy_from_slice(&length.to_be_bytes());
        out[6..14].copy_from_slice(&self.time.to_bytes());
        out[14] = MAGIC;
        out[15] = self.version;
        out[16..20].copy_from_slice(&high.to_be_bytes());
        let check = header_checksum(&out);
        out[20..22].copy_from_slice(&check.to_be_bytes());
        out
    }

    /// Parses the headers at the beginning of `bytes`; `None` for other headers or a bad checksum.
    #[must_use]
    pub fn parse(bytes: &[u8]) -> Option<Self> {
        let bytes: &[u8; HEADER_BYTES] = bytes.first_chunk()?;
        let word = |at: usize| u16::from_be_bytes([bytes[at], bytes[at + 1]]);
        let kind = PacketKind::of_apid(word(0) ^ IDENTIFICATION)?;
        let length = usize::from(word(4)) + PRIMARY_BYTES + 1;
        if bytes[14] != MAGIC || length < HEADER_BYTES + TRAILER_BYTES {
            return None;
        }
        let time = CucTime::from_bytes(*bytes[6..].first_chunk()?)?;
        if word(20) != header_checksum(bytes) {
            return None;
        }
        let high = u32::from_be_bytes(*bytes[16..].first_chunk()?);
        Some(Self {
            kind,
            segment: match word(2) >> COUNT_BITS {
                0b00 => PacketSegment::Continuation,
                0b01 => PacketSegment::First,
                0b10 => PacketSegment::Last,
                _ => PacketSegment::Whole,
            },
            count: u64::from(high) << COUNT_BITS | u64::from(word(2) & ((1 << COUNT_BITS) - 1)),
            time,
            version: bytes[15],
            bytes: length,
        })
    }

    /// First byte of every packet, since all APIDs share their upper three bits.
    pub(crate) const FIRST_BYTE: u8 = ((IDENTIFICATION | crate::downlink::wire::APID_BASE) >> 8) as u8;
}

/// CRC-16 of CCSDS (0x1021, start 0xFFFF, not reflected) of the header without its last two bytes.
fn header_checksum(bytes: &[u8; HEADER_BYTES]) -> u16 {
    checksum(CrcAlgorithm::Crc16Ibm3740, &bytes[..HEADER_BYTES - 2]) as u16
}

/// CRC-32C of headers and payload.
pub(crate) fn packet_checksum(bytes: &[u8]) -> [u8; TRAILER_BYTES] {
    crc_fast::crc32_iscsi(bytes).to_be_bytes()
}

/// Whether the last four bytes of a packet are the checksum of the others.
pub(crate) fn has_valid_checksum(bytes: &[u8]) -> bool {
    bytes.split_last_chunk().is_some_and(|(body, check)| packet_checksum(body) == *check)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::downlink::PACKET_BYTES_MAX;

    fn header() -> PacketHeader {
        PacketHeader {
            kind: PacketKind::Visibilities,
            segment: PacketSegment::Whole,
            count: (5 << 14) | 7,
            time: CucTime(0x749E_3B80 << 24),
            version: FORMAT_VERSION,
            bytes: 100,
        }
    }

    #[test]
    fn fields_are_at_their_standard_positions() {
        let bytes = header().to_bytes();
        // Version 000, type 0, secondary header 1, APID 0x103; flags 11, count 7; length 100 - 7.
        assert_eq!(bytes[..6], [0x09, 0x03, 0xC0, 0x07, 0x00, 93]);
        assert_eq!(bytes[0], PacketHeader::FIRST_BYTE);
        assert_eq!(bytes[16..20], [0, 0, 0, 5]);
        assert_eq!(PacketHeader::parse(&bytes), Some(header()));
    }

    #[test]
    fn checksums_have_the_published_check_values() {
        // Catalogue of parametrised CRC algorithms: check values of "123456789".
        assert_eq!(checksum(CrcAlgorithm::Crc16Ibm3740, b"123456789"), 0x29B1);
        assert_eq!(packet_checksum(b"123456789"), 0xE306_9283_u32.to_be_bytes());
    }

    #[test]
    fn any_flipped_bit_of_the_header_is_detected() {
        let bytes = header().to_bytes();
        for bit in 0..8 * HEADER_BYTES {
            let mut flipped = bytes;
            flipped[bit / 8] ^= 1 << (bit % 8);
            assert_eq!(PacketHeader::parse(&flipped), None, "bit {bit}");
        }
    }

    #[test]
    fn largest_count_and_length_are_encoded() {
        let header = PacketHeader {
            count: COUNT_MAX,
            bytes: PACKET_BYTES_MAX,
            segment: PacketSegment::Last,
            ..header()
        };
        assert_eq!(PacketHeader::parse(&header.to_bytes()), Some(header));
    }
}
