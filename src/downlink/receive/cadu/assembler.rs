//! Frames of one virtual channel back to packets, in whatever order the frames come.
//!
//! A frame gives the packets that lie wholly in it, and keeps two pieces at most: the end of a packet that an
//! earlier frame began, and the beginning of one that a later frame ends. Pieces meet by their frames'
//! counts. So a frame that comes late, or from another station, completes what it belongs to; what a frame
//! says is never needed twice.

use std::collections::BTreeMap;

use super::{ChannelCounts, FrameCounters};
use crate::downlink::receive::sequence::{Arrival, Sequence};
use crate::downlink::wire::cadu::DATA_BYTES;
use crate::downlink::wire::cadu::frame::{FrameHeader, IDLE_ZONE, NO_HEADER, ZONE_START};
use crate::downlink::wire::cadu::framer::{IDLE_APID, PACKET_HEADER_BYTES};

use crate::downlink::wire::{CucTime, PACKET_BYTES_MAX};

/// Frames whose pieces are kept; bounds the memory to some megabytes a channel.
const PIECES_MAX: usize = 4096;

/// Frames that the longest packet touches where frames are shortest.
const FRAMES_A_PACKET_MAX: u64 = (PACKET_BYTES_MAX / (DATA_BYTES - ZONE_START) + 2) as u64;

/// Frames that are remembered to tell duplicates.
const SEEN_MAX: usize = 1 << 16;

/// Counts are unwrapped to lie about this, so that earlier ones have room.
const ORIGIN: u64 = 1 << 40;

/// Where a piece ends.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum PieceEnd {
    /// With its packet: another begins after it.
    Packet,
    /// With its frame; the packet may go on.
    Frame,
}

/// The two pieces of a frame.
#[derive(Debug, Default)]
struct Pieces {
    /// The end, or a middle, of a packet that an earlier frame began.
    tail: Option<(Vec<u8>, PieceEnd)>,
    /// The beginning of a packet that runs on.
    head: Option<Vec<u8>>,
}

/// Puts the packets of one virtual channel together.
#[derive(Debug, Default)]
pub(super) struct Assembler {
    newest: Option<u64>,
    sequence: Sequence,
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

    /// Pieces that wait for others, and their bytes.
    pub(super) fn waiting(&self) -> (u64, u64) {
        let tails = self.pieces.values().filter_map(|pieces| pieces.tail.as_ref().map(|(bytes, _)| bytes));
        let heads = self.pieces.values().filter_map(|pieces| pieces.head.as_ref());
        tails.chain(heads).fold((0, 0), |(count, bytes), piece| (count + 1, bytes + piece.len() as u64))
    }

    /// Memory taken, as near as can be told: pieces, and a tree's entries.
    pub(super) fn held_bytes(&self) -> usize {
        let entries =
            self.pieces.len() * size_of::<(u64, Pieces)>() + self.seen.len() * size_of::<(u64, u32)>();
        self.waiting().1 as usize + 2 * entries
    }

