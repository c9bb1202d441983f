//! A coded stream to packets: the ground's end, robust against whatever a link or a disk does to the bits.

use std::collections::BTreeMap;

use super::SYNC_MARKER_BYTES;
use super::assembler::Assembler;
use super::bits::{Polarity, copy_at, find_marker, marker, word_at};
use super::counters::FrameCounters;
use super::frame::{FRAME_HEADER_BYTES, FrameHeader, IDLE};
use super::randomizer::randomize;
use super::reed_solomon::{CODEWORD_BYTES, INTERLEAVES, PARITY_BYTES, ReedSolomon};

/// Virtual channels that are kept apart, besides that of idle frames; bounds the memory.
const CHANNELS_MAX: usize = 8;

const MARKER_BITS: usize = 8 * SYNC_MARKER_BYTES;

/// Bytes in front of the one at which the stream is looked at that may be passed over without notice.
const SPENT_BYTES: usize = 1 << 18;

/// Finds frames in a stream of bits, corrects them, and puts their packets together.
///
/// Three states, as receivers have them. *Search*: the stream is searched bit by bit for a marker with 3 wrong bits
/// at most, upright or inverted, and looked at where a frame would be due. *Check*: a place that was found counts if a block that can be corrected
/// follows it. *Lock*: frames follow one another; a bad
/// marker is passed over if its block can be corrected, a bad block if another marker follows; otherwise the
/// search begins there, or where the last block might have ended had bits been lost in it. Interleave and
/// polarity are found out.
#[derive(Debug, Default)]
pub struct CaduReceiver {
    buffer: Vec<u8>,
    /// Bit of the buffer to look at next.
    at: usize,
    locked: bool,
    /// Bits of the stream in front of the buffer.
    before: u64,
    /// Bit of the stream at which the lock was lost, while it is.
    lost_at: Option<u64>,
    polarity: Polarity,
    /// Known from the first frame on.
    code: Option<ReedSolomon>,
    spacecraft: Option<u8>,
    block: Vec<u8>,
    channels: BTreeMap<u8, Assembler>,
    account: FrameCounters,
}

impl CaduReceiver {
    /// A receiver at the start of a stream.
    #[must_use]
    pub fn new() -> Self {
        Self::default()
    }

    /// Takes the next bytes of the stream; appends the packets that they complete to `out`, whole and in the order
    /// in which they are completed. Idle packets are left out.
    pub fn push(&mut self, bytes: &[u8], out: &mut Vec<u8>) {
        self.account.bytes += bytes.len() as u64;
        self.buffer.extend_from_slice(bytes);
        self.look(false, out);
        self.drop_spent();
    }

    /// Says that the stream is at its end. Another may follow: what is known of the first is kept.
    pub fn finish(&mut self, out: &mut Vec<u8>) {
        self.look(true, out);
        let left = (8 * self.buffer.len()).saturating_sub(self.at);
        if self.locked {
            self.account.bytes_truncated += left as u64 / 8;
        } else {
            self.account.bits_skipped += left as u64;
        }
        if let Some(lost_at) = self.lost_at.take() {
            self.account.bits_skipped += (self.before + self.at as u64).saturating_sub(lost_at);
        }
        self.before += 8 * self.buffer.len() as u64;
        self.buffer.clear();
        (self.at, self.locked) = (0, false);
    }

    /// Whether a frame has been found.
    #[must_use]
    pub fn has_frame(&self) -> bool {
        self.code.is_some()
    }

    /// Memory taken: for bytes of the stream, at most twice the greatest chunk and half a megabyte; and for what
    /// assemblers remember.
    #[must_use]
    pub fn held_bytes(&self) -> usize {
        self.buffer.capacity() + self.channels.values().map(Assembler::held_bytes).sum::<usize>()
    }

    /// The account so far.
    #[must_use]
    pub fn counters(&self) -> FrameCounters {
        let mut account = self.account.clone();
        for assembler in self.channels.values() {
            let (pieces, bytes) = assembler.waiting();
            account.fragments += pieces;
            account.bytes_fragments += bytes;
            account.channels.push(assembler.counts().clone());
        }
        account
    }

