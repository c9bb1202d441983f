//! Assembles packets from the frames of one virtual channel, in any order of arrival.
//!
//! A frame yields the packets that lie entirely in it, and leaves at most two pieces: the end of a packet from an earlier
//! frame, and the beginning of a packet that continues in a later frame. Pieces are joined by frame counts, so a frame that
//! arrives late, or from another station, completes its packets.

use std::collections::BTreeMap;

use super::{ChannelCounts, FrameCounters};
use crate::downlink::receive::sequence::{Arrival, Sequence};
use crate::downlink::wire::cadu::DATA_BYTES;
use crate::downlink::wire::cadu::frame::{FrameHeader, IDLE_ZONE, NO_HEADER, ZONE_START};
use crate::downlink::wire::cadu::framer::{IDLE_APID, PACKET_HEADER_BYTES};
use crate::downlink::wire::{CucTime, PACKET_BYTES_MAX};

/// Maximum number of frames whose pieces are kept; bounds memory to some megabytes per channel.
const PIECES_MAX: usize = 4096;

/// Maximum number of frames that a packet can touch: the longest packet and the shortest frames.
const FRAMES_PER_PACKET_MAX: u64 = (PACKET_BYTES_MAX / (DATA_BYTES - ZONE_START) + 2) as u64;

/// Maximum number of frames that are kept to detect duplicates.
const SEEN_MAX: usize = 1 << 16;

/// Offset of unwrapped counts, so that earlier ones do not underflow.
const ORIGIN: u64 = 1 << 40;

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum PieceEnd {
    /// With its packet; another packet begins after it.
    Packet,
    /// With its frame; the packet may continue.
    Frame,
}

/// The incomplete pieces of a frame.
#[derive(Debug, Default)]
struct Pieces {
    /// The end, or a middle part, of a packet that begins in an earlier frame.
    tail: Option<(Vec<u8>, PieceEnd)>,
    /// The beginning of a packet that continues in later frames.
    head: Option<Vec<u8>>,
}

#[derive(Debug, Default)]
pub(super) struct Assembler {
    /// Highest unwrapped frame count.
    highest: Option<u64>,
    sequence: Sequence,
    /// Checksums of recent frames by count.
    seen: BTreeMap<u64, u32>,
    pieces: BTreeMap<u64, Pieces>,
    counts: ChannelCounts,
}

impl Assembler {
    pub(super) fn new(channel: u8) -> Self {
        Self { counts: ChannelCounts { channel, ..Default::default() }, ..Self::default() }
    }

    pub(super) fn counts(&self) -> &ChannelCounts {
        &self.counts
    }

    /// Number and bytes of the pieces that are kept.
    pub(super) fn fragments(&self) -> (u64, u64) {
        let tails = self.pieces.values().filter_map(|pieces| pieces.tail.as_ref().map(|(bytes, _)| bytes));
        let heads = self.pieces.values().filter_map(|pieces| pieces.head.as_ref());
        tails.chain(heads).fold((0, 0), |(count, bytes), piece| (count + 1, bytes + piece.len() as u64))
    }

    /// Approximate memory, bytes: pieces, and the entries of the maps.
    pub(super) fn memory_bytes(&self) -> usize {
        let entries =
            self.pieces.len() * size_of::<(u64, Pieces)>() + self.seen.len() * size_of::<(u64, u32)>();
        self.fragments().1 as usize + 2 * entries
    }

    /// Processes a frame; appends the packets that it completes to `out`.
    pub(super) fn receive(
        &mut self,
        header: FrameHeader,
        frame: &[u8],
        counters: &mut FrameCounters,
        out: &mut Vec<u8>,
    ) {
        let count = self.unwrap_count(header);
        if self.record_frame(count, frame) {
            self.counts.duplicates += 1;
            return;
        }
        let zone = &frame[ZONE_START..];
        let pointer = u16::from_be_bytes([frame[ZONE_START - 2], frame[ZONE_START - 1]]) & 0x7FF;
        let (tail, body) = match pointer {
            IDLE_ZONE => return,
            NO_HEADER => ((zone, PieceEnd::Frame), &zone[zone.len()..]),
            at => match zone.split_at_checked(usize::from(at)) {
                Some((tail, body)) => ((tail, PieceEnd::Packet), body),
                None => {
                    counters.frames_malformed += 1;
                    return;
                }
            },
        };
        let (tail, end) = tail;
        let replaced = self
            .pieces
            .insert(count, Pieces { tail: (!tail.is_empty()).then(|| (tail.to_vec(), end)), head: None });
        self.drop_pieces(replaced, counters);
        self.complete(count, counters, out);
        if let Some(head) = extract_packets(body, counters, out) {
            self.pieces.entry(count).or_default().head = Some(head.to_vec());
            self.complete_from(count, counters, out);
        }
        self.remove_if_empty(count);
        self.drop_oldest(counters);
    }

    /// Unwraps a count: of all values with these low bits, returns the nearest to the highest so far.
    fn unwrap_count(&mut self, header: FrameHeader) -> u64 {
        let span = 1_u64 << header.count_bits;
        let highest = self.highest.unwrap_or(ORIGIN | u64::from(header.count));
        let ahead = u64::from(header.count).wrapping_sub(highest) & (span - 1);
        let count = if ahead < span / 2 { highest + ahead } else { highest.saturating_sub(span - ahead) };
        self.highest = Some(highest.max(count));
        count
    }

