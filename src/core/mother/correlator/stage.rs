//! Correlator stage: from blocks of samples to frames for the ground.

use std::convert::Infallible;
use std::sync::{Arc, Mutex, PoisonError};

use pulp::Arch;

use super::align::{Aligner, AlignerCounts, BlockRow, StreamShape};
use super::autos::{AutoIntegrator, RowPowers};
use super::integrate::{COMPLETE_MIN, DumpRule, GroupIntegrator, Presence, WINDOW_S_MAX, dump_samples};
use super::kernel::{LANES, Packed, SLICE, correlate, no_sums};
use super::spectra::{Divider, Division, Spectra};
use crate::array::{Array, EarthOccultation};
use crate::daughters::{InstrumentErrors, PassErrors};
use crate::frames::{
    GroundFrame, Housekeeping, Instrument, ObservingWindow, SampleBlock, Samples, SpaceFrame, VisibilityBlock,
};
use crate::mother::Schedule;
use crate::mother::integrator::reported_ephemeris;
use crate::runtime::{Outlet, Stage, Units};
use crate::units::MissionTime;

/// Fraction of a block's values out of range above which its visibilities are flagged. A 2-bit quantiser clips 5 % by
/// design.
const SATURATED_MAX: f64 = 0.2;

/// Averaging time of the powers that determine weights, s; until it has passed, the mean of all samples is used.
const POWER_TIME_S: f64 = 10.0;

/// Samples of a window after which powers are accurate enough for weights, whose mean bias is then 2 / n.
const POWER_SAMPLES_MIN: u64 = 1024;

/// Setup of [`Correlator`].
#[derive(Clone)]
pub struct CorrelatorSetup {
    /// The array, which gives the daughters' positions.
    pub array: Arc<Array>,
    /// Instrument description to be sent.
    pub instrument: Instrument,
    /// One schedule per channel or sub-band of the instrument.
    pub schedules: Vec<Schedule>,
    /// Delay centre and sub-bands.
    pub division: Division,
    /// Integration time of the auto-correlations, s; 0 for none.
    pub auto_integration_s: f64,
    /// Whether visibilities are flagged while the Earth is in sight of one of their daughters.
    pub flag_earth: bool,
    /// Samples per block.
    pub block_samples: usize,
    /// Number of blocks that may arrive after a missing one before it is given up.
    pub wait_blocks: u64,
}

/// Counters of the correlator, and the mean auto-correlations.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct CorrelatorCounts {
    /// Counts of blocks.
    pub blocks: AlignerCounts,
    /// Blocks outside any window.
    pub stray: u64,
    /// Samples of the stray blocks.
    pub stray_samples: u64,
    /// Number of visibilities emitted.
    pub visibilities: u64,
    /// Sum of |x|^2 (K sr) and number of samples, by channel or sub-band and daughter.
    pub autos: Vec<Vec<(f64, u64)>>,
}

/// Aligns the daughters' streams, correlates all pairs in all channels, and integrates each for as long as the
/// baseline's motion allows.
///
/// Integrations are whole dumps, so they are up to an eighth shorter than the rule allows. A visibility is
/// the mean over the n samples that arrived from both daughters, its weight `2 n / (P_i P_j)` with the measured
/// auto-correlations P. It is flagged when less than 0.9 of its samples arrived.
pub struct Correlator {
    setup: CorrelatorSetup,
    rule: DumpRule,
    /// Delays and sub-bands, if there are any.
    divider: Option<Divider>,
    arch: Arch,
    running: Option<OpenWindow>,
    counts: Arc<Mutex<CorrelatorCounts>>,
    sampled: u64,
    samples: u64,
    /// Errors of the positions and times in packets.
    errors: Option<Arc<InstrumentErrors>>,
}

/// The window being correlated.
struct OpenWindow {
    window: ObservingWindow,
    /// Errors of the positions and times in packets.
    pass: Option<PassErrors>,
    aligner: Aligner,
    groups: Vec<ChannelGroup>,
    /// A row held until the next one arrives, which contains its delayed samples.
    held: Option<BlockRow>,
}

struct ChannelGroup {
    first: usize,
    integrator: GroupIntegrator,
    /// Integrator of auto-correlations, if they are configured.
    autos: Option<AutoIntegrator>,
    packed: Packed,
    /// By daughter and lane: running auto-correlation, K sr; 0 before the first block.
    powers: Vec<[f64; LANES]>,
    /// By daughter and lane: samples received so far.
    seen: Vec<[u64; LANES]>,
    /// Samples of the window so far.
    samples: u64,
}