    /// Bits of a marker and its block.
    fn frame_bits(&self) -> usize {
        let longest = INTERLEAVES[INTERLEAVES.len() - 1];
        MARKER_BITS + 8 * CODEWORD_BYTES * self.code.map_or(longest, ReedSolomon::interleave)
    }

    /// So many bits of a block may be missing at its end and yet be corrected.
    fn slack_bits(&self) -> usize {
        8 * PARITY_BYTES * self.code.map_or(0, ReedSolomon::interleave)
    }

    /// Goes on as far as the bytes that are there allow.
    fn look(&mut self, at_end: bool, out: &mut Vec<u8>) {
        loop {
            let go_on = if self.locked { self.follow(at_end, out) } else { self.search(at_end, out) };
            if !go_on {
                return;
            }
        }
    }

    /// In lock: the frame that is due. False if more bytes are needed.
    fn follow(&mut self, at_end: bool, out: &mut Vec<u8>) -> bool {
        let frame = self.frame_bits();
        if self.at + frame > 8 * self.buffer.len() {
            return false;
        }
        let polarity = marker(word_at(&self.buffer, self.at));
        let good = self.correct(self.at, self.code, polarity.unwrap_or(self.polarity));
        match (good, polarity) {
            (Some(corrected), _) => self.deliver(corrected, polarity.unwrap_or(self.polarity), out),
            (None, _) if self.at + frame + MARKER_BITS > 8 * self.buffer.len() && !at_end => return false,
            (None, Some(polarity)) if at_end || self.another_follows(self.at, self.code, polarity) => {
                self.turn(polarity);
                self.account.frames_uncorrectable += 1;
            }
            // Bits may have got lost in this frame, or, if its marker is bad too, in the one before.
            (None, _) => {
                self.account.sync_losses += 1;
                self.locked = false;
                self.lost_at = Some(self.before + self.at as u64);
                self.at = match polarity {
                    Some(_) => self.at + 1,
                    None => self.at.saturating_sub(self.slack_bits()),
                };
                return true;
            }
        }
        self.at += frame;
        true
    }

    /// Out of lock: the next place that looks like a frame. False if more bytes are needed.
    fn search(&mut self, at_end: bool, out: &mut Vec<u8>) -> bool {
        let bits = 8 * self.buffer.len();
        // At the end a block may be shorter than the longest, and no other need follow.
        let needed = match (at_end, self.code) {
            (true, _) => MARKER_BITS,
            (false, Some(_)) => self.frame_bits(),
            (false, None) => 2 * self.frame_bits(),
        };
        let to = (bits + 1).saturating_sub(needed);
        let due = self.due_at().filter(|due| *due < to);
        let found = find_marker(&self.buffer, self.at, due.unwrap_or(to));
        let Some(found) = found.or(due) else {
            self.pass(to.max(self.at));
            return false;
        };
        let polarity = marker(word_at(&self.buffer, found)).unwrap_or(self.polarity);
        if let Some((code, corrected)) = self.check(found, polarity, at_end) {
            self.code = Some(code);
            self.account.interleave = code.interleave();
            self.lock(found);
            self.deliver(corrected, polarity, out);
            self.at = found + self.frame_bits();
        } else {
            // Not even if another marker follows: data repeated at the distance of a frame brings forth such pairs.
            self.pass(found + 1);
        }
        true
    }

    /// Where the next frame begins if the stream has gone on as it was before it was lost.
    fn due_at(&self) -> Option<usize> {
        let (frame, now, lost_at) = (self.frame_bits() as u64, self.before + self.at as u64, self.lost_at?);
        let due = lost_at + now.saturating_sub(lost_at).next_multiple_of(frame);
        Some(self.at + (due - now) as usize)
    }

