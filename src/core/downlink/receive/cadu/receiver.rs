//! A receiver of packets from a coded stream with any damage by a link or a disk.

use std::collections::BTreeMap;

use super::FrameCounters;
use super::assembler::Assembler;
use crate::downlink::wire::cadu::bits::{
    Polarity, copy_at, find_marker, marker_errors, marker_polarity, word_at,
};
use crate::downlink::wire::cadu::{CODEWORD_BYTES, ERRORS_MAX, INTERLEAVES, PARITY_BYTES, ReedSolomon};
use crate::downlink::wire::cadu::{FRAME_HEADER_BYTES, FrameHeader, IDLE, SYNC_MARKER_BYTES, randomize};

/// Maximum number of virtual channels without the idle channel; bounds memory.
const CHANNELS_MAX: usize = 8;

const MARKER_BITS: usize = 8 * SYNC_MARKER_BYTES;

/// Maximum number of processed bytes at the front of the buffer before they are dropped.
const PROCESSED_BYTES_MAX: usize = 1 << 18;

/// Maximum number of octets decoded per octet of the stream, even for a stream full of markers. In lock it is one.
const WORK_PER_BYTE: u64 = 4;

/// Number of octets that may be decoded in addition: a few dozen places at every depth of interleaving.
const WORK_BYTES: u64 = 1 << 20;

/// Maximum number of faults of a frame with a valid header that is accepted without a search for rivals. A shifted image
/// with a marker lies at least four octets from its frame, or three if the marker lacks bits, and all these octets are
/// faults.
const UNAMBIGUOUS_FAULTS_MAX: usize = 2;

/// A frame found in the buffer, after correction.
#[derive(Clone, Copy, Debug)]
struct LocatedFrame {
    /// Bit of the buffer at which its marker begins or should begin.
    at: usize,
    code: ReedSolomon,
    polarity: Polarity,
    /// Number of octets corrected in its block.
    corrected: usize,
    /// Number of faults: octets corrected, wrong bits of the marker, and an invalid header. On a poor link, each has a
    /// probability of about 1 in 1000.
    faults: usize,
}

/// The result of examining a bit of the stream for a frame.
#[derive(Clone, Copy, Debug)]
enum FrameMatch {
    Frame(LocatedFrame),
    NoFrame,
    /// More bytes are needed to decide.
    Undecided,
}

/// Finds frames in a stream of bits, corrects them, and assembles their packets.
///
/// It has the three usual states:
/// - *Search*: examines each bit at which a marker begins (at most 3 wrong bits, upright or inverted), and each bit at
///   which a frame is expected.
/// - *Check*: accepts a place if a correctable block follows. While the interleave is unknown, the header must also be
///   valid, or another frame must follow.
/// - *Lock*: frames follow one another. A bad marker is ignored if its block can be corrected, and a bad block if another
///   marker follows. Otherwise the search resumes at this frame or, if the frame before may have lost bits, shortly before.
///
/// Interleave and polarity are detected.
///
/// A correctable block need not begin where it was found. The code is cyclic, and with 1, 2, 4 or 8 interleaved codewords
/// a shifted randomizer differs from the original by a codeword. Up to 16 octets per codeword too early or too late, a
/// frame is therefore corrected to a rotation of itself, and so is every frame after it. So a frame with more than two
/// faults, or with an invalid header, has rivals: places within that distance that have a marker. The place with the
/// fewest faults is accepted.
///
/// Work is bounded: once a stream has produced too many candidates, further ones are ignored.
#[derive(Debug, Default)]
pub struct CaduReceiver {
    buffer: Vec<u8>,
    /// Next bit of the buffer to examine.
    at: usize,
    is_locked: bool,
    /// Number of bits of the stream before the buffer.
    bits_before: u64,
    /// Bit of the stream at which the lock was lost; `None` in lock and before the first.
    lost_at: Option<u64>,
    polarity: Polarity,
    /// Code and spacecraft of the first frame; `None` before it.
    code: Option<ReedSolomon>,
    spacecraft: Option<u8>,
    /// The block that was decoded last.
    block: Vec<u8>,
    channels: BTreeMap<u8, Assembler>,
    counters: FrameCounters,
    /// Number of bits that the buffer must have before it is examined again.
    needed_bits: usize,
    octets_decoded: u64,
}

impl CaduReceiver {
    /// A receiver at the start of a stream.
    #[must_use]
    pub fn new() -> Self {
        Self::default()
    }

