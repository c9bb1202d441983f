//! Splits an undamaged downlink into the units that a link can lose: passes, and frames or packets.

use std::collections::BTreeMap;

use crate::downlink::error::DownlinkError;
use crate::downlink::wire::cadu::{
    FRAME_HEADER_BYTES, FrameHeader, HOUSEKEEPING, IDLE, ReedSolomon, SYNC_MARKER, SYNC_MARKER_BYTES,
    randomize,
};
use crate::downlink::wire::payload::{decode_housekeeping, visibilities_in};
use crate::downlink::wire::{HEADER_BYTES, PacketHeader, PacketKind, TRAILER_BYTES};
use crate::frames::Housekeeping;

/// Octets of a space packet's primary header.
const PRIMARY_BYTES: usize = 6;

/// Number of leading octets that are kept of a packet: more than a housekeeping packet has.
const HEAD_BYTES: usize = 128;

/// A coded frame, or a packet in a downlink of plain packets.
#[derive(Debug)]
pub(super) struct Unit {
    pub(super) bytes: Vec<u8>,
    /// Virtual channel and count of a coded frame.
    pub(super) frame: Option<(u8, u32)>,
}

/// A packet and the units that hold parts of it.
#[derive(Debug)]
pub(super) struct SentPacket {
    pub(super) apid: u16,
    pub(super) count: u64,
    pub(super) visibilities: u64,
    pub(super) units: Vec<usize>,
}

/// The data sent from the end of one window to the end of the next. No packet continues in another pass.
#[derive(Debug, Default)]
pub(super) struct SentPass {
    pub(super) units: Vec<Unit>,
    pub(super) packets: Vec<SentPacket>,
    /// The spacecraft's counts at the end of the pass.
    pub(super) report: Option<Housekeeping>,
    /// Whether the pass has positions or visibilities. If so, the next report ends it.
    has_data: bool,
}

impl SentPass {
    /// Adds a packet whose first [`HEAD_BYTES`] bytes are `head`.
    fn add(&mut self, head: &[u8], units: Vec<usize>) {
        // Idle packets have no secondary header.
        let Some(header) = PacketHeader::parse(head) else { return };
        let payload = header.bytes - HEADER_BYTES - TRAILER_BYTES;
        let visibilities =
            if header.kind == PacketKind::Visibilities { visibilities_in(payload) as u64 } else { 0 };
        self.has_data |= matches!(header.kind, PacketKind::Ephemeris | PacketKind::Visibilities);
        if header.kind == PacketKind::Housekeeping {
            let payload = head.get(HEADER_BYTES..HEADER_BYTES + payload);
            self.report = payload.and_then(|payload| decode_housekeeping(payload).ok()).or(self.report);
        }
        self.packets.push(SentPacket { apid: header.kind.apid(), count: header.count, visibilities, units });
    }
}

/// An incomplete packet of a virtual channel.
#[derive(Debug, Default)]
struct PartialPacket {
    head: Vec<u8>,
    bytes: usize,
    units: Vec<usize>,
}

/// Splits an undamaged downlink into passes; holds one pass.
#[derive(Debug)]
pub(super) struct Splitter {
    /// Code of the frames; `None` for plain packets.
    code: Option<ReedSolomon>,
    buffer: Vec<u8>,
    offset: u64,
    pass: SentPass,
    /// The incomplete packet of each virtual channel.
    partial: BTreeMap<u8, PartialPacket>,
}

impl Splitter {
    /// A splitter for frames with the given code, or for plain packets.
    pub(super) fn new(code: Option<ReedSolomon>) -> Self {
        Self { code, buffer: Vec::new(), offset: 0, pass: SentPass::default(), partial: BTreeMap::new() }
    }

