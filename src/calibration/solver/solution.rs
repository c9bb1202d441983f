//! Solutions of a pass: robust rounds about Gauss-Newton, and what is told of them.

use bincode::{Decode, Encode};
use rayon::prelude::*;
use serde::Serialize;

use super::agree::is_contradicted;
use super::config::SolverConfig;
use super::fit::unexplained;
use super::layout::ParameterLayout;
use super::newton::Found;
use super::robust::judge;
use super::sums::{ModelledBlock, PairSums};
use crate::units::vector::Vec3;

/// Change of a pair's spread below which a round settles.
const SPREAD_SETTLED: f64 = 0.02;

/// What became of the gain of a daughter in a channel.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Encode, Decode)]
#[serde(rename_all = "kebab-case")]
pub enum GainState {
    /// Known.
    Good,
    /// No data.
    NoData,
    /// An amplitude of almost nothing.
    Dead,
    /// A phase less well known than asked for.
    Uncertain,
    /// The iteration did not converge.
    NotConverged,
    /// The solution leaves too much of the signal unexplained: a wrong minimum.
    PoorFit,
    /// Another position explains the data as well, or daughters contradict one another.
    Ambiguous,
}

/// Gain of one daughter in one channel.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Encode, Decode)]
pub struct GainEstimate {
    /// Centre of the channel, Hz.
    pub frequency_hz: f64,
    /// Amplitude of the voltage gain.
    pub amplitude: f64,
    /// Standard deviation of its natural logarithm.
    pub amplitude_sigma: f64,
    /// Phase against the reference daughter, clock included, deg, -180 to 180.
    pub phase_deg: f64,
    /// Its standard deviation, deg.
    pub phase_sigma_deg: f64,
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

/// [`solve_pass`] that begins with daughters off by `position_m`.
pub(super) fn solve_from(
    config: &SolverConfig,
    frequencies_hz: &[f64],
    data: PassData<'_>,
    position_m: &[[f64; 3]],
) -> PassSolution {
    let PassData { pass, span_s, blocks, normal_hat } = data;
    let layout = ParameterLayout::new(config, normal_hat.len(), frequencies_hz);
    let mut spreads = vec![1.0; blocks.len()];
    blocks.par_iter_mut().for_each(|block| block.is_out.fill(false));
    let mut sums = sums_of(blocks, span_s, &layout, &spreads);
    let mut found =
        layout.minimise(layout.start(&sums, position_m), &sums, None, config.iterations_max as usize);
    let mut chi_squares = vec![(0.0, 0.0); blocks.len()];
    for round in 0..=config.outlier_rounds {
        let judge = |((block, spread), sums): ((&mut ModelledBlock, &mut f64), &PairSums)| {
            let before = (block.is_out.clone(), *spread);
            let (gain, u) = layout.pair(&found.values, sums.channel, sums.pair);
            let chi_square = judge(block, span_s, config.outlier_sigma, gain, &u, spread);
            let changed = block.is_out != before.0 || (*spread / before.1 - 1.0).abs() > SPREAD_SETTLED;
            (chi_square, changed)
        };
        let judged: Vec<((f64, f64), bool)> =
            blocks.par_iter_mut().zip(&mut spreads).zip(&sums).map(judge).collect();
        let changed = judged.iter().any(|(_, changed)| *changed);
        chi_squares = judged.into_iter().map(|(chi_square, _)| chi_square).collect();
        if !changed || round == config.outlier_rounds {
            break;
        }
        sums = sums_of(blocks, span_s, &layout, &spreads);
        found = layout.minimise(found.values, &sums, None, config.iterations_max as usize);
    }
    let (square, count) =
        chi_squares.iter().fold((0.0, 0.0), |(a, b), (square, count)| (a + square, b + count));
    let counts = Counts::of(blocks, span_s, &layout);
    let unexplained = match layout.terms() {
        1 => vec![0.0; layout.satellites * layout.channels()],
        _ => unexplained(&layout, &found, blocks, config.unexplained_max),
    };
    let doubted = layout.terms() > 1
        && found.converged
        && config.unexplained_max < 1.0
        && is_contradicted(&layout, &found, &sums);
    let told = |n: usize| daughter(config, &layout, (&found, &counts, &unexplained), n);
    let mut solution = PassSolution {
        pass,
        from_s: span_s[0],
        until_s: span_s[1],
        converged: found.converged,
        iterations: found.iterations,
        visibilities: counts.used,
        outliers: counts.out,
        chi_square: if count > 0.0 { square / (2.0 * count) } else { f64::NAN },
        is_held_out: false,
        outlier_parts: counts.parts(),
        daughters: (0..layout.satellites).map(told).collect(),
        normal_hat,
    };
    if doubted {
        solution.doubt(|n, _| n != layout.reference);
    }
    solution
}

pub(super) fn sums_of(
    blocks: &[ModelledBlock],
    span_s: [f64; 2],
    layout: &ParameterLayout,
    spreads: &[f64],
) -> Vec<PairSums> {
    let of = |(block, spread): (&ModelledBlock, &f64)| PairSums::of(block, span_s, layout.terms(), *spread);
    blocks.par_iter().zip(spreads).map(of).collect()
}

/// Visibilities by channel and daughter.
struct Counts {
    used: u64,
    out: u64,
    by_gain: Vec<[u64; 2]>,
    /// By channel and part of the interval: all, and outliers.
    by_time: Vec<[[u64; 2]; TIME_PARTS]>,
}

impl Counts {
    fn of(blocks: &[ModelledBlock], [from_s, until_s]: [f64; 2], layout: &ParameterLayout) -> Self {
        let gains = layout.satellites * layout.frequencies_hz.len();
        let by_time = vec![[[0; 2]; TIME_PARTS]; layout.frequencies_hz.len()];
        let mut counts = Self { used: 0, out: 0, by_gain: vec![[0; 2]; gains], by_time };
        for block in blocks {
            let inside = (0..block.time_s.len()).filter(|&k| (from_s..until_s).contains(&block.time_s[k]));
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

fn daughter(
    config: &SolverConfig,
    layout: &ParameterLayout,
    (found, counts, unexplained): (&Found, &Counts, &[f64]),
    n: usize,
) -> DaughterEstimate {
    let order = layout.order();
    let covariance = |a: Option<usize>, b: Option<usize>| match (a, b) {
        (Some(a), Some(b)) => found.covariance[a * order + b],
        _ => 0.0,
    };
    let sigma = |place: Option<usize>| covariance(place, place).sqrt();
    let values = &found.values;
    let gain = |c: usize| {
        let (phase, clock) = (layout.phase(c, n), layout.clock(n));
        // Of the sum of the phase and what the clock turns.
        let per_ns = layout.per_ns(c);
        let variance = covariance(phase, phase)
            + 2.0 * per_ns * covariance(phase, clock)
            + per_ns * per_ns * covariance(clock, clock);
        let gain = layout.gain(values, c, n);
        let [visibilities, outliers] = counts.by_gain[c * layout.satellites + n];
        let phase_sigma_deg = variance.max(0.0).sqrt().to_degrees();
        let state = match () {
            () if visibilities == 0 => GainState::NoData,
            () if !found.converged => GainState::NotConverged,
            () if gain.norm() < config.dead_amplitude => GainState::Dead,
            () if phase_sigma_deg > config.phase_sigma_deg_max => GainState::Uncertain,
            () if unexplained[c * layout.satellites + n] > config.unexplained_max => GainState::PoorFit,
            () => GainState::Good,
        };
        GainEstimate {
            frequency_hz: layout.frequencies_hz[c],
            amplitude: gain.norm(),
            amplitude_sigma: sigma(layout.amplitude(c, n)),
            phase_deg: gain.arg().to_degrees(),
            phase_sigma_deg,
            visibilities,
            outliers,
            state,
        }
    };
    DaughterEstimate {
        daughter: n as u32 + 1,
        clock_ns: values.clock_ns[n],
        clock_sigma_ns: sigma(layout.clock(n)),
        position_m: values.position_m[n],
        position_sigma_m: [0, 1, 2].map(|axis| sigma(layout.position(n, axis))),
        gains: (0..layout.frequencies_hz.len()).map(gain).collect(),
    }
}