impl Correlator {
    /// Creates a correlator that updates `counts` while it runs.
    #[must_use]
    pub fn new(setup: CorrelatorSetup, counts: Arc<Mutex<CorrelatorCounts>>) -> Self {
        let width_hz = setup.instrument.channels.first().map_or(1.0, |channel| channel.width_hz);
        let bands = setup.division.sub_bands.max(1);
        let dump = dump_samples(&setup.array, &setup.schedules, width_hz * bands as f64, bands);
        let rule = DumpRule { dump_samples: dump / bands, width_hz, complete_min: COMPLETE_MIN };
        let divider = (setup.division != Division::NONE).then(|| Divider::new(setup.division));
        lock(&counts).autos = vec![vec![(0.0, 0); setup.array.satellites()]; setup.schedules.len()];
        Self {
            setup,
            rule,
            divider,
            arch: Arch::new(),
            running: None,
            counts,
            sampled: 0,
            samples: 0,
            errors: None,
        }
    }

    /// Adds errors of the positions and times in packets.
    #[must_use]
    pub fn with_errors(self, errors: Option<Arc<InstrumentErrors>>) -> Self {
        Self { errors, ..self }
    }

    /// Rate of the daughters' samples, Hz.
    fn rate_hz(&self) -> f64 {
        self.rule.width_hz * self.setup.division.sub_bands as f64
    }

    fn begin(&mut self, mut window: ObservingWindow, out: &mut Outlet<GroundFrame>) {
        let rate_hz = self.rate_hz();
        let Self { setup, rule, errors, .. } = self;
        let pass = errors.as_ref().map(|errors| errors.pass(window));
        // A window is a third of an orbit; longer ones are cut to the range of time tags.
        let end = MissionTime::from_seconds(window.start.seconds() + WINDOW_S_MAX);
        window.end = window.end.min(end);
        out.push(GroundFrame::Instrument(setup.instrument.clone()));
        for segment in reported_ephemeris(&setup.array, window, pass.as_ref()) {
            out.push(GroundFrame::Ephemeris(segment));
        }
        let streams = StreamShape {
            daughters: setup.array.satellites(),
            channels: setup.schedules.len() / setup.division.sub_bands,
            block_samples: setup.block_samples,
            width_hz: rate_hz,
            wait_blocks: setup.wait_blocks,
        };
        let aligner = Aligner::new(streams, window);
        let dumps = aligner.samples() / (rule.dump_samples * setup.division.sub_bands) as u64;
        let earth_occultation = setup.flag_earth.then(|| EarthOccultation::new(&setup.array, window));
        let group = |(k, schedules): (usize, &[Schedule])| ChannelGroup {
            first: k * LANES,
            integrator: GroupIntegrator::new(k * LANES, schedules, *rule, &setup.array, window, dumps)
                .with_earth_occultation(earth_occultation.clone()),
            autos: (setup.auto_integration_s > 0.0).then(|| {
                let (daughters, integration_s) = (streams.daughters, setup.auto_integration_s);
                AutoIntegrator::new(k * LANES, schedules.len(), daughters, window, integration_s)
                    .with_earth_occultation(earth_occultation.clone())
            }),
            packed: Packed::new(streams.daughters),
            powers: vec![[0.0; LANES]; streams.daughters],
            seen: vec![[0; LANES]; streams.daughters],
            samples: 0,
        };
        let groups = setup.schedules.chunks(LANES).enumerate().map(group).collect();
        self.running = Some(OpenWindow { window, pass, aligner, groups, held: None });
    }

    /// Accepts the next row of a window; with delays, processes the row before it.
    fn accept(&mut self, running: &mut OpenWindow, row: BlockRow, out: &mut Outlet<GroundFrame>) {
        if self.setup.division.delay_centre.is_none() {
            self.process(running, &row, None, out);
        } else if let Some(held) = running.held.replace(row) {
            let next = running.held.take();
            self.process(running, &held, next.as_ref(), out);
            running.held = next;
        }
    }

    fn process(
        &mut self,
        running: &mut OpenWindow,
        row: &BlockRow,
        next: Option<&BlockRow>,
        out: &mut Outlet<GroundFrame>,
    ) {
        let mut blocks = Vec::new();
        let rate_hz = self.rate_hz();
        let spectra = self.divider.as_ref().map(|divider| {
            let ticks = crate::daughters::sample_ticks(row.number * self.setup.block_samples as u64, rate_hz);
            let t_s = running.window.start.plus_ticks(ticks).seconds();
            let delays = self.setup.division.delays(&self.setup.array, t_s, rate_hz);
            divider.divide(row, next, self.setup.array.satellites(), delays)
        });
        for (index, group) in running.groups.iter_mut().enumerate() {
            match &spectra {
                Some(spectra) => self.process_spectra(group, row, spectra, index, &mut blocks),
                None => self.process_group(group, row, &mut blocks),
            }
        }
        self.samples += row.blocks.iter().flatten().map(|block| block.samples.len() as u64).sum::<u64>();
        self.emit(blocks, running.pass.as_ref(), out);
    }