    /// Takes the next bytes; calls `done` with each completed pass.
    ///
    /// # Errors
    /// The bytes are not an undamaged downlink.
    pub(super) fn push(&mut self, bytes: &[u8], mut done: impl FnMut(SentPass)) -> Result<(), DownlinkError> {
        self.buffer.extend_from_slice(bytes);
        let buffer = std::mem::take(&mut self.buffer);
        let mut rest = buffer.as_slice();
        loop {
            let taken = match self.code {
                Some(code) => self.take_frame(rest, code)?,
                None => self.take_packet(rest)?,
            };
            let Some((bytes, may_end)) = taken else { break };
            rest = &rest[bytes..];
            self.offset += bytes as u64;
            if may_end && self.pass.has_data && self.partial.values().all(|partial| partial.bytes == 0) {
                done(std::mem::take(&mut self.pass));
            }
        }
        self.buffer = rest.to_vec();
        Ok(())
    }

    /// Ends the stream; returns the last pass, if it is not empty.
    ///
    /// # Errors
    /// The stream ends within a frame or packet.
    pub(super) fn finish(&mut self) -> Result<Option<SentPass>, DownlinkError> {
        if !self.buffer.is_empty() {
            return Err(self.damaged_input());
        }
        let pass = std::mem::take(&mut self.pass);
        Ok((!pass.units.is_empty()).then_some(pass))
    }

    fn damaged_input(&self) -> DownlinkError {
        DownlinkError::DamagedInput { offset: self.offset }
    }

    /// Takes the next packet; returns its length and whether a pass may end with it.
    fn take_packet(&mut self, rest: &[u8]) -> Result<Option<(usize, bool)>, DownlinkError> {
        if rest.len() < HEADER_BYTES {
            return Ok(None);
        }
        let header = PacketHeader::parse(rest).ok_or_else(|| self.damaged_input())?;
        let Some(bytes) = rest.get(..header.bytes) else { return Ok(None) };
        let units = vec![self.pass.units.len()];
        self.pass.add(bytes, units);
        self.pass.units.push(Unit { bytes: bytes.to_vec(), frame: None });
        Ok(Some((header.bytes, header.kind == PacketKind::Housekeeping)))
    }

    /// Takes the next coded frame; returns its length and whether a pass may end with it.
    fn take_frame(&mut self, rest: &[u8], code: ReedSolomon) -> Result<Option<(usize, bool)>, DownlinkError> {
        let Some(bytes) = rest.get(..SYNC_MARKER_BYTES + code.block_bytes()) else { return Ok(None) };
        let (marker, block) = bytes.split_at(SYNC_MARKER_BYTES);
        let mut block = block.to_vec();
        randomize(&mut block);
        let is_undamaged = *marker == SYNC_MARKER.to_be_bytes() && code.decode(&mut block) == Ok(0);
        let header =
            FrameHeader::parse(&block).filter(|_| is_undamaged).ok_or_else(|| self.damaged_input())?;
        let unit = self.pass.units.len();
        self.pass.units.push(Unit { bytes: bytes.to_vec(), frame: Some((header.channel, header.count)) });
        if header.channel != IDLE {
            self.follow_packets(header.channel, unit, &block[FRAME_HEADER_BYTES + 2..code.data_bytes()]);
        }
        Ok(Some((bytes.len(), header.channel == HOUSEKEEPING)))
    }

    /// Follows the packets of a virtual channel through the packet zone of a frame.
    fn follow_packets(&mut self, channel: u8, unit: usize, zone: &[u8]) {
        let partial = self.partial.entry(channel).or_default();
        let mut rest = zone;
        while !rest.is_empty() {
            if partial.units.last() != Some(&unit) {
                partial.units.push(unit);
            }
            let total = match partial.head[..] {
                [_, _, _, _, high, low, ..] => {
                    PRIMARY_BYTES + 1 + usize::from(u16::from_be_bytes([high, low]))
                }
                _ => PRIMARY_BYTES,
            };
            let (part, after) = rest.split_at(rest.len().min(total - partial.bytes));
            let wanted = HEAD_BYTES - partial.head.len().min(HEAD_BYTES);
            partial.head.extend_from_slice(&part[..part.len().min(wanted)]);
            partial.bytes += part.len();
            rest = after;
            if total > PRIMARY_BYTES && partial.bytes == total {
                let PartialPacket { head, units, .. } = std::mem::take(partial);
                self.pass.add(&head, units);
            }
        }
    }
}