    /// Corrects the block at `found`, and finds out the depth of interleaving if it is not known.
    fn check(&mut self, found: usize, polarity: Polarity, at_end: bool) -> Option<(ReedSolomon, usize)> {
        if let Some(code) = self.code {
            return self.correct(found, Some(code), polarity).map(|corrected| (code, corrected));
        }
        for code in INTERLEAVES.into_iter().filter_map(ReedSolomon::new) {
            // A block of equal octets is a codeword at every depth, so what follows must fit as well.
            let next = found + MARKER_BITS + 8 * code.block_bytes();
            let good = self.correct(found, Some(code), polarity).is_some()
                && (at_end
                    || self.another_follows(found, Some(code), polarity)
                    || self.correct(next, Some(code), polarity).is_some());
            if good {
                return self.correct(found, Some(code), polarity).map(|corrected| (code, corrected));
            }
        }
        None
    }

    /// Whether a marker stands where the frame after that at `found` should begin.
    fn another_follows(&self, found: usize, code: Option<ReedSolomon>, polarity: Polarity) -> bool {
        let Some(code) = code else { return false };
        let next = found + MARKER_BITS + 8 * code.block_bytes();
        next + MARKER_BITS <= 8 * self.buffer.len() && marker(word_at(&self.buffer, next)) == Some(polarity)
    }

    /// Passes over bits in a search.
    fn pass(&mut self, to: usize) {
        if self.lost_at.is_none() {
            self.account.bits_skipped += (to - self.at) as u64;
        }
        self.at = to;
    }

    /// The stream goes on at `found`: whole frames since it was lost are frames, anything else was garbage.
    fn lock(&mut self, found: usize) {
        self.pass(found);
        self.locked = true;
        if let Some(lost_at) = self.lost_at.take() {
            let bits = (self.before + found as u64).saturating_sub(lost_at);
            let frame = self.frame_bits() as u64;
            if bits.is_multiple_of(frame) {
                self.account.frames_uncorrectable += bits / frame;
            } else {
                self.account.bits_skipped += bits;
            }
        }
    }

    fn turn(&mut self, polarity: Polarity) {
        self.account.inversions += u64::from(polarity != self.polarity);
        self.polarity = polarity;
    }

    /// Corrects the block behind the marker at bit `at` into `self.block`; the bytes corrected.
    fn correct(&mut self, at: usize, code: Option<ReedSolomon>, polarity: Polarity) -> Option<usize> {
        let code = code?;
        if at + MARKER_BITS + 8 * code.block_bytes() > 8 * self.buffer.len() {
            return None;
        }
        self.block.resize(code.block_bytes(), 0);
        copy_at(&self.buffer, at + MARKER_BITS, &mut self.block);
        if polarity == Polarity::Inverted {
            self.block.iter_mut().for_each(|octet| *octet = !*octet);
        }
        randomize(&mut self.block);
        code.decode(&mut self.block).ok()
    }

    /// Takes the frame in `self.block`.
    fn deliver(&mut self, corrected: usize, polarity: Polarity, out: &mut Vec<u8>) {
        self.turn(polarity);
        self.account.frames += 1;
        self.account.frames_corrected += u64::from(corrected > 0);
        self.account.bytes_corrected += corrected as u64;
        let frame = &self.block[..self.block.len() / CODEWORD_BYTES * (CODEWORD_BYTES - PARITY_BYTES)];
        let ours = |header: &FrameHeader| self.spacecraft.is_none_or(|known| known == header.spacecraft);
        let Some(header) = frame.get(..FRAME_HEADER_BYTES).and_then(FrameHeader::parse).filter(ours) else {
            self.account.frames_foreign += 1;
            return;
        };
        self.spacecraft = Some(header.spacecraft);
        if header.channel == IDLE {
            self.account.frames_idle += 1;
        } else if self.channels.len() < CHANNELS_MAX || self.channels.contains_key(&header.channel) {
            let assembler =
                self.channels.entry(header.channel).or_insert_with(|| Assembler::new(header.channel));
            assembler.take(header, frame, &mut self.account, out);
        } else {
            self.account.frames_foreign += 1;
        }
    }

    /// Lets go of bytes that will not be looked at again.
    fn drop_spent(&mut self) {
        let spent = self.at.saturating_sub(self.slack_bits()) / 8;
        if spent >= SPENT_BYTES || spent == self.buffer.len() {
            self.buffer.drain(..spent);
            self.at -= 8 * spent;
            self.before += 8 * spent as u64;
        }
    }
}
