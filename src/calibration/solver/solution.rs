//! Solutions of a pass, in parts where gains jump.

use bincode::{Decode, Encode};
use serde::Serialize;

use super::agree::is_contradicted;
use super::config::SolverConfig;
use super::estimates::{Counts, DaughterEstimate, GainState, OutlierParts};
use super::fit::{Unexplained, unexplained};
use super::robust_fit::{Fitted, Interval};
use super::stability::{Excess, jump_s};
use super::sums::ModelledBlock;
use super::verdict::VerdictInputs;
use crate::units::vector::Vec3;

/// Most parts that jumps divide an interval into.
const PARTS_MAX: usize = 8;

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
    pub(super) fn mark_ambiguous(&mut self, is_ambiguous: impl Fn(usize, f64) -> bool) {
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
            check_fit(&interval, fitted, blocks, &suspects).solution(&interval, (pass, normal_hat.clone()));
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
    check_fit(&interval, fitted, blocks, &suspects).solution(&interval, (pass, normal_hat))
}

/// A fit, and what its residuals show.
struct CheckedFit {
    fitted: Fitted,
    excess: Vec<Excess>,
    model_error: Vec<f64>,
    unexplained: Unexplained,
    counts: Counts,
}

/// Judges a fit; with a reference that is not steady, phases are solved for once more against another daughter.
fn check_fit(
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
            solution.mark_ambiguous(|n, _| n != layout.reference);
        }
        solution
    }
}
