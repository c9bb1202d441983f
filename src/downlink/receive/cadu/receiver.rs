//! A coded stream to packets, robust against any damage by a link or a disk.

use std::collections::BTreeMap;

use super::FrameCounters;
use super::assembler::Assembler;
use crate::downlink::wire::cadu::bits::{Polarity, copy_at, find_marker, marker, marker_errors, word_at};
use crate::downlink::wire::cadu::{CODEWORD_BYTES, ERRORS_MAX, INTERLEAVES, PARITY_BYTES, ReedSolomon};
use crate::downlink::wire::cadu::{FRAME_HEADER_BYTES, FrameHeader, IDLE, SYNC_MARKER_BYTES, randomize};

/// Number of virtual channels supported besides that of idle frames; bounds memory.
const CHANNELS_MAX: usize = 8;

const MARKER_BITS: usize = 8 * SYNC_MARKER_BYTES;

/// Spent bytes that may remain at the front of the buffer before they are dropped.
const SPENT_BYTES: usize = 1 << 18;

/// Maximum number of octets decoded per octet of the stream, even for a stream full of markers. In lock it is one.
const WORK_A_BYTE: u64 = 4;

/// Octets that may be decoded beyond that: a few dozen places at every depth of interleaving.
const WORK_BYTES: u64 = 1 << 20;

/// Maximum faults at which a frame with a valid header is accepted without a search for rivals. A shifted image with a
/// marker lies four octets or more from its frame, three if the marker lacks bits, and all those octets are wrong in it.
const FAULTS_OF_NO_IMAGE: usize = 2;

/// A frame that was corrected.
#[derive(Clone, Copy, Debug)]
struct LocatedFrame {
    /// Bit of the buffer where its marker begins, or should.
    at: usize,
    code: ReedSolomon,
    polarity: Polarity,
    /// Octets corrected in its block.
    corrected: usize,
    /// Evidence against it: octets corrected, wrong bits of the marker, and an invalid header. Each occurs about once in
    /// a thousand on a poor link.
    faults: usize,
}

/// What a place in the stream holds.
#[derive(Clone, Copy, Debug)]
enum Place {
    Frame(LocatedFrame),
    Nothing,
    /// More bytes are needed.
    Unsure,
}

/// Finds frames in a stream of bits, corrects them, and assembles their packets.
///
/// It has the three usual states. *Search*: looks bit by bit for a marker with at most 3 wrong bits, upright or
/// inverted, and where a frame would be due. *Check*: accepts a place if a correctable block follows. While the
/// interleave is unknown, the header must be valid with hardly a fault, or another frame must follow. *Lock*: frames
/// follow one another. A bad marker is ignored if its block can be corrected, a bad block if another marker follows.
/// Otherwise the search resumes there, or where the last block would end had it lost bits. Interleave and polarity are
/// detected.
///
/// A correctable block need not begin where it was found. The code is cyclic, and with 1, 2, 4 or 8 interleaved
/// codewords a shifted randomizer differs from itself by a codeword. So up to 16 octets per codeword too early or too
/// late, a frame is corrected to its own rotation, and so is every frame after it. A frame with more than two faults, or
/// with an invalid header, therefore has rivals: places within that distance that have a marker. The one with the
/// fewest faults is accepted.
///
/// Work is bounded: once a stream has produced too many candidates, further ones are ignored.
#[derive(Debug, Default)]
pub struct CaduReceiver {
    buffer: Vec<u8>,
    /// Next bit of the buffer to examine.
    at: usize,
    locked: bool,
    /// Bits of the stream before the buffer.
    before: u64,
    /// While out of lock: bit of the stream at which the lock was lost.
    lost_at: Option<u64>,
    polarity: Polarity,
    /// Known from the first frame on.
    code: Option<ReedSolomon>,
    spacecraft: Option<u8>,
    block: Vec<u8>,
    channels: BTreeMap<u8, Assembler>,
    counters: FrameCounters,
    /// Bits that the buffer must hold before it is examined again.
    wanted: usize,
    /// Octets decoded.
    worked: u64,
}

impl CaduReceiver {
    /// A receiver at the start of a stream.
    #[must_use]
    pub fn new() -> Self {
        Self::default()
    }

