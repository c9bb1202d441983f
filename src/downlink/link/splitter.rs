//! Splits an undamaged downlink into what a link can lose: passes, and frames or packets.

use std::collections::BTreeMap;

use crate::downlink::error::DownlinkError;
use crate::downlink::wire::cadu::{
    FRAME_HEADER_BYTES, FrameHeader, HOUSEKEEPING, IDLE, ReedSolomon, SYNC_MARKER, SYNC_MARKER_BYTES,
    randomize,
};
use crate::downlink::wire::payload::{decode_housekeeping, visibilities_in};
use crate::downlink::wire::{HEADER_BYTES, Kind, PacketHeader, TRAILER_BYTES};
use crate::frames::Housekeeping;

/// Octets of a space packet's primary header.
const PRIMARY_BYTES: usize = 6;

/// Leading octets of a packet that are kept: more than a housekeeping packet has.
const HEAD_BYTES: usize = 128;

/// A coded frame, or a packet if packets are sent plain.
#[derive(Debug)]
pub(super) struct Unit {
    pub(super) bytes: Vec<u8>,
    /// Virtual channel and count of a coded frame.
    pub(super) frame: Option<(u8, u32)>,
}

/// A packet, and the units that hold it.
#[derive(Debug)]
pub(super) struct SentPacket {
    pub(super) apid: u16,
    pub(super) count: u64,
    pub(super) visibilities: u64,
    pub(super) units: Vec<usize>,
}

/// What is sent from the end of one window to the end of the next. No packet crosses from one pass into another.
#[derive(Debug, Default)]
pub(super) struct SentPass {
    pub(super) units: Vec<Unit>,
    pub(super) packets: Vec<SentPacket>,
    /// The spacecraft's own counts at the end of the pass.
    pub(super) report: Option<Housekeeping>,
    /// Whether it holds positions or visibilities: the next report ends it, and does not begin it.
    has_data: bool,
}

impl SentPass {
    /// Adds a packet that begins with `head`, or, if short, consists of it.
    fn add(&mut self, head: &[u8], units: Vec<usize>) {
        // Idle packets have no header of this format.
        let Some(header) = PacketHeader::parse(head) else { return };
        let payload = header.bytes - HEADER_BYTES - TRAILER_BYTES;
        let visibilities =
            if header.kind == Kind::Visibilities { visibilities_in(payload) as u64 } else { 0 };
        self.has_data |= matches!(header.kind, Kind::Ephemeris | Kind::Visibilities);
        if header.kind == Kind::Housekeeping {
            let payload = head.get(HEADER_BYTES..HEADER_BYTES + payload);
            self.report = payload.and_then(|payload| decode_housekeeping(payload).ok()).or(self.report);
        }
        self.packets.push(SentPacket { apid: header.kind.apid(), count: header.count, visibilities, units });
    }
}

/// An incomplete packet.
#[derive(Debug, Default)]
struct Open {
    head: Vec<u8>,
    bytes: usize,
    units: Vec<usize>,
}

/// Splits an undamaged downlink; holds one pass.
#[derive(Debug)]
pub(super) struct Splitter {
    /// Code of the frames; `None` for plain packets.
    code: Option<ReedSolomon>,
    buffer: Vec<u8>,
    offset: u64,
    pass: SentPass,
    open: BTreeMap<u8, Open>,
}

impl Splitter {
    /// A splitter for frames with the given code, or for plain packets.
    pub(super) fn new(code: Option<ReedSolomon>) -> Self {
        Self { code, buffer: Vec::new(), offset: 0, pass: SentPass::default(), open: BTreeMap::new() }
    }

    /// Takes the next bytes; passes each completed pass to `done`.
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
            let Some((bytes, ends)) = taken else { break };
            rest = &rest[bytes..];
            self.offset += bytes as u64;
            if ends && self.pass.has_data && self.open.values().all(|open| open.bytes == 0) {
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
            return Err(self.unsound());
        }
        let pass = std::mem::take(&mut self.pass);
        Ok((!pass.units.is_empty()).then_some(pass))
    }

    fn unsound(&self) -> DownlinkError {
        DownlinkError::Unsound { offset: self.offset }
    }

    /// Takes the next packet; returns its length and whether a pass ends with it.
    fn take_packet(&mut self, rest: &[u8]) -> Result<Option<(usize, bool)>, DownlinkError> {
        if rest.len() < HEADER_BYTES {
            return Ok(None);
        }
        let header = PacketHeader::parse(rest).ok_or_else(|| self.unsound())?;
        let Some(bytes) = rest.get(..header.bytes) else { return Ok(None) };
        let units = vec![self.pass.units.len()];
        self.pass.add(bytes, units);
        self.pass.units.push(Unit { bytes: bytes.to_vec(), frame: None });
        Ok(Some((header.bytes, header.kind == Kind::Housekeeping)))
    }

    /// Takes the next coded frame; returns its length and whether a pass may end with it.
    fn take_frame(&mut self, rest: &[u8], code: ReedSolomon) -> Result<Option<(usize, bool)>, DownlinkError> {
        let Some(bytes) = rest.get(..SYNC_MARKER_BYTES + code.block_bytes()) else { return Ok(None) };
        let (marker, block) = bytes.split_at(SYNC_MARKER_BYTES);
        let mut block = block.to_vec();
        randomize(&mut block);
        let sound = *marker == SYNC_MARKER.to_be_bytes() && code.decode(&mut block) == Ok(0);
        let header = FrameHeader::parse(&block).filter(|_| sound).ok_or_else(|| self.unsound())?;
        let unit = self.pass.units.len();
        self.pass.units.push(Unit { bytes: bytes.to_vec(), frame: Some((header.channel, header.count)) });
        if header.channel != IDLE {
            self.walk(header.channel, unit, &block[FRAME_HEADER_BYTES + 2..code.data_bytes()]);
        }
        Ok(Some((bytes.len(), header.channel == HOUSEKEEPING)))
    }

    /// Follows the packets of a virtual channel through a frame's zone.
    fn walk(&mut self, channel: u8, unit: usize, zone: &[u8]) {
        let open = self.open.entry(channel).or_default();
        let mut rest = zone;
        while !rest.is_empty() {
            if open.units.last() != Some(&unit) {
                open.units.push(unit);
            }
            let total = match open.head[..] {
                [_, _, _, _, high, low, ..] => {
                    PRIMARY_BYTES + 1 + usize::from(u16::from_be_bytes([high, low]))
                }
                _ => PRIMARY_BYTES,
            };
            let (part, after) = rest.split_at(rest.len().min(total - open.bytes));
            let wanted = HEAD_BYTES - open.head.len().min(HEAD_BYTES);
            open.head.extend_from_slice(&part[..part.len().min(wanted)]);
            open.bytes += part.len();
            rest = after;
            if total > PRIMARY_BYTES && open.bytes == total {
                let Open { head, units, .. } = std::mem::take(open);
                self.pass.add(&head, units);
            }
        }
    }
}
