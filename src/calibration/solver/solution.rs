//! Solutions of a pass, in parts where gains jump.

use bincode::{Decode, Encode};
use serde::Serialize;

use super::agree::is_contradicted;
use super::config::SolverConfig;
use super::fit::unexplained;
use super::layout::ParameterLayout;
use super::robust_fit::{Fitted, Interval};
use super::stability::{Excess, jump_s};
use super::sums::ModelledBlock;
use super::verdict::VerdictInputs;
use crate::units::vector::Vec3;

/// Most parts that jumps divide an interval into.
const PARTS_MAX: usize = 8;

/// What became of the gain of a daughter in a channel.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Encode, Decode)]
#[serde(rename_all = "kebab-case")]
pub enum GainState {
    /// Known.
    Good,
    /// No data.
    NoData,
    /// Noise where a receiver that works would deliver signal, or an amplitude of almost nothing.
    Dead,
    /// Too little signal to tell, or a phase less well known than asked for.
    Uncertain,
    /// The iteration did not converge.
    NotConverged,
    /// The model is not that of the data: the solution leaves too much of the signal unexplained.
    PoorFit,
    /// Another position explains the data as well, or daughters contradict one another.
    Ambiguous,
    /// The gain changes within the interval by more than a phase may be uncertain.
    Unstable,
}

impl GainState {
    /// Its word in tables.
    #[must_use]
    pub fn word(self) -> &'static str {
        match self {
            Self::Good => "good",
            Self::NoData => "no-data",
            Self::Dead => "dead",
            Self::Uncertain => "uncertain",
            Self::NotConverged => "not-converged",
            Self::PoorFit => "poor-fit",
            Self::Ambiguous => "ambiguous",
            Self::Unstable => "unstable",
        }
    }
}

/// Gain of one daughter in one channel.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Encode, Decode)]
pub struct GainEstimate {
    /// Centre of the channel, Hz.
    pub frequency_hz: f64,
    /// Amplitude of the voltage gain.
    pub amplitude: f64,
    /// Standard deviation of its natural logarithm, with what residuals show beyond noise.
    pub amplitude_sigma: f64,
    /// Phase against the reference daughter, clock included, deg, -180 to 180.
    pub phase_deg: f64,
    /// Its standard deviation, deg, with what residuals show beyond noise: changes within the interval and errors of the model.
    pub phase_sigma_deg: f64,
    /// Root mean square change of the phase within the interval, deg; 0 where it may be noise.
    pub phase_scatter_deg: f64,
    /// Part of the daughter's signal that the solution leaves; 0 where it may be noise.
    pub unexplained: f64,
    /// Visibilities used.
    pub visibilities: u64,
    /// Left out as outliers.
    pub outliers: u64,
    /// What became of it.
    pub state: GainState,
}

/// What is known of one daughter.
#[derive(Clone, Debug, PartialEq, Serialize, Encode, Decode)]
pub struct DaughterEstimate {
    /// From 1.
    pub daughter: u32,
    /// Offset of the clock against the reference's, ns; 0 where it is not solved for.
    pub clock_ns: f64,
    /// Its standard deviation, ns.
    pub clock_sigma_ns: f64,
    /// Error of the positions in packets against the reference's: along the track, across it, away from the Moon, m.
    pub position_m: [f64; 3],
    /// Its standard deviations, m.
    pub position_sigma_m: [f64; 3],
    /// Gains by channel.
    pub gains: Vec<GainEstimate>,
}

/// Where outliers are.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Encode, Decode)]
pub struct OutlierParts {
    /// Part of the visibilities that are outliers, by channel and by sixtieth of the interval; not a number without any.
    pub by_channel_and_time: Vec<Vec<f64>>,
}

impl OutlierParts {
    /// Whether they are of so many channels.
    pub(in crate::calibration) fn is_of(&self, channels: usize) -> bool {
        let parts = &self.by_channel_and_time;
        parts.len() == channels && parts.iter().all(|times| times.len() == TIME_PARTS)
    }
}

/// Parts of an interval by which outliers are counted.
const TIME_PARTS: usize = 60;