    /// Takes the next bytes of the stream; appends the packets that they complete to `out`, in the order of completion and
    /// without idle packets.
    pub fn push(&mut self, bytes: &[u8], out: &mut Vec<u8>) {
        self.counters.bytes += bytes.len() as u64;
        self.buffer.extend_from_slice(bytes);
        self.process(false, out);
        self.drop_processed();
    }

    /// Takes bytes as [`CaduReceiver::push`] does, which are one whole frame, as in a datagram. The first tells the interleave by its
    /// length, so that no other has to follow it.
    pub fn push_frame(&mut self, bytes: &[u8], out: &mut Vec<u8>) {
        let at = 8 * self.buffer.len();
        let mut codes = INTERLEAVES.into_iter().filter_map(ReedSolomon::new);
        if self.code.is_none()
            && let Some(code) = codes.find(|code| frame_bits(*code) == 8 * bytes.len())
            && let Some(polarity) = marker_polarity(word_at(bytes, 0))
        {
            self.buffer.extend_from_slice(bytes);
            let is_frame = self.correct(at, code, polarity).is_some() && self.header().is_some();
            self.code = Some(code).filter(|_| is_frame && !self.is_constant());
            self.buffer.truncate(at / 8);
        }
        self.push(bytes, out);
    }

    /// Ends the stream. Another one may follow, with the same interleave, polarity and counters.
    pub fn finish(&mut self, out: &mut Vec<u8>) {
        self.process(true, out);
        let left = (8 * self.buffer.len()).saturating_sub(self.at);
        if self.is_locked {
            self.counters.bytes_truncated += left as u64 / 8;
        } else {
            self.counters.bits_skipped += left as u64;
        }
        if let Some(lost_at) = self.lost_at.take() {
            self.counters.bits_skipped += (self.bits_before + self.at as u64).saturating_sub(lost_at);
        }
        self.bits_before += 8 * self.buffer.len() as u64;
        self.buffer.clear();
        (self.at, self.needed_bits, self.is_locked) = (0, 0, false);
    }

    /// Whether a frame has been found.
    #[must_use]
    pub fn has_frame(&self) -> bool {
        self.code.is_some()
    }

    /// Memory, bytes: at most twice the longest chunk and half a megabyte for the stream, plus that of the assemblers.
    #[must_use]
    pub fn memory_bytes(&self) -> usize {
        self.buffer.capacity() + self.channels.values().map(Assembler::memory_bytes).sum::<usize>()
    }

    /// Number of octets decoded, including false candidates: at most four per octet of the stream plus a megabyte.
    #[must_use]
    pub fn octets_decoded(&self) -> u64 {
        self.octets_decoded
    }

    /// The counters so far.
    #[must_use]
    pub fn counters(&self) -> FrameCounters {
        let mut counters = self.counters.clone();
        for assembler in self.channels.values() {
            let (pieces, bytes) = assembler.fragments();
            counters.fragments += pieces;
            counters.bytes_fragments += bytes;
            counters.channels.push(assembler.counts().clone());
        }
        counters
    }

    /// Number of bits of a marker and its block; the longest, while the code is unknown.
    fn frame_bits(&self) -> usize {
        let longest = INTERLEAVES[INTERLEAVES.len() - 1];
        self.code.map_or(MARKER_BITS + 8 * CODEWORD_BYTES * longest, frame_bits)
    }

    /// Maximum number of bits that a correctable block can lack at its end.
    fn slack_bits(&self) -> usize {
        8 * PARITY_BYTES * self.code.map_or(0, ReedSolomon::interleave)
    }

    fn process(&mut self, at_end: bool, out: &mut Vec<u8>) {
        while at_end || 8 * self.buffer.len() >= self.needed_bits {
            let has_advanced =
                if self.is_locked { self.follow(at_end, out) } else { self.search(at_end, out) };
            if !has_advanced {
                return;
            }
        }
    }

