//! What a link makes of a downlink, and the truth about it.

use rand::RngExt;
use rand_chacha::ChaCha8Rng;

use super::bit_writer::BitWriter;
use super::config::LinkConfig;
use super::noise::Noise;
use super::splitter::{SentPass, Splitter};
use super::truth::{FrameFate, LinkTruth, list_packet};
use crate::downlink::error::DownlinkError;
use crate::downlink::wire::Format;
use crate::downlink::wire::cadu::{ERRORS_MAX, MARKER_ERRORS_MAX, ReedSolomon, SYNC_MARKER_BYTES};
use crate::units::{StreamKind, random_stream};

/// A unit on its way to the ground.
#[derive(Clone, Copy, Debug)]
struct Dispatch {
    unit: usize,
    /// Place in the order of arrival.
    order: u64,
    /// So many of its bytes arrive.
    bytes: usize,
    slips: bool,
}

/// A pass that sets out.
#[derive(Debug)]
struct Departure {
    /// Passes sent, this one included.
    number: u64,
    pass: SentPass,
    copies: Vec<Dispatch>,
    outcomes: Vec<UnitOutcome>,
    random: ChaCha8Rng,
}

/// What has become of a unit.
#[derive(Clone, Copy, Debug, Default)]
struct UnitOutcome {
    /// Copies that can be recovered.
    good: u32,
    /// The fate of the one that got furthest of the others.
    fate: Option<FrameFate>,
}

/// Damages a downlink as a link would, pass by pass. Holds one pass, and another while it is swapped.
///
/// Faults of a pass depend on the seed and its number alone.
#[derive(Debug)]
pub struct LinkSimulator {
    config: LinkConfig,
    code: Option<ReedSolomon>,
    splitter: Splitter,
    /// A pass that arrives after the next.
    held: Option<Departure>,
    /// Bits by which frames have been put off since the receiver last stood at the beginning of one; `None` before that.
    /// Unless they are whole frames, it finds the next by its marker alone.
    put_off_bits: Option<i64>,
    truth: LinkTruth,
}