/// The solution of a pass, or of a part of one.
#[derive(Clone, Debug, PartialEq, Serialize, Encode, Decode)]
pub struct PassSolution {
    /// Number of the pass in the data, from 0.
    pub pass: u64,
    /// Start of the data that it is of, s since the epoch.
    pub from_s: f64,
    /// Their end.
    pub until_s: f64,
    /// Whether it converged.
    pub converged: bool,
    /// Gauss-Newton iterations of the last round.
    pub iterations: usize,
    /// Visibilities used.
    pub visibilities: u64,
    /// Left out as outliers.
    pub outliers: u64,
    /// Mean squared residual of a part of a visibility in units of its noise: 1 for a perfect model.
    pub chi_square: f64,
    /// Part of the signal in each channel that errors of the model are; 0 where it may be noise.
    pub model_error: Vec<f64>,
    /// Daughter that phases are relative to, from 1: that of the settings, or another where that is dead or unstable.
    pub reference: u32,
    /// Whether a gain jumps where it begins, in the middle of a pass.
    pub begins_with_jump: bool,
    /// Whether the pass is one that tests and is in no map.
    pub is_held_out: bool,
    /// By daughter.
    pub daughters: Vec<DaughterEstimate>,
    /// Where outliers are.
    #[serde(skip)]
    pub outlier_parts: OutlierParts,
    /// Normal of each daughter's orbit, on ecliptic axes.
    #[serde(skip)]
    pub normal_hat: Vec<Vec3>,
}

impl PassSolution {
    /// Marks good gains of daughters and frequencies whose position may be another one.
    pub(super) fn doubt(&mut self, is_ambiguous: impl Fn(usize, f64) -> bool) {
        for (n, daughter) in self.daughters.iter_mut().enumerate() {
            for gain in &mut daughter.gains {
                if gain.state == GainState::Good && is_ambiguous(n, gain.frequency_hz) {
                    gain.state = GainState::Ambiguous;
                }
            }
        }
    }
}

/// Data of a pass.
pub struct PassData<'a> {
    /// Number of the pass.
    pub pass: u64,
    /// Interval, s since the epoch; its end is not part of it.
    pub span_s: [f64; 2],
    /// Visibilities with their model.
    pub blocks: &'a mut [ModelledBlock],
    /// Normal of each daughter's orbit.
    pub normal_hat: Vec<Vec3>,
}

/// Solves for the errors of daughters in channels of these frequencies, over one interval. Marks outliers in the blocks.
#[must_use]
pub fn solve_pass(config: &SolverConfig, frequencies_hz: &[f64], data: PassData<'_>) -> PassSolution {
    let position_m = vec![[0.0; 3]; data.normal_hat.len()];
    solve_from(config, frequencies_hz, data, &position_m)
}

/// [`solve_pass`] in parts: before and after each instant at which a gain jumps.
#[must_use]
pub fn solve_pass_in_parts(
    config: &SolverConfig,
    frequencies_hz: &[f64],
    data: PassData<'_>,
) -> Vec<PassSolution> {
    let PassData { pass, span_s, blocks, normal_hat } = data;
    let position_m = vec![[0.0; 3]; normal_hat.len()];
    let whole = interval_of(config, frequencies_hz, span_s, &position_m);
    let mut drifting = vec![false; position_m.len() * frequencies_hz.len()];
    let (parts, jumps) = loop {
        let (parts, jumps) = steady_parts(&whole, blocks, &drifting);
        // What jumps twice within a pass drifts.
        let again = (0..drifting.len()).filter(|k| jumps.iter().filter(|jump| *jump == k).count() > 1);
        let again: Vec<usize> = again.collect();
        if again.is_empty() {
            break (parts, jumps);
        }
        again.into_iter().for_each(|k| drifting[k] = true);
    };
    let suspects: Vec<bool> = (0..drifting.len()).map(|k| drifting[k] || jumps.contains(&k)).collect();
    let solution = |(k, span_s): (usize, [f64; 2])| {
        let interval = Interval { span_s, ..whole };
        let fitted = interval.fit(blocks, None);
        let solution =
            told(&interval, fitted, blocks, &suspects).solution(&interval, (pass, normal_hat.clone()));
        PassSolution { begins_with_jump: k > 0, ..solution }
    };
    parts.into_iter().enumerate().map(solution).collect()
}