    /// In lock: processes the next frame. Returns false if more bytes are needed.
    fn follow(&mut self, at_end: bool, out: &mut Vec<u8>) -> bool {
        let (frame, bits) = (self.frame_bits(), 8 * self.buffer.len());
        if self.at + frame > bits {
            return false;
        }
        let polarity = marker_polarity(word_at(&self.buffer, self.at));
        match self.place(self.at, self.code, polarity.unwrap_or(self.polarity), at_end) {
            FrameMatch::Undecided => return false,
            FrameMatch::Frame(found) => {
                if found.at != self.at {
                    self.counters.sync_losses += 1;
                    self.counters.bits_skipped += found.at.saturating_sub(self.at) as u64;
                }
                self.at = found.at;
                self.deliver(found, out);
            }
            FrameMatch::NoFrame => match polarity {
                _ if self.at + frame + MARKER_BITS > bits && !at_end => {
                    self.needed_bits = self.at + frame + MARKER_BITS;
                    return false;
                }
                Some(polarity) if at_end || self.another_follows(self.at, self.code, polarity) => {
                    self.set_polarity(polarity);
                    self.counters.frames_uncorrectable += 1;
                }
                // This frame may have lost bits or, if its marker is bad too, the frame before it.
                polarity => {
                    self.counters.sync_losses += 1;
                    self.is_locked = false;
                    self.lost_at = Some(self.bits_before + self.at as u64);
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

    /// Out of lock: examines the next place that may begin a frame. Returns false if more bytes are needed.
    fn search(&mut self, at_end: bool, out: &mut Vec<u8>) -> bool {
        let bits = 8 * self.buffer.len();
        // At the end of the stream no other frame need follow, and `correct` checks the length.
        let needed = match (at_end, self.code) {
            (true, _) => MARKER_BITS,
            (false, Some(_)) => self.frame_bits(),
            (false, None) => 2 * self.frame_bits(),
        };
        let to = (bits + 1).saturating_sub(needed);
        let expected = self.expected_at().filter(|expected| *expected < to);
        let found = find_marker(&self.buffer, self.at, expected.unwrap_or(to));
        let Some(found) = found.or(expected) else {
            self.skip_to(to.max(self.at));
            return false;
        };
        let polarity = marker_polarity(word_at(&self.buffer, found)).unwrap_or(self.polarity);
        let place =
            if self.has_work_left(found) { self.check(found, polarity, at_end) } else { FrameMatch::NoFrame };
        match place {
            FrameMatch::Frame(found) => {
                self.code = Some(found.code);
                self.counters.interleave = found.code.interleave();
                self.lock(found.at);
                self.deliver(found, out);
                self.at = found.at + self.frame_bits();
            }
            // Even if another marker follows: periodic data can have markers at the distance of a frame.
            FrameMatch::NoFrame => self.skip_to(found + 1),
            FrameMatch::Undecided => {
                self.skip_to(found);
                return false;
            }
        }
        true
    }

    /// Where the next frame is expected if the frames continued regularly after the loss of lock.
    fn expected_at(&self) -> Option<usize> {
        let (frame, now, lost_at) =
            (self.frame_bits() as u64, self.bits_before + self.at as u64, self.lost_at?);
        let expected = lost_at + now.saturating_sub(lost_at).next_multiple_of(frame);
        Some(self.at + (expected - now) as usize)
    }

    /// Examines the place `at`; detects the depth of interleaving if it is unknown.
    fn check(&mut self, at: usize, polarity: Polarity, at_end: bool) -> FrameMatch {
        if self.code.is_some() {
            return self.place(at, self.code, polarity, at_end);
        }
        for code in INTERLEAVES.into_iter().filter_map(ReedSolomon::new) {
            let place = self.place(at, Some(code), polarity, at_end);
            let FrameMatch::Frame(found) = place else { continue };
            if self.header().is_some() && !self.is_constant() {
                return place;
            }
            // A block of equal octets, or nearly so, is a codeword at every depth, so another frame must follow.
            let is_confirmed = at_end
                || self.another_follows(found.at, Some(code), polarity)
                || self.correct(found.at + frame_bits(code), code, polarity).is_some();
            if is_confirmed && self.correct(found.at, code, polarity).is_some() {
                return place;
            }
        }
        FrameMatch::NoFrame
    }

    /// Finds the frame at bit `at`, or the rival of which it is a shifted image. Leaves its block in `self.block`.
    fn place(
        &mut self,
        at: usize,
        code: Option<ReedSolomon>,
        polarity: Polarity,
        at_end: bool,
    ) -> FrameMatch {
        let Some(found) = code.and_then(|code| self.correct(at, code, polarity)) else {
            return FrameMatch::NoFrame;
        };
        if (found.corrected == 0 || found.faults <= UNAMBIGUOUS_FAULTS_MAX) && self.header().is_some() {
            return FrameMatch::Frame(found);
        }
        let reach = 8 * ERRORS_MAX * found.code.interleave();
        // A search has examined earlier places already.
        let earliest = if self.is_locked { 0 } else { self.at };
        let (mut best, mut decoded_at) = (found, at);
        for rival in (at % 8 + (at - at % 8).saturating_sub(reach)..=at + reach).step_by(8) {
            let is_marked = marker_polarity(word_at(&self.buffer, rival)) == Some(polarity);
            if rival == at || rival < earliest || !is_marked || !self.has_work_left(at) {
                continue;
            }
            let end = rival + frame_bits(found.code);
            if end > 8 * self.buffer.len() && !at_end {
                self.needed_bits = end;
                return FrameMatch::Undecided;
            }
            if let Some(other) = self.correct(rival, found.code, polarity) {
                best = if other.faults < best.faults { other } else { best };
            }
            decoded_at = rival;
        }
        if decoded_at != best.at && self.correct(best.at, best.code, polarity).is_none() {
            return FrameMatch::NoFrame;
        }
        // Without marker and header it is an image of a frame whose beginning is lost.
        let is_image = marker_polarity(word_at(&self.buffer, best.at)).is_none() && self.header().is_none();
        if is_image { FrameMatch::NoFrame } else { FrameMatch::Frame(best) }
    }

    fn is_constant(&self) -> bool {
        self.block.iter().all(|octet| Some(octet) == self.block.first())
    }

    /// Whether bit `at` may be examined, as the work is limited in proportion to the stream before it. The limit does not
    /// depend on how much has arrived, so that chunk sizes do not matter.
    fn has_work_left(&self, at: usize) -> bool {
        self.octets_decoded <= WORK_BYTES + WORK_PER_BYTE * ((self.bits_before + at as u64) / 8)
    }

    /// Whether a marker follows the frame at bit `found`.
    fn another_follows(&self, found: usize, code: Option<ReedSolomon>, polarity: Polarity) -> bool {
        let Some(code) = code else { return false };
        let next = found + frame_bits(code);
        next + MARKER_BITS <= 8 * self.buffer.len()
            && marker_polarity(word_at(&self.buffer, next)) == Some(polarity)
    }

    /// Skips the bits before bit `to` in a search.
    fn skip_to(&mut self, to: usize) {
        if self.lost_at.is_none() {
            self.counters.bits_skipped += (to - self.at) as u64;
        }
        self.at = to;
    }

    /// Locks at bit `found`. Since the loss of lock, a whole number of frames counts as uncorrectable frames, any other
    /// distance as skipped bits.
    fn lock(&mut self, found: usize) {
        self.skip_to(found);
        self.is_locked = true;
        if let Some(lost_at) = self.lost_at.take() {
            let bits = (self.bits_before + found as u64).saturating_sub(lost_at);
            let frame = self.frame_bits() as u64;
            if bits.is_multiple_of(frame) {
                self.counters.frames_uncorrectable += bits / frame;
            } else {
                self.counters.bits_skipped += bits;
            }
        }
    }

    fn set_polarity(&mut self, polarity: Polarity) {
        self.counters.inversions += u64::from(polarity != self.polarity);
        self.polarity = polarity;
    }

    /// Decodes the block after the marker at bit `at` into `self.block`; `None` if it cannot be corrected.
    fn correct(&mut self, at: usize, code: ReedSolomon, polarity: Polarity) -> Option<LocatedFrame> {
        if at + frame_bits(code) > 8 * self.buffer.len() {
            return None;
        }
        self.octets_decoded += code.block_bytes() as u64;
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
        let is_own = |header: &FrameHeader| self.spacecraft.is_none_or(|known| known == header.spacecraft);
        self.block.get(..FRAME_HEADER_BYTES).and_then(FrameHeader::parse).filter(is_own)
    }

    fn deliver(&mut self, found: LocatedFrame, out: &mut Vec<u8>) {
        self.set_polarity(found.polarity);
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
            assembler.receive(header, frame, &mut self.counters, out);
        } else {
            self.counters.frames_foreign += 1;
        }
    }

    /// Drops bytes that will not be examined again.
    fn drop_processed(&mut self) {
        let processed = self.at.saturating_sub(self.slack_bits()) / 8;
        if processed >= PROCESSED_BYTES_MAX || processed == self.buffer.len() {
            self.buffer.drain(..processed);
            self.at -= 8 * processed;
            self.needed_bits = self.needed_bits.saturating_sub(8 * processed);
            self.bits_before += 8 * processed as u64;
        }
    }
}

/// Number of bits of a marker and a block of `code`.
fn frame_bits(code: ReedSolomon) -> usize {
    MARKER_BITS + 8 * code.block_bytes()
}
