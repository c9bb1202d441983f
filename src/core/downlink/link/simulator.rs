//! Applies the faults of a link to a downlink and records the truth.

use rand::RngExt;
use rand_chacha::ChaCha8Rng;

use super::bit_errors::BitErrors;
use super::bit_writer::BitWriter;
use super::splitter::{SentPass, Splitter};
use super::truth::{FrameFate, LinkTruth, list_packet};
use crate::downlink::config::LinkConfig;
use crate::downlink::error::DownlinkError;
use crate::downlink::wire::Format;
use crate::downlink::wire::cadu::{ERRORS_MAX, MARKER_ERRORS_MAX, ReedSolomon, SYNC_MARKER_BYTES};
use crate::units::{StreamKind, random_stream};

/// One copy of a unit that arrives on the ground.
#[derive(Clone, Copy, Debug)]
struct UnitCopy {
    /// Index of the unit in its pass.
    unit: usize,
    /// Sort key of the order of arrival.
    order: u64,
    bytes: usize,
    /// Whether a bit is lost or added.
    slips: bool,
}

/// A pass and the copies of its units that arrive.
#[derive(Debug)]
struct PassInTransit {
    /// Number of the pass, from 1.
    number: u64,
    pass: SentPass,
    copies: Vec<UnitCopy>,
    outcomes: Vec<UnitOutcome>,
    random: ChaCha8Rng,
}

/// What happened to a unit.
#[derive(Clone, Copy, Debug, Default)]
struct UnitOutcome {
    recoverable: u32,
    /// The greatest fate of the other copies.
    fate: Option<FrameFate>,
}

/// Damages a downlink pass by pass. Holds one pass, or two while they are swapped.
///
/// The faults of a pass depend only on the seed and the pass number.
#[derive(Debug)]
pub struct LinkSimulator {
    config: LinkConfig,
    code: Option<ReedSolomon>,
    splitter: Splitter,
    /// A pass that arrives after the next one.
    delayed: Option<PassInTransit>,
    /// Shift of the frames since the receiver was last in lock, bits; `None` before the first lock. Unless the shift is a
    /// whole number of frames, the receiver finds the next frame only by its marker.
    shift_bits: Option<i64>,
    truth: LinkTruth,
}

impl LinkSimulator {
    /// A link for plain packets, or for frames with the given code.
    ///
    /// # Errors
    /// The first of [`LinkConfig::problems`].
    pub fn new(config: &LinkConfig, seed: u64, code: Option<ReedSolomon>) -> Result<Self, DownlinkError> {
        let format = if code.is_some() { Format::Cadu } else { Format::Packets };
        if let Some(problem) = config.problems(format).into_iter().next() {
            return Err(problem.into());
        }
        let truth = LinkTruth { seed, link: config.clone(), format, ..LinkTruth::default() };
        Ok(Self {
            config: config.clone(),
            code,
            splitter: Splitter::new(code),
            delayed: None,
            shift_bits: None,
            truth,
        })
    }

    /// Sends the next bytes of an undamaged downlink; appends what arrives to `out`.
    ///
    /// # Errors
    /// The bytes are not an undamaged downlink.
    pub fn push(&mut self, bytes: &[u8], out: &mut Vec<u8>) -> Result<(), DownlinkError> {
        let mut passes = Vec::new();
        self.splitter.push(bytes, |pass| passes.push(pass))?;
        for pass in passes {
            self.send(pass, out);
        }
        Ok(())
    }

    /// Ends the transmission; appends what has not arrived yet to `out`.
    ///
    /// # Errors
    /// The downlink ends within a frame or packet.
    pub fn finish(&mut self, out: &mut Vec<u8>) -> Result<&LinkTruth, DownlinkError> {
        if let Some(pass) = self.splitter.finish()? {
            self.send(pass, out);
        }
        if let Some(delayed) = self.delayed.take() {
            self.deliver(delayed, out);
        }
        Ok(&self.truth)
    }

    /// The truth about the passes sent so far.
    #[must_use]
    pub fn truth(&self) -> &LinkTruth {
        &self.truth
    }