    /// Takes a frame; appends the packets that it completes to `out`.
    pub(super) fn take(
        &mut self,
        header: FrameHeader,
        frame: &[u8],
        account: &mut FrameCounters,
        out: &mut Vec<u8>,
    ) {
        let count = self.unwrap_count(header);
        if self.is_duplicate(count, frame) {
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
                    account.frames_malformed += 1;
                    return;
                }
            },
        };
        let (tail, reach) = tail;
        let had = self
            .pieces
            .insert(count, Pieces { tail: (!tail.is_empty()).then(|| (tail.to_vec(), reach)), head: None });
        self.drop_pieces(had, account);
        self.complete(count, account, out);
        if let Some(head) = walk(body, account, out) {
            self.pieces.entry(count).or_default().head = Some(head.to_vec());
            self.complete_from(count, account, out);
        }
        self.forget(count);
        self.bound(account);
    }

    /// The count without its wraps: of all that the bits allow, the nearest to the newest.
    fn unwrap_count(&mut self, header: FrameHeader) -> u64 {
        let span = 1_u64 << header.count_bits;
        let newest = self.newest.unwrap_or(ORIGIN | u64::from(header.count));
        let ahead = u64::from(header.count).wrapping_sub(newest) & (span - 1);
        let count = if ahead < span / 2 { newest + ahead } else { newest.saturating_sub(span - ahead) };
        self.newest = Some(newest.max(count));
        count
    }

    /// Takes the count into the account; whether the same frame has been here before.
    fn is_duplicate(&mut self, count: u64, frame: &[u8]) -> bool {
        let check = crc_fast::crc32_iscsi(frame);
        if self.seen.insert(count, check) == Some(check) {
            return true;
        }
        if self.seen.len() > SEEN_MAX {
            self.seen.pop_first();
        }
        // Frames bear no time: a lower count never is a restart here. Should it be one, packets will tell.
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

    /// Completes the packet that the tail at `count` belongs to, if its head and all between are there.
    fn complete(&mut self, count: u64, account: &mut FrameCounters, out: &mut Vec<u8>) {
        if self.pieces.get(&count).is_none_or(|pieces| pieces.tail.is_none()) {
            return;
        }
        for at in (count.saturating_sub(FRAMES_A_PACKET_MAX)..count).rev() {
            match self.pieces.get(&at) {
                Some(Pieces { head: Some(_), .. }) => return self.complete_from(at, account, out),
                Some(Pieces { tail: Some((_, PieceEnd::Frame)), .. }) => {}
                _ => return,
            }
        }
    }

    /// Completes the packet that begins in frame `count`, if all of it is there.
    fn complete_from(&mut self, count: u64, account: &mut FrameCounters, out: &mut Vec<u8>) {
        let Some((last, fits)) = self.extent(count) else { return };
        let start = out.len();
        for at in count..=last {
            let Some(pieces) = self.pieces.get_mut(&at) else { continue };
            let piece =
                if at == count { pieces.head.take() } else { pieces.tail.take().map(|(tail, _)| tail) };
            out.extend(piece.unwrap_or_default());
            self.forget(at);
        }
        let bytes = (out.len() - start) as u64;
        if !fits {
            // Frames of the same counts that do not belong together, or a forged length.
            account.fragments += 1 + last - count;
            account.bytes_fragments += bytes;
            out.truncate(start);
        } else if is_idle(&out[start..]) {
            account.bytes_idle_packets += bytes;
            out.truncate(start);
        }
    }

    /// The last frame of the packet that begins in frame `count`, and whether its pieces are as long as it says;
    /// `None` if not all of it is there.
    fn extent(&self, count: u64) -> Option<(u64, bool)> {
        let mut piece = self.pieces.get(&count)?.head.as_ref()?;
        let (mut header, mut found, mut at) = (Vec::with_capacity(PACKET_HEADER_BYTES), 0, count);
        loop {
            header.extend(piece.iter().take(PACKET_HEADER_BYTES - header.len()));
            found += piece.len();
            match packet_bytes(&header) {
                Some(bytes) if found >= bytes => return Some((at, found == bytes)),
                _ if at > count && self.reach(at) == Some(PieceEnd::Packet) => return Some((at, false)),
                _ => {}
            }
            at += 1;
            piece = &self.pieces.get(&at)?.tail.as_ref()?.0;
        }
    }

    fn reach(&self, at: u64) -> Option<PieceEnd> {
        self.pieces.get(&at)?.tail.as_ref().map(|(_, reach)| *reach)
    }

    /// Removes an entry of which nothing is left.
    fn forget(&mut self, count: u64) {
        if self.pieces.get(&count).is_some_and(|pieces| pieces.tail.is_none() && pieces.head.is_none()) {
            self.pieces.remove(&count);
        }
    }

    fn bound(&mut self, account: &mut FrameCounters) {
        while self.pieces.len() > PIECES_MAX {
            let oldest = self.pieces.pop_first().map(|(_, pieces)| pieces);
            self.drop_pieces(oldest, account);
        }
    }

    fn drop_pieces(&self, pieces: Option<Pieces>, account: &mut FrameCounters) {
        let Some(Pieces { tail, head }) = pieces else { return };
        for piece in tail.map(|(bytes, _)| bytes).into_iter().chain(head) {
            account.fragments += 1;
            account.bytes_fragments += piece.len() as u64;
        }
    }
}

/// Appends the packets that lie wholly in `body`; returns what is left: the beginning of another.
fn walk<'a>(body: &'a [u8], account: &mut FrameCounters, out: &mut Vec<u8>) -> Option<&'a [u8]> {
    let mut rest = body;
    while let Some((packet, after)) = packet_bytes(rest).and_then(|bytes| rest.split_at_checked(bytes)) {
        if is_idle(packet) {
            account.bytes_idle_packets += packet.len() as u64;
        } else {
            out.extend_from_slice(packet);
        }
        rest = after;
    }
    (!rest.is_empty()).then_some(rest)
}

/// Length of the packet that begins here, if so much of it is there as says so.
fn packet_bytes(bytes: &[u8]) -> Option<usize> {
    let header = bytes.first_chunk::<PACKET_HEADER_BYTES>()?;
    Some(PACKET_HEADER_BYTES + 1 + usize::from(u16::from_be_bytes([header[4], header[5]])))
}

fn is_idle(packet: &[u8]) -> bool {
    packet.first_chunk().is_some_and(|id| u16::from_be_bytes(*id) & IDLE_APID == IDLE_APID)
}