    fn process_group(&self, group: &mut ChannelGroup, row: &BlockRow, blocks: &mut Vec<VisibilityBlock>) {
        let daughters = self.setup.array.satellites();
        let channels = LANES.min(self.setup.schedules.len() - group.first);
        let first = group.first;
        let block = |lane: usize, daughter: usize| -> Option<&SampleBlock> {
            row.blocks.get((first + lane) * daughters + daughter)?.as_ref()
        };
        let dump_samples = self.rule.dump_samples;
        let mut present = vec![[0; LANES]; daughters];
        let mut saturated = vec![[false; LANES]; daughters];
        let mut sums = vec![[(0.0, 0); LANES]; daughters];
        for (daughter, sums) in sums.iter_mut().enumerate() {
            for (lane, sum) in sums[..channels].iter_mut().enumerate() {
                let Some(block) = block(lane, daughter) else { continue };
                present[daughter][lane] = dump_samples as u32;
                saturated[daughter][lane] = is_saturated(block);
                *sum = (power_sum(&block.samples), row.samples as u64);
            }
        }
        let samples = row.samples as u64;
        let powers = RowPowers { sums, samples, saturated: saturated.clone() };
        self.update_powers(group, row, &powers, blocks);
        let count_of_pair =
            |i: usize, j: usize| std::array::from_fn(|lane| present[i][lane].min(present[j][lane]));
        let common = (0..daughters).flat_map(|j| (0..=j).map(move |i| count_of_pair(i, j))).collect();
        let presence = Presence { common, saturated };
        for dump in 0..row.samples / dump_samples {
            let mut sums = no_sums(daughters);
            for slice in 0..dump_samples / SLICE {
                let first = dump * dump_samples + slice * SLICE;
                for daughter in 0..daughters {
                    let samples =
                        |lane: usize| (lane < channels).then(|| block(lane, daughter))?.map(|b| &b.samples);
                    group.packed.put_all(daughter, samples, first);
                }
                correlate(self.arch, &group.packed, &mut sums);
            }
            group.integrator.add(&sums, &presence, &group.powers, &self.setup.array, blocks);
        }
    }

    /// Processes group `index` of the spectra of a row.
    fn process_spectra(
        &self,
        group: &mut ChannelGroup,
        row: &BlockRow,
        spectra: &Spectra,
        index: usize,
        blocks: &mut Vec<VisibilityBlock>,
    ) {
        let daughters = self.setup.array.satellites();
        let lanes = LANES.min(self.setup.schedules.len() - group.first);
        let bands = self.setup.division.sub_bands;
        let mut saturated = vec![[false; LANES]; daughters];
        for (daughter, saturated) in saturated.iter_mut().enumerate() {
            for (lane, saturated) in saturated[..lanes].iter_mut().enumerate() {
                let block = row.blocks.get((group.first + lane) / bands * daughters + daughter);
                *saturated = block.and_then(Option::as_ref).is_some_and(is_saturated);
            }
        }
        let (sums, samples) = (spectra.powers(index), spectra.frames as u64);
        let powers = RowPowers { sums, samples, saturated: saturated.clone() };
        self.update_powers(group, row, &powers, blocks);
        let dump = self.rule.dump_samples;
        for number in 0..spectra.frames / dump {
            let mut sums = no_sums(daughters);
            let common = spectra.correlate(index, number * dump..(number + 1) * dump, &mut sums);
            let presence = Presence { common, saturated: saturated.clone() };
            group.integrator.add(&sums, &presence, &group.powers, &self.setup.array, blocks);
        }
    }

    /// Updates the running auto-correlations of a group from a row, integrates and counts them.
    fn update_powers(
        &self,
        group: &mut ChannelGroup,
        row: &BlockRow,
        powers: &RowPowers,
        blocks: &mut Vec<VisibilityBlock>,
    ) {
        if let Some(autos) = &mut group.autos {
            let samples = row.number * self.setup.block_samples as u64 + row.samples as u64;
            let ticks = crate::daughters::sample_ticks(samples, self.rate_hz()) as u32;
            autos.add(powers, ticks, blocks);
        }
        let smoothing = 1.0 - (-(row.samples as f64) / self.rate_hz() / POWER_TIME_S).exp();
        let lanes = LANES.min(self.setup.schedules.len() - group.first);
        let mut counts = lock(&self.counts);
        for (daughter, sums) in powers.sums.iter().enumerate() {
            for (lane, &(sum, count)) in sums[..lanes].iter().enumerate() {
                if count == 0 {
                    continue;
                }
                let (power, seen) = (&mut group.powers[daughter][lane], &mut group.seen[daughter][lane]);
                *seen += count;
                let share = smoothing.max(count as f64 / *seen as f64);
                *power += share * (sum / count as f64 - *power);
                let own = &mut counts.autos[group.first + lane][daughter];
                own.0 += sum;
                own.1 += count;
            }
        }
        drop(counts);
        group.samples += powers.samples;
        if group.samples >= POWER_SAMPLES_MIN {
            group.integrator.set_powers_known(&group.powers);
        }
    }