    fn send(&mut self, pass: SentPass, out: &mut Vec<u8>) {
        let number = self.truth.passes + 1;
        self.truth.passes = number;
        let mut random = random_stream(self.truth.seed, StreamKind::Link, [number - 1, 0]);
        let lost = random.random_bool(self.config.pass_loss);
        let swapped = random.random_bool(self.config.pass_swap);
        let mut outcomes = vec![UnitOutcome::default(); pass.units.len()];
        let mut copies = Vec::new();
        if lost {
            self.truth.passes_lost += 1;
            outcomes.fill(UnitOutcome { recoverable: 0, fate: Some(FrameFate::PassLost) });
        } else {
            copies = self.schedule(&pass, &mut random, &mut outcomes);
        }
        let transit = PassInTransit { number, pass, copies, outcomes, random };
        match self.delayed.take() {
            None if swapped => {
                self.truth.passes_swapped += 1;
                self.delayed = Some(transit);
            }
            earlier => {
                self.deliver(transit, out);
                if let Some(earlier) = earlier {
                    self.deliver(earlier, out);
                }
            }
        }
    }

    fn deliver(&mut self, mut transit: PassInTransit, out: &mut Vec<u8>) {
        let bytes = self.transmit(&mut transit);
        self.record(&transit.pass, &transit.outcomes);
        self.truth.bytes_delivered += bytes.len() as u64;
        out.extend_from_slice(&bytes);
    }

    /// Draws the copies that arrive, in the order of arrival.
    fn schedule(
        &mut self,
        pass: &SentPass,
        random: &mut ChaCha8Rng,
        outcomes: &mut [UnitOutcome],
    ) -> Vec<UnitCopy> {
        let count = pass.units.len();
        let mut cut = (count, 0);
        if random.random_bool(self.config.pass_cut) && count > 0 {
            let unit = random.random_range(0..count);
            // At least half of the unit is missing, more than any code can correct.
            cut = (unit, random.random_range(0..=pass.units[unit].bytes.len() / 2));
            self.truth.passes_cut += 1;
        }
        let overlap = count.min(usize::try_from(self.config.second_station_frames).unwrap_or(count));
        let first = (0..count).map(|unit| (unit, unit, true));
        let second = (count - overlap..count).map(|unit| (unit, overlap + unit, false));
        let mut copies = Vec::with_capacity(count + overlap);
        for (unit, place, by_first) in first.chain(second) {
            let arrives_twice = random.random_bool(self.config.duplicate);
            for _ in 0..=u32::from(arrives_twice) {
                let lost = random.random_bool(self.config.frame_loss);
                let slips = random.random_bool(self.config.bit_slip);
                let late = random.random_bool(self.config.reorder) && self.config.reorder_frames > 0;
                let delay = if late { random.random_range(1..=self.config.reorder_frames) } else { 0 };
                let whole = pass.units[unit].bytes.len();
                let bytes = if by_first && unit == cut.0 { cut.1 } else { whole };
                let fate = match (by_first && unit >= cut.0, lost) {
                    (true, _) => Some(FrameFate::CutOff),
                    (false, true) => Some(FrameFate::Lost),
                    (false, false) => None,
                };
                outcomes[unit].fate = outcomes[unit].fate.max(fate);
                if fate.is_none() || by_first && unit == cut.0 {
                    self.truth.copies_delayed += u64::from(late);
                    copies.push(UnitCopy { unit, order: place as u64 + delay, bytes, slips });
                }
            }
        }
        copies.sort_by_key(|copy| copy.order);
        copies
    }