    /// Takes the next bytes of the stream; appends the packets that they complete to `out`, in the order of completion
    /// and without idle packets.
    pub fn push(&mut self, bytes: &[u8], out: &mut Vec<u8>) {
        self.counters.bytes += bytes.len() as u64;
        self.buffer.extend_from_slice(bytes);
        self.look(false, out);
        self.drop_spent();
    }

    /// Ends the stream. Another may follow, with the same interleave, polarity and counters.
    pub fn finish(&mut self, out: &mut Vec<u8>) {
        self.look(true, out);
        let left = (8 * self.buffer.len()).saturating_sub(self.at);
        if self.locked {
            self.counters.bytes_truncated += left as u64 / 8;
        } else {
            self.counters.bits_skipped += left as u64;
        }
        if let Some(lost_at) = self.lost_at.take() {
            self.counters.bits_skipped += (self.before + self.at as u64).saturating_sub(lost_at);
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

    /// Memory held, bytes: for the stream at most twice the longest chunk and half a megabyte, plus the assemblers'.
    #[must_use]
    pub fn held_bytes(&self) -> usize {
        self.buffer.capacity() + self.channels.values().map(Assembler::held_bytes).sum::<usize>()
    }

    /// Octets decoded so far, including those of false candidates: at most four per octet of the stream, plus a
    /// megabyte.
    #[must_use]
    pub fn octets_decoded(&self) -> u64 {
        self.worked
    }

    /// The counters so far.
    #[must_use]
    pub fn counters(&self) -> FrameCounters {
        let mut counters = self.counters.clone();
        for assembler in self.channels.values() {
            let (pieces, bytes) = assembler.waiting();
            counters.fragments += pieces;
            counters.bytes_fragments += bytes;
            counters.channels.push(assembler.counts().clone());
        }
        counters
    }

    /// Bits of a marker and its block.
    fn frame_bits(&self) -> usize {
        let longest = INTERLEAVES[INTERLEAVES.len() - 1];
        self.code.map_or(MARKER_BITS + 8 * CODEWORD_BYTES * longest, frame_bits)
    }

    /// Number of bits that may be missing at the end of a correctable block.
    fn slack_bits(&self) -> usize {
        8 * PARITY_BYTES * self.code.map_or(0, ReedSolomon::interleave)
    }

    /// Processes the buffer as far as its bytes allow.
    fn look(&mut self, at_end: bool, out: &mut Vec<u8>) {
        while at_end || 8 * self.buffer.len() >= self.wanted {
            let go_on = if self.locked { self.follow(at_end, out) } else { self.search(at_end, out) };
            if !go_on {
                return;
            }
        }
    }

    /// In lock: processes the frame that is due. Returns false if more bytes are needed.
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
                    self.counters.sync_losses += 1;
                    self.counters.bits_skipped += found.at.saturating_sub(self.at) as u64;
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
                    self.counters.frames_uncorrectable += 1;
                }
                // This frame may have lost bits, or, if its marker is bad too, the one before.
                polarity => {
                    self.counters.sync_losses += 1;
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

    /// Out of lock: examines the next place that may be a frame. Returns false if more bytes are needed.
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
                self.counters.interleave = found.code.interleave();
                self.lock(found.at);
                self.deliver(found, out);
                self.at = found.at + self.frame_bits();
            }
            // Even if another marker follows: data that repeats at the distance of a frame produces such pairs.
            Place::Nothing => self.pass(found + 1),
            Place::Unsure => {
                self.pass(found);
                return false;
            }
        }
        true
    }

    /// Where the next frame begins if the frames before the loss of lock simply continued.
    fn due_at(&self) -> Option<usize> {
        let (frame, now, lost_at) = (self.frame_bits() as u64, self.before + self.at as u64, self.lost_at?);
        let due = lost_at + now.saturating_sub(lost_at).next_multiple_of(frame);
        Some(self.at + (due - now) as usize)
    }

    /// Examines the place `at`; detects the depth of interleaving if it is unknown.
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
            // A block of equal octets, or nearly so, is a codeword at every depth: what follows must fit too.
            let good = at_end
                || self.another_follows(found.at, Some(code), polarity)
                || self.correct(found.at + frame_bits(code), code, polarity).is_some();
            if good && self.correct(found.at, code, polarity).is_some() {
                return place;
            }
        }
        Place::Nothing
    }

    /// The frame at bit `at`, or the rival of which it is a shifted image. Its block is in `self.block`.
    fn place(&mut self, at: usize, code: Option<ReedSolomon>, polarity: Polarity, at_end: bool) -> Place {
        let Some(found) = code.and_then(|code| self.correct(at, code, polarity)) else {
            return Place::Nothing;
        };
        if (found.corrected == 0 || found.faults <= FAULTS_OF_NO_IMAGE) && self.header().is_some() {
            return Place::Frame(found);
        }
        let reach = 8 * ERRORS_MAX * found.code.interleave();
        // In a search, earlier places were examined before.
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
        // Neither marker nor header: an image of a frame whose beginning is lost.
        let is_image = marker(word_at(&self.buffer, best.at)).is_none() && self.header().is_none();
        if is_image { Place::Nothing } else { Place::Frame(best) }
    }

    /// Whether all octets of the block are equal.
    fn is_constant(&self) -> bool {
        self.block.iter().all(|octet| Some(octet) == self.block.first())
    }

    /// Whether a place may be examined: the work so far is in proportion to the stream before it. It depends on the
    /// place alone, not on how much has arrived, so that chunk sizes do not matter.
    fn affords(&self, at: usize) -> bool {
        self.worked <= WORK_BYTES + WORK_A_BYTE * ((self.before + at as u64) / 8)
    }

    /// Whether there is a marker where the frame after that at `found` should begin.
    fn another_follows(&self, found: usize, code: Option<ReedSolomon>, polarity: Polarity) -> bool {
        let Some(code) = code else { return false };
        let next = found + frame_bits(code);
        next + MARKER_BITS <= 8 * self.buffer.len() && marker(word_at(&self.buffer, next)) == Some(polarity)
    }

    /// Skips bits in a search.
    fn pass(&mut self, to: usize) {
        if self.lost_at.is_none() {
            self.counters.bits_skipped += (to - self.at) as u64;
        }
        self.at = to;
    }

    /// Locks at `found`. Whole frames since the loss of lock count as uncorrectable, anything else as skipped bits.
    fn lock(&mut self, found: usize) {
        self.pass(found);
        self.locked = true;
        if let Some(lost_at) = self.lost_at.take() {
            let bits = (self.before + found as u64).saturating_sub(lost_at);
            let frame = self.frame_bits() as u64;
            if bits.is_multiple_of(frame) {
                self.counters.frames_uncorrectable += bits / frame;
            } else {
                self.counters.bits_skipped += bits;
            }
        }
    }

    fn turn(&mut self, polarity: Polarity) {
        self.counters.inversions += u64::from(polarity != self.polarity);
        self.polarity = polarity;
    }

    /// Corrects the block after the marker at bit `at` into `self.block`.
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

    /// The header of the frame in `self.block`, if it is valid for this spacecraft.
    fn header(&self) -> Option<FrameHeader> {
        let ours = |header: &FrameHeader| self.spacecraft.is_none_or(|known| known == header.spacecraft);
        self.block.get(..FRAME_HEADER_BYTES).and_then(FrameHeader::parse).filter(ours)
    }

    /// Processes the frame in `self.block`.
    fn deliver(&mut self, found: LocatedFrame, out: &mut Vec<u8>) {
        self.turn(found.polarity);
        self.counters.frames += 1;
        self.counters.frames_corrected += u64::from(found.corrected > 0);
        self.counters.bytes_corrected += found.corrected as u64;
        let Some(header) = self.header() else {
            self.counters.frames_foreign += 1;
            return;
        };
        let frame = &self.block[..found.code.data_bytes()];
        self.spacecraft = Some(header.spacecraft);
        if header.channel == IDLE {
            self.counters.frames_idle += 1;
        } else if self.channels.len() < CHANNELS_MAX || self.channels.contains_key(&header.channel) {
            let assembler =
                self.channels.entry(header.channel).or_insert_with(|| Assembler::new(header.channel));
            assembler.take(header, frame, &mut self.counters, out);
        } else {
            self.counters.frames_foreign += 1;
        }
    }

    /// Drops bytes that will not be examined again.
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