    fn emit(
        &mut self,
        blocks: Vec<VisibilityBlock>,
        pass: Option<&PassErrors>,
        out: &mut Outlet<GroundFrame>,
    ) {
        for mut block in blocks {
            if let Some(pass) = pass {
                pass.tag(&mut block);
            }
            self.sampled += block.len() as u64;
            out.push(GroundFrame::Visibilities(block));
        }
    }

    /// Ends the running window at `end`.
    fn end(&mut self, end: MissionTime, out: &mut Outlet<GroundFrame>) {
        let Some(mut running) = self.running.take() else { return };
        let seconds = (end.0 - running.window.start.0) as f64 * 1e-6;
        for row in running.aligner.finish((seconds * self.rate_hz()).round().max(0.0) as u64) {
            self.accept(&mut running, row, out);
        }
        if let Some(last) = running.held.take() {
            self.process(&mut running, &last, None, out);
        }
        let mut blocks = Vec::new();
        for group in &mut running.groups {
            group.integrator.finish(&group.powers, &mut blocks);
            if let Some(autos) = &mut group.autos {
                let ticks = (end.0 - running.window.start.0).clamp(0, i64::from(u32::MAX));
                autos.finish(ticks as u32, &mut blocks);
            }
        }
        self.emit(blocks, running.pass.as_ref(), out);
        let mut counts = lock(&self.counts);
        counts.blocks.add(running.aligner.counts());
        counts.visibilities = self.sampled;
        drop(counts);
        let (time, sampled) = (end, self.sampled);
        out.push(GroundFrame::Housekeeping(Housekeeping { time, sampled, dropped: 0 }));
    }
}

fn lock(counts: &Mutex<CorrelatorCounts>) -> std::sync::MutexGuard<'_, CorrelatorCounts> {
    counts.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Whether too many of a block's values are out of range.
fn is_saturated(block: &SampleBlock) -> bool {
    f64::from(block.saturated) > SATURATED_MAX * (2 * block.samples.len()) as f64
}

/// Sum of |x|^2, K sr.
fn power_sum(samples: &Samples) -> f64 {
    match samples {
        Samples::Float { re, im } => re.iter().zip(im).map(|(re, im)| f64::from(re * re + im * im)).sum(),
        Samples::Codes { step, re, im, .. } => {
            // (c + 1/2)^2 = c (c + 1) + 1/4, in integers.
            let whole: i64 = re.chunks(CODES_AT_ONCE).chain(im.chunks(CODES_AT_ONCE)).map(code_squares).sum();
            f64::from(*step).powi(2) * (whole as f64 + 0.25 * (re.len() + im.len()) as f64)
        }
    }
}

/// Number of codes whose squares, at most 2^14 each, are summed in 32 bits.
const CODES_AT_ONCE: usize = 1 << 16;

/// Sum of c (c + 1).
#[multiversion::multiversion(targets(
    "x86_64+avx512f+avx512vl+avx512bw+avx512dq",
    "x86_64+avx2",
    "aarch64+neon"
))]
fn code_squares(codes: &[i8]) -> i64 {
    let mut sum = 0_i32;
    for &code in codes {
        let code = i32::from(code);
        sum += code * (code + 1);
    }
    i64::from(sum)
}

impl Stage for Correlator {
    type In = SpaceFrame;
    type Out = GroundFrame;
    type Error = Infallible;

    fn step(&mut self, frame: SpaceFrame, out: &mut Outlet<GroundFrame>) -> Result<(), Infallible> {
        match frame {
            SpaceFrame::WindowStart(window) => {
                // A window whose end was lost ends where the next one begins, at the latest.
                self.finish(out)?;
                self.begin(window, out);
            }
            SpaceFrame::Samples(blocks) => {
                let Some(mut running) = self.running.take() else {
                    let mut counts = lock(&self.counts);
                    counts.stray += blocks.len() as u64;
                    counts.stray_samples +=
                        blocks.iter().map(|block| block.samples.len() as u64).sum::<u64>();
                    return Ok(());
                };
                for block in blocks {
                    for row in running.aligner.put(block) {
                        self.accept(&mut running, row, out);
                    }
                }
                self.running = Some(running);
            }
            SpaceFrame::WindowEnd(window) => self.end(window.end, out),
        }
        Ok(())
    }

    fn finish(&mut self, out: &mut Outlet<GroundFrame>) -> Result<(), Infallible> {
        if let Some(running) = &self.running {
            let end = running.window.end;
            self.end(end, out);
        }
        Ok(())
    }

    fn units(&self) -> Units {
        Units::of(self.samples, "samples")
    }
}