    /// Applies the faults to the copies; returns the bytes that arrive.
    fn transmit(&mut self, transit: &mut PassInTransit) -> Vec<u8> {
        let PassInTransit { number, pass, copies, outcomes, random } = transit;
        let mut bit_errors =
            BitErrors::new(&self.config, random_stream(self.truth.seed, StreamKind::Link, [*number, 1]));
        let mut writer = BitWriter::default();
        for copy in &*copies {
            let sent = &pass.units[copy.unit].bytes;
            let mut bytes = sent[..copy.bytes].to_vec();
            let mut flips = Vec::new();
            bit_errors.apply(&mut bytes, |bit| flips.push(bit));
            self.truth.copies_delivered += 1;
            self.truth.copies_damaged += u64::from(!flips.is_empty());
            self.truth.bits_flipped += flips.len() as u64;
            let outcome = &mut outcomes[copy.unit];
            let fate = if copy.bytes < sent.len() {
                Some(FrameFate::CutOff)
            } else if copy.slips {
                Some(FrameFate::Slipped)
            } else if is_unrecoverable(&flips, self.code) || !self.is_found(sent.len(), &flips) {
                Some(FrameFate::Spoilt)
            } else {
                self.shift_bits = Some(0);
                None
            };
            outcome.recoverable += u32::from(fate.is_none());
            outcome.fate = outcome.fate.max(fate);
            let start_bits = writer.bits();
            match self.code.filter(|_| copy.slips && copy.bytes == sent.len()) {
                Some(code) => {
                    self.truth.copies_slipped += 1;
                    // Far enough from both ends that no code can correct the shifted part.
                    let margin = 8 * (SYNC_MARKER_BYTES + 64 * code.interleave());
                    let bit = random.random_range(margin..8 * sent.len() - margin);
                    let added = random.random::<bool>().then(|| random.random());
                    writer.slip(&bytes, bit, added);
                }
                None => writer.push(&bytes),
            }
            self.shift(writer.bits() - start_bits - 8 * sent.len() as i64);
        }
        let start_bits = writer.bits();
        let bytes = writer.into_bytes();
        self.shift(8 * bytes.len() as i64 - start_bits);
        bytes
    }

    fn shift(&mut self, bits: i64) {
        self.shift_bits = self.shift_bits.map(|before| before + bits);
    }

    /// Whether the receiver finds a frame of `bytes` bytes, where it is due or by its marker.
    fn is_found(&self, bytes: usize, flips: &[usize]) -> bool {
        let wrong = flips.iter().filter(|bit| **bit < 8 * SYNC_MARKER_BYTES).count();
        let is_due = self.shift_bits.is_some_and(|bits| bits % (8 * bytes as i64) == 0);
        self.code.is_none() || is_due || wrong <= MARKER_ERRORS_MAX as usize
    }

    fn record(&mut self, pass: &SentPass, outcomes: &[UnitOutcome]) {
        if let Some(report) = pass.report {
            // The counts never decrease, so the maximum also holds for swapped passes.
            self.truth.visibilities_sampled = self.truth.visibilities_sampled.max(report.sampled);
            self.truth.visibilities_dropped = self.truth.visibilities_dropped.max(report.dropped);
        }
        for (unit, outcome) in pass.units.iter().zip(outcomes) {
            self.truth.frames_sent += 1;
            self.truth.frames_recoverable += u64::from(outcome.recoverable > 0);
            self.truth.copies_duplicate += u64::from(outcome.recoverable.saturating_sub(1));
            if let (0, Some(fate), Some((channel, count))) = (outcome.recoverable, outcome.fate, unit.frame) {
                self.truth.add_lost_frame(channel, count, fate);
            }
        }
        for packet in &pass.packets {
            self.truth.packets_sent += 1;
            self.truth.visibilities_sent += packet.visibilities;
            match packet.units.iter().map(|unit| outcomes[*unit].recoverable).min().unwrap_or(0) {
                0 => {
                    self.truth.visibilities_lost += packet.visibilities;
                    list_packet(&mut self.truth.packets_lost, packet.apid, packet.count);
                }
                1 => {}
                _ => list_packet(&mut self.truth.packets_duplicate, packet.apid, packet.count),
            }
        }
    }
}

/// Whether bit errors make a unit unrecoverable: more wrong bytes in a codeword than can be corrected, or any in a
/// plain packet.
fn is_unrecoverable(flips: &[usize], code: Option<ReedSolomon>) -> bool {
    let Some(code) = code else { return !flips.is_empty() };
    let mut wrong = [0; 8];
    let mut last = None;
    for byte in flips.iter().filter_map(|bit| (bit / 8).checked_sub(SYNC_MARKER_BYTES)) {
        if last.replace(byte) != Some(byte) {
            wrong[byte % code.interleave()] += 1;
        }
    }
    wrong.iter().any(|wrong| *wrong > ERRORS_MAX)
}
