//! A coded stream to packets: the ground's end, robust against whatever a link or a disk does to the bits.

use std::collections::BTreeMap;

use super::FrameCounters;
use super::assembler::Assembler;
use crate::downlink::wire::cadu::bits::{Polarity, copy_at, find_marker, marker, marker_errors, word_at};
use crate::downlink::wire::cadu::{CODEWORD_BYTES, ERRORS_MAX, INTERLEAVES, PARITY_BYTES, ReedSolomon};
use crate::downlink::wire::cadu::{FRAME_HEADER_BYTES, FrameHeader, IDLE, SYNC_MARKER_BYTES, randomize};

/// Virtual channels that are kept apart, besides that of idle frames; bounds the memory.
const CHANNELS_MAX: usize = 8;

const MARKER_BITS: usize = 8 * SYNC_MARKER_BYTES;

/// Bytes in front of the one at which the stream is looked at that may be passed over without notice.
const SPENT_BYTES: usize = 1 << 18;

/// Octets put through the code for each of the stream, at most: a stream full of markers may not cost more. In lock
/// it is one.
const WORK_A_BYTE: u64 = 4;

/// So many more: a few dozen places looked at for every depth of interleaving.
const WORK_BYTES: u64 = 1 << 20;

/// Faults up to which a frame with a header of ours is taken as it is. An image with a marker stands four octets or more
/// from its frame, three if the marker lacks bits, and all of those octets are wrong in it.
const FAULTS_OF_NO_IMAGE: usize = 2;

/// A frame that could be corrected.
#[derive(Clone, Copy, Debug)]
struct LocatedFrame {
    /// Bit of the buffer where its marker begins, or should.
    at: usize,
    code: ReedSolomon,
    polarity: Polarity,
    /// Octets corrected in its block.
    corrected: usize,
    /// What speaks against it: octets corrected, wrong bits of the marker, and a header that is none of ours. Each
    /// befalls about one in a thousand on a poor link.
    faults: usize,
}

/// What a place in the stream holds.
#[derive(Clone, Copy, Debug)]
enum Place {
    Frame(LocatedFrame),
    Nothing,
    /// More bytes will tell.
    Unsure,
}