impl LinkSimulator {
    /// A link for plain packets, or for frames of that code.
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
            held: None,
            put_off_bits: None,
            truth,
        })
    }

    /// Takes the next bytes of a sound downlink; appends what arrives to `out`.
    ///
    /// # Errors
    /// Anything but a sound downlink.
    pub fn push(&mut self, bytes: &[u8], out: &mut Vec<u8>) -> Result<(), DownlinkError> {
        let mut passes = Vec::new();
        self.splitter.push(bytes, |pass| passes.push(pass))?;
        for pass in passes {
            self.send(pass, out);
        }
        Ok(())
    }

    /// Says that all has been sent; appends what has not arrived yet to `out`.
    ///
    /// # Errors
    /// A downlink that ends within a frame or packet.
    pub fn finish(&mut self, out: &mut Vec<u8>) -> Result<&LinkTruth, DownlinkError> {
        if let Some(pass) = self.splitter.finish()? {
            self.send(pass, out);
        }
        if let Some(held) = self.held.take() {
            self.deliver(held, out);
        }
        Ok(&self.truth)
    }

    /// The truth so far.
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
            outcomes.fill(UnitOutcome { good: 0, fate: Some(FrameFate::PassLost) });
        } else {
            copies = self.schedule(&pass, &mut random, &mut outcomes);
        }
        let departure = Departure { number, pass, copies, outcomes, random };
        match self.held.take() {
            None if swapped => {
                self.truth.passes_swapped += 1;
                self.held = Some(departure);
            }
            earlier => {
                self.deliver(departure, out);
                if let Some(earlier) = earlier {
                    self.deliver(earlier, out);
                }
            }
        }
    }

    fn deliver(&mut self, mut departure: Departure, out: &mut Vec<u8>) {
        let bytes = self.carry(&mut departure);
        self.settle(&departure.pass, &departure.outcomes);
        self.truth.bytes_delivered += bytes.len() as u64;
        out.extend_from_slice(&bytes);
    }

    /// The copies that set out and arrive, in the order in which they do.
    fn schedule(
        &mut self,
        pass: &SentPass,
        random: &mut ChaCha8Rng,
        outcomes: &mut [UnitOutcome],
    ) -> Vec<Dispatch> {
        let count = pass.units.len();
        let mut cut = (count, 0);
        if random.random_bool(self.config.pass_cut) && count > 0 {
            let unit = random.random_range(0..count);
            // So much is missing that no code can make up for it.
            cut = (unit, random.random_range(0..=pass.units[unit].bytes.len() / 2));
            self.truth.passes_cut += 1;
        }
        let overlap = count.min(usize::try_from(self.config.second_station_frames).unwrap_or(count));
        let first = (0..count).map(|unit| (unit, unit, true));
        let second = (count - overlap..count).map(|unit| (unit, overlap + unit, false));
        let mut copies = Vec::with_capacity(count + overlap);
        for (unit, place, by_first) in first.chain(second) {
            let again = random.random_bool(self.config.duplicate);
            for _ in 0..=u32::from(again) {
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
                    copies.push(Dispatch { unit, order: place as u64 + delay, bytes, slips });
                }
            }
        }
        copies.sort_by_key(|copy| copy.order);
        copies
    }

    /// What arrives of the copies, wrong bits and all.
    fn carry(&mut self, departure: &mut Departure) -> Vec<u8> {
        let Departure { number, pass, copies, outcomes, random } = departure;
        let mut noise =
            Noise::new(&self.config, random_stream(self.truth.seed, StreamKind::Link, [*number, 1]));
        let mut writer = BitWriter::default();
        for copy in &*copies {
            let sent = &pass.units[copy.unit].bytes;
            let mut bytes = sent[..copy.bytes].to_vec();
            let mut flips = Vec::new();
            noise.spoil(&mut bytes, |bit| flips.push(bit));
            self.truth.copies_delivered += 1;
            self.truth.copies_damaged += u64::from(!flips.is_empty());
            self.truth.bits_flipped += flips.len() as u64;
            let outcome = &mut outcomes[copy.unit];
            let fate = if copy.bytes < sent.len() {
                Some(FrameFate::CutOff)
            } else if copy.slips {
                Some(FrameFate::Slipped)
            } else if is_spoilt(&flips, self.code) || !self.is_found(sent.len(), &flips) {
                Some(FrameFate::Spoilt)
            } else {
                self.put_off_bits = Some(0);
                None
            };
            outcome.good += u32::from(fate.is_none());
            outcome.fate = outcome.fate.max(fate);
            let begun = writer.bits();
            match self.code.filter(|_| copy.slips && copy.bytes == sent.len()) {
                Some(code) => {
                    self.truth.copies_slipped += 1;
                    // So far from both ends that no code can make up for it.
                    let margin = 8 * (SYNC_MARKER_BYTES + 64 * code.interleave());
                    let bit = random.random_range(margin..8 * sent.len() - margin);
                    let added = random.random::<bool>().then(|| random.random());
                    writer.slip(&bytes, bit, added);
                }
                None => writer.push(&bytes),
            }
            self.put_off(writer.bits() - begun - 8 * sent.len() as i64);
        }
        let begun = writer.bits();
        let bytes = writer.into_bytes();
        self.put_off(8 * bytes.len() as i64 - begun);
        bytes
    }

    fn put_off(&mut self, bits: i64) {
        self.put_off_bits = self.put_off_bits.map(|before| before + bits);
    }

    /// Whether the receiver finds a frame of so many bytes: it stands where it is due, or its marker tells.
    fn is_found(&self, bytes: usize, flips: &[usize]) -> bool {
        let wrong = flips.iter().filter(|bit| **bit < 8 * SYNC_MARKER_BYTES).count();
        let is_due = self.put_off_bits.is_some_and(|bits| bits % (8 * bytes as i64) == 0);
        self.code.is_none() || is_due || wrong <= MARKER_ERRORS_MAX as usize
    }

    /// Takes the outcomes of a pass into the account.
    fn settle(&mut self, pass: &SentPass, outcomes: &[UnitOutcome]) {
        if let Some(report) = pass.report {
            // Of two passes that are swapped the later one says more.
            self.truth.visibilities_sampled = self.truth.visibilities_sampled.max(report.sampled);
            self.truth.visibilities_dropped = self.truth.visibilities_dropped.max(report.dropped);
        }
        for (unit, outcome) in pass.units.iter().zip(outcomes) {
            self.truth.frames_sent += 1;
            self.truth.frames_recoverable += u64::from(outcome.good > 0);
            self.truth.copies_duplicate += u64::from(outcome.good.saturating_sub(1));
            if let (0, Some(fate), Some((channel, count))) = (outcome.good, outcome.fate, unit.frame) {
                self.truth.lose_frame(channel, count, fate);
            }
        }
        for packet in &pass.packets {
            self.truth.packets_sent += 1;
            self.truth.visibilities_sent += packet.visibilities;
            match packet.units.iter().map(|unit| outcomes[*unit].good).min().unwrap_or(0) {
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

/// Whether wrong bits cost a unit: more wrong bytes in a codeword than can be corrected, or any in a packet.
fn is_spoilt(flips: &[usize], code: Option<ReedSolomon>) -> bool {
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