    /// Records a frame; returns whether it was received before.
    fn record_frame(&mut self, count: u64, frame: &[u8]) -> bool {
        let check = crc_fast::crc32_iscsi(frame);
        if self.seen.insert(count, check) == Some(check) {
            return true;
        }
        if self.seen.len() > SEEN_MAX {
            self.seen.pop_first();
        }
        // Frames have no time, so a lower count is never taken for a restart; packets show restarts.
        match self.sequence.receive(count, CucTime(0)) {
            Arrival::AfterGap { expected } => {
                self.counts.gaps += 1;
                self.counts.missing += count - expected;
            }
            Arrival::Late => self.counts.late += 1,
            Arrival::InOrder | Arrival::Early | Arrival::Duplicate | Arrival::Restart { .. } => {}
        }
        self.counts.frames += 1;
        false
    }

    /// Completes the packet to which the tail of frame `count` belongs, if all its pieces have arrived.
    fn complete(&mut self, count: u64, counters: &mut FrameCounters, out: &mut Vec<u8>) {
        if self.pieces.get(&count).is_none_or(|pieces| pieces.tail.is_none()) {
            return;
        }
        for at in (count.saturating_sub(FRAMES_PER_PACKET_MAX)..count).rev() {
            match self.pieces.get(&at) {
                Some(Pieces { head: Some(_), .. }) => return self.complete_from(at, counters, out),
                Some(Pieces { tail: Some((_, PieceEnd::Frame)), .. }) => {}
                _ => return,
            }
        }
    }

    /// Completes the packet that begins in frame `count`, if all its pieces have arrived.
    fn complete_from(&mut self, count: u64, counters: &mut FrameCounters, out: &mut Vec<u8>) {
        let Some((last, has_right_length)) = self.extent(count) else { return };
        let start = out.len();
        for at in count..=last {
            let Some(pieces) = self.pieces.get_mut(&at) else { continue };
            let piece =
                if at == count { pieces.head.take() } else { pieces.tail.take().map(|(tail, _)| tail) };
            out.extend(piece.unwrap_or_default());
            self.remove_if_empty(at);
        }
        let bytes = (out.len() - start) as u64;
        if !has_right_length {
            // Frames that do not belong together in spite of their counts, or a forged length.
            counters.fragments += 1 + last - count;
            counters.bytes_fragments += bytes;
            out.truncate(start);
        } else if is_idle(&out[start..]) {
            counters.bytes_idle_packets += bytes;
            out.truncate(start);
        }
    }

    /// The last frame of the packet that begins in frame `count`, and whether its pieces have the right total length; `None`
    /// if pieces are missing.
    fn extent(&self, count: u64) -> Option<(u64, bool)> {
        let mut piece = self.pieces.get(&count)?.head.as_ref()?;
        let (mut header, mut found, mut at) = (Vec::with_capacity(PACKET_HEADER_BYTES), 0, count);
        loop {
            header.extend(piece.iter().take(PACKET_HEADER_BYTES - header.len()));
            found += piece.len();
            match packet_bytes(&header) {
                Some(bytes) if found >= bytes => return Some((at, found == bytes)),
                _ if at > count && self.tail_end(at) == Some(PieceEnd::Packet) => return Some((at, false)),
                _ => {}
            }
            at += 1;
            piece = &self.pieces.get(&at)?.tail.as_ref()?.0;
        }
    }

    /// Where the tail of frame `count` ends.
    fn tail_end(&self, count: u64) -> Option<PieceEnd> {
        self.pieces.get(&count)?.tail.as_ref().map(|(_, end)| *end)
    }

    /// Removes the entry of a frame that has no pieces left.
    fn remove_if_empty(&mut self, count: u64) {
        if self.pieces.get(&count).is_some_and(|pieces| pieces.tail.is_none() && pieces.head.is_none()) {
            self.pieces.remove(&count);
        }
    }

    /// Drops the pieces of the oldest frames beyond [`PIECES_MAX`].
    fn drop_oldest(&mut self, counters: &mut FrameCounters) {
        while self.pieces.len() > PIECES_MAX {
            let oldest = self.pieces.pop_first().map(|(_, pieces)| pieces);
            self.drop_pieces(oldest, counters);
        }
    }

    fn drop_pieces(&self, pieces: Option<Pieces>, counters: &mut FrameCounters) {
        let Some(Pieces { tail, head }) = pieces else { return };
        for piece in tail.map(|(bytes, _)| bytes).into_iter().chain(head) {
            counters.fragments += 1;
            counters.bytes_fragments += piece.len() as u64;
        }
    }
}

/// Appends the packets that lie entirely in `body`; returns the rest, the beginning of another packet.
fn extract_packets<'a>(body: &'a [u8], counters: &mut FrameCounters, out: &mut Vec<u8>) -> Option<&'a [u8]> {
    let mut rest = body;
    while let Some((packet, after)) = packet_bytes(rest).and_then(|bytes| rest.split_at_checked(bytes)) {
        if is_idle(packet) {
            counters.bytes_idle_packets += packet.len() as u64;
        } else {
            out.extend_from_slice(packet);
        }
        rest = after;
    }
    (!rest.is_empty()).then_some(rest)
}

/// Length of the packet at the beginning of `bytes`; `None` if its header is incomplete.
fn packet_bytes(bytes: &[u8]) -> Option<usize> {
    let header = bytes.first_chunk::<PACKET_HEADER_BYTES>()?;
    Some(PACKET_HEADER_BYTES + 1 + usize::from(u16::from_be_bytes([header[4], header[5]])))
}

fn is_idle(packet: &[u8]) -> bool {
    packet.first_chunk().is_some_and(|id| u16::from_be_bytes(*id) & IDLE_APID == IDLE_APID)
}