/// Finds frames in a stream of bits, corrects them, and puts their packets together.
///
/// Three states, as receivers have them. *Search*: the stream is searched bit by bit for a marker with 3 wrong bits
/// at most, upright or inverted, and looked at where a frame would be due. *Check*: a place that was found counts if
/// a block that can be corrected follows it; as long as the interleave is not known, if its header is one of ours as well and
/// next to nothing was wrong, or if another frame follows. *Lock*: frames follow one another; a bad marker is passed over if its
/// block can be corrected, a bad block if another marker follows; otherwise the search begins there, or where the
/// last block might have ended had bits been lost in it. Interleave and polarity are found out.
///
/// That a block can be corrected does not prove that it begins there. The code is cyclic, and where 1, 2, 4 or 8
/// codewords are interleaved a shifted randomizer differs from itself by a codeword: up to 16 octets a codeword too early
/// or too late, a frame is corrected to its own rotation, and so is every frame after it. So a frame in which
/// more than an octet or two were corrected, or whose header is none of ours, has rivals: places so near with a marker.
/// The one with the fewest faults is taken.
///
/// Work is bounded: places are not looked at where a stream has brought forth too many.
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
    /// Bits of the buffer that must be there before it is looked at again.
    wanted: usize,
    /// Octets put through the code.
    worked: u64,
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
        (self.at, self.wanted, self.locked) = (0, 0, false);
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

    /// Octets put through the code so far, those of frames that were none included: at most four for each octet of
    /// the stream, and a megabyte.
    #[must_use]
    pub fn octets_decoded(&self) -> u64 {
        self.worked
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
        self.code.map_or(MARKER_BITS + 8 * CODEWORD_BYTES * longest, frame_bits)
    }

    /// So many bits of a block may be missing at its end and yet be corrected.
    fn slack_bits(&self) -> usize {
        8 * PARITY_BYTES * self.code.map_or(0, ReedSolomon::interleave)
    }

    /// Goes on as far as the bytes that are there allow.
    fn look(&mut self, at_end: bool, out: &mut Vec<u8>) {
        while at_end || 8 * self.buffer.len() >= self.wanted {
            let go_on = if self.locked { self.follow(at_end, out) } else { self.search(at_end, out) };
            if !go_on {
                return;
            }
        }
    }

    /// In lock: the frame that is due. False if more bytes are needed.
    fn follow(&mut self, at_end: bool, out: &mut Vec<u8>) -> bool {
        let (frame, bits) = (self.frame_bits(), 8 * self.buffer.len());
        if self.at + frame > bits {
            return false;
        }
        let polarity = marker(word_at(&self.buffer, self.at));
        match self.place(self.at, self.code, polarity.unwrap_or(self.polarity), at_end) {
            Place::Unsure => return false,
            Place::Frame(found) => {
                if found.at != self.at {
                    self.account.sync_losses += 1;
                    self.account.bits_skipped += found.at.saturating_sub(self.at) as u64;
                }
                self.at = found.at;
                self.deliver(found, out);
            }
            Place::Nothing => match polarity {
                _ if self.at + frame + MARKER_BITS > bits && !at_end => {
                    self.wanted = self.at + frame + MARKER_BITS;
                    return false;
                }
                Some(polarity) if at_end || self.another_follows(self.at, self.code, polarity) => {
                    self.turn(polarity);
                    self.account.frames_uncorrectable += 1;
                }
                // Bits may have got lost in this frame, or, if its marker is bad too, in the one before.
                polarity => {
                    self.account.sync_losses += 1;
                    self.locked = false;
                    self.lost_at = Some(self.before + self.at as u64);
                    self.at = match polarity {
                        Some(_) => self.at + 1,
                        None => self.at.saturating_sub(self.slack_bits()),
                    };
                    return true;
                }
            },
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
        let place = if self.affords(found) { self.check(found, polarity, at_end) } else { Place::Nothing };
        match place {
            Place::Frame(found) => {
                self.code = Some(found.code);
                self.account.interleave = found.code.interleave();
                self.lock(found.at);
                self.deliver(found, out);
                self.at = found.at + self.frame_bits();
            }
            // Not even if another marker follows: data repeated at the distance of a frame brings forth such pairs.
            Place::Nothing => self.pass(found + 1),
            Place::Unsure => {
                self.pass(found);
                return false;
            }
        }
        true
    }

    /// Where the next frame begins if the stream has gone on as it was before it was lost.
    fn due_at(&self) -> Option<usize> {
        let (frame, now, lost_at) = (self.frame_bits() as u64, self.before + self.at as u64, self.lost_at?);
        let due = lost_at + now.saturating_sub(lost_at).next_multiple_of(frame);
        Some(self.at + (due - now) as usize)
    }

    /// What is at `at`; finds out the depth of interleaving if it is not known.
    fn check(&mut self, at: usize, polarity: Polarity, at_end: bool) -> Place {
        if self.code.is_some() {
            return self.place(at, self.code, polarity, at_end);
        }
        for code in INTERLEAVES.into_iter().filter_map(ReedSolomon::new) {
            let place = self.place(at, Some(code), polarity, at_end);
            let Place::Frame(found) = place else { continue };
            if found.faults <= FAULTS_OF_NO_IMAGE && self.header().is_some() && !self.is_constant() {
                return place;
            }
            // A block of equal octets, or nearly so, is a codeword at every depth: what follows must fit as well.
            let good = at_end
                || self.another_follows(found.at, Some(code), polarity)
                || self.correct(found.at + frame_bits(code), code, polarity).is_some();
            if good && self.correct(found.at, code, polarity).is_some() {
                return place;
            }
        }
        Place::Nothing
    }

    /// The frame at bit `at`, or the rival that it is only a shifted image of; its block is in `self.block`.
    fn place(&mut self, at: usize, code: Option<ReedSolomon>, polarity: Polarity, at_end: bool) -> Place {
        let Some(found) = code.and_then(|code| self.correct(at, code, polarity)) else {
            return Place::Nothing;
        };
        if (found.corrected == 0 || found.faults <= FAULTS_OF_NO_IMAGE) && self.header().is_some() {
            return Place::Frame(found);
        }
        let reach = 8 * ERRORS_MAX * found.code.interleave();
        // In a search, what lies before has been looked at.
        let earliest = if self.locked { 0 } else { self.at };
        let (mut best, mut in_block) = (found, at);
        for rival in (at % 8 + (at - at % 8).saturating_sub(reach)..=at + reach).step_by(8) {
            let is_marked = marker(word_at(&self.buffer, rival)) == Some(polarity);
            if rival == at || rival < earliest || !is_marked || !self.affords(at) {
                continue;
            }
            let end = rival + frame_bits(found.code);
            if end > 8 * self.buffer.len() && !at_end {
                self.wanted = end;
                return Place::Unsure;
            }
            if let Some(other) = self.correct(rival, found.code, polarity) {
                best = if other.faults < best.faults { other } else { best };
            }
            in_block = rival;
        }
        if in_block != best.at && self.correct(best.at, best.code, polarity).is_none() {
            return Place::Nothing;
        }
        // Neither marker nor header: an image of a frame whose beginning is gone.
        let is_image = marker(word_at(&self.buffer, best.at)).is_none() && self.header().is_none();
        if is_image { Place::Nothing } else { Place::Frame(best) }
    }

    /// Whether all octets of the block are equal.
    fn is_constant(&self) -> bool {
        self.block.iter().all(|octet| Some(octet) == self.block.first())
    }

    /// Whether a place may be looked at: the work until now is in proportion to the stream before it. Told by the
    /// place and not by what has come, so that chunks do not matter.
    fn affords(&self, at: usize) -> bool {
        self.worked <= WORK_BYTES + WORK_A_BYTE * ((self.before + at as u64) / 8)
    }

    /// Whether a marker stands where the frame after that at `found` should begin.
    fn another_follows(&self, found: usize, code: Option<ReedSolomon>, polarity: Polarity) -> bool {
        let Some(code) = code else { return false };
        let next = found + frame_bits(code);
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

    /// Corrects the block behind the marker at bit `at` into `self.block`.
    fn correct(&mut self, at: usize, code: ReedSolomon, polarity: Polarity) -> Option<LocatedFrame> {
        if at + frame_bits(code) > 8 * self.buffer.len() {
            return None;
        }
        self.worked += code.block_bytes() as u64;
        self.block.resize(code.block_bytes(), 0);
        copy_at(&self.buffer, at + MARKER_BITS, &mut self.block);
        if polarity == Polarity::Inverted {
            self.block.iter_mut().for_each(|octet| *octet = !*octet);
        }
        randomize(&mut self.block);
        let corrected = code.decode(&mut self.block).ok()?;
        let wrong = marker_errors(word_at(&self.buffer, at), polarity) as usize;
        let faults = corrected + wrong + usize::from(self.header().is_none());
        Some(LocatedFrame { at, code, polarity, corrected, faults })
    }

    /// The header of the frame in `self.block`, if it is one of ours.
    fn header(&self) -> Option<FrameHeader> {
        let ours = |header: &FrameHeader| self.spacecraft.is_none_or(|known| known == header.spacecraft);
        self.block.get(..FRAME_HEADER_BYTES).and_then(FrameHeader::parse).filter(ours)
    }

    /// Takes the frame in `self.block`.
    fn deliver(&mut self, found: LocatedFrame, out: &mut Vec<u8>) {
        self.turn(found.polarity);
        self.account.frames += 1;
        self.account.frames_corrected += u64::from(found.corrected > 0);
        self.account.bytes_corrected += found.corrected as u64;
        let Some(header) = self.header() else {
            self.account.frames_foreign += 1;
            return;
        };
        let frame = &self.block[..found.code.data_bytes()];
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
            self.wanted = self.wanted.saturating_sub(8 * spent);
            self.before += 8 * spent as u64;
        }
    }
}

/// Bits of a marker and a block of that code.
fn frame_bits(code: ReedSolomon) -> usize {
    MARKER_BITS + 8 * code.block_bytes()
}