/// Parts of an interval between jumps, and which gains jump: by channel, then daughter, once for each jump.
fn steady_parts(
    whole: &Interval<'_>,
    blocks: &mut [ModelledBlock],
    drifting: &[bool],
) -> (Vec<[f64; 2]>, Vec<usize>) {
    // Intervals in the order of time, the next one last.
    let (mut open, mut steady, mut jumps) = (vec![whole.span_s], Vec::new(), Vec::new());
    while let Some(span_s) = open.pop() {
        let interval = Interval { span_s, ..*whole };
        let has_room = steady.len() + open.len() + 2 <= PARTS_MAX;
        let fitted = has_room.then(|| interval.fit(blocks, None));
        match fitted.and_then(|fitted| jump_of(&interval, &fitted, (&*blocks, drifting))) {
            Some((at_s, gains)) => {
                jumps.extend(gains);
                open.extend([[at_s, span_s[1]], [span_s[0], at_s]]);
            }
            None => steady.push(span_s),
        }
    }
    (steady, jumps)
}

fn interval_of<'a>(
    config: &'a SolverConfig,
    frequencies_hz: &'a [f64],
    span_s: [f64; 2],
    position_m: &'a [[f64; 3]],
) -> Interval<'a> {
    Interval { config, frequencies_hz, satellites: position_m.len(), span_s, position_m }
}

/// Instant of the largest jump of a gain, if one jumps, and which gains jump then.
fn jump_of(
    interval: &Interval<'_>,
    fitted: &Fitted,
    (blocks, drifting): (&[ModelledBlock], &[bool]),
) -> Option<(f64, Vec<usize>)> {
    let (daughter, channels) =
        interval.residuals(fitted, blocks, Some(interval.config.outlier_sigma)).jumping(drifting)?;
    let Fitted { layout, found, spreads, takes_part, .. } = fitted;
    let which = (interval.config.outlier_sigma, daughter, &channels[..]);
    let at_s = jump_s(layout, &found.values, blocks, (spreads, takes_part), interval.span_s, which)?;
    Some((at_s, channels.into_iter().map(|c| c * layout.satellites + daughter).collect()))
}

/// [`solve_pass`] that begins with daughters off by `position_m`.
pub(super) fn solve_from(
    config: &SolverConfig,
    frequencies_hz: &[f64],
    data: PassData<'_>,
    position_m: &[[f64; 3]],
) -> PassSolution {
    let PassData { pass, span_s, blocks, normal_hat } = data;
    let interval = interval_of(config, frequencies_hz, span_s, position_m);
    let fitted = interval.fit(blocks, None);
    let suspects = vec![false; fitted.dropped.len()];
    told(&interval, fitted, blocks, &suspects).solution(&interval, (pass, normal_hat))
}

/// A fit, and what its residuals show.
struct CheckedFit {
    fitted: Fitted,
    excess: Vec<Excess>,
    model_error: Vec<f64>,
    unexplained: Vec<f64>,
    counts: Counts,
}

/// Judges a fit; with a reference that is not steady, phases are solved for once more against another daughter.
fn told(
    interval: &Interval<'_>,
    mut fitted: Fitted,
    blocks: &mut [ModelledBlock],
    suspects: &[bool],
) -> CheckedFit {
    let (mut excess, mut model_error) = interval.residuals(&fitted, blocks, None).excess(suspects);
    if let Some(steady) = steadier(interval.config, &fitted, &excess) {
        fitted = interval.fit(blocks, Some(steady));
        (excess, model_error) = interval.residuals(&fitted, blocks, None).excess(suspects);
    }
    let unexplained = unexplained(&fitted, blocks, interval.span_s, interval.config.unexplained_max);
    let counts = Counts::of(blocks, interval.span_s, &fitted);
    CheckedFit { fitted, excess, model_error, unexplained, counts }
}

/// Another daughter to be the reference, seen and steady in all channels, if the one of a fit changes too much.
fn steadier(config: &SolverConfig, fitted: &Fitted, excess: &[Excess]) -> Option<usize> {
    let layout = &fitted.layout;
    let n = layout.satellites;
    let most = config.phase_sigma_deg_max.to_radians().powi(2);
    let is_steady =
        |daughter: usize| (0..layout.channels()).all(|c| excess[c * n + daughter].scatter[1] <= most);
    let channels = |daughter: usize| (0..layout.channels()).filter(|c| fitted.is_seen(*c, daughter)).count();
    let reference = layout.reference;
    if is_steady(reference) {
        return None;
    }
    (0..n).find(|daughter| is_steady(*daughter) && channels(*daughter) == channels(reference))
}

impl CheckedFit {
    fn solution(self, interval: &Interval<'_>, (pass, normal_hat): (u64, Vec<Vec3>)) -> PassSolution {
        let Self { fitted, excess, model_error, unexplained, counts } = &self;
        let (config, Fitted { layout, found, .. }) = (interval.config, fitted);
        let (square, count) =
            fitted.chi_squares.iter().fold((0.0, 0.0), |(a, b), (square, count)| (a + square, b + count));
        let doubted = layout.terms() > 1
            && found.converged
            && config.unexplained_max < 1.0
            && is_contradicted(layout, found, &fitted.used());
        let judge = VerdictInputs { config, fitted, counts, unexplained, excess };
        let mut solution = PassSolution {
            pass,
            from_s: interval.span_s[0],
            until_s: interval.span_s[1],
            converged: found.converged,
            iterations: found.iterations,
            visibilities: counts.used,
            outliers: counts.out,
            chi_square: if count > 0.0 { square / (2.0 * count) } else { f64::NAN },
            model_error: model_error.clone(),
            reference: layout.reference as u32 + 1,
            begins_with_jump: false,
            is_held_out: false,
            outlier_parts: counts.parts(),
            daughters: judge.daughters(),
            normal_hat,
        };
        if doubted {
            solution.doubt(|n, _| n != layout.reference);
        }
        solution
    }
}

/// Visibilities by channel and daughter.
pub(super) struct Counts {
    used: u64,
    out: u64,
    pub(super) by_gain: Vec<[u64; 2]>,
    /// By channel and part of the interval: all, and outliers.
    by_time: Vec<[[u64; 2]; TIME_PARTS]>,
}

impl Counts {
    fn of(blocks: &[ModelledBlock], [from_s, until_s]: [f64; 2], fitted: &Fitted) -> Self {
        let layout: &ParameterLayout = &fitted.layout;
        let gains = layout.satellites * layout.frequencies_hz.len();
        let by_time = vec![[[0; 2]; TIME_PARTS]; layout.frequencies_hz.len()];
        let mut counts = Self { used: 0, out: 0, by_gain: vec![[0; 2]; gains], by_time };
        for (block, takes_part) in blocks.iter().zip(&fitted.takes_part) {
            let inside = (0..block.time_s.len()).filter(|&k| (from_s..until_s).contains(&block.time_s[k]));
            if !takes_part {
                // They count for who is left out alone.
                let of = |n: u8| block.channel * layout.satellites + usize::from(n);
                let left_out =
                    [of(block.pair.i), of(block.pair.j)].into_iter().filter(|k| fitted.dropped[*k]);
                let count = inside.count() as u64;
                left_out.for_each(|k| counts.by_gain[k][0] += count);
                continue;
            }
            for k in inside.clone() {
                let part = (block.time_s[k] - from_s) / (until_s - from_s) * TIME_PARTS as f64;
                let [all, out] = &mut counts.by_time[block.channel][(part as usize).min(TIME_PARTS - 1)];
                (*all, *out) = (*all + 1, *out + u64::from(block.is_out[k]));
            }
            let (out, used): (Vec<usize>, Vec<usize>) = inside.partition(|&k| block.is_out[k]);
            let (used, out) = (used.len() as u64, out.len() as u64);
            (counts.used, counts.out) = (counts.used + used, counts.out + out);
            for n in [block.pair.i, block.pair.j] {
                let gain = &mut counts.by_gain[block.channel * layout.satellites + usize::from(n)];
                *gain = [gain[0] + used, gain[1] + out];
            }
        }
        counts
    }

    fn parts(&self) -> OutlierParts {
        let row = |times: &[[u64; 2]; TIME_PARTS]| {
            times.iter().map(|[all, out]| *out as f64 / *all as f64).collect::<Vec<f64>>()
        };
        OutlierParts { by_channel_and_time: self.by_time.iter().map(row).collect() }
    }
}
