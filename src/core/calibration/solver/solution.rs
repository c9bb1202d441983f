//! Solutions of a pass, divided where gains jump.

use bincode::{Decode, Encode};
use serde::Serialize;

use super::agree::is_contradicted;
use super::assessment::GainAssessment;
use super::config::SolverConfig;
use super::estimates::{Counts, DaughterEstimate, GainState, OutlierFractions};
use super::fit::{Unexplained, unexplained};
use super::robust_fit::{Interval, RobustFit};
use super::stability::{Excess, jump_s};
use super::sums::{ModelledBlock, PairSums};
use super::verdict::{ModelVerdict, common_amplitudes, model_verdict};
use crate::units::vector::Vec3;

/// Maximum number of parts that jumps divide an interval into.
const PARTS_MAX: usize = 8;

/// The solution of a pass, or of a part of one.
#[derive(Clone, Debug, PartialEq, Serialize, Encode, Decode)]
pub struct PassSolution {
    /// Number of the pass in the data, from 0.
    pub pass: u64,
    /// Start of its data, s since the epoch.
    pub from_s: f64,
    /// End of its data, s since the epoch.
    pub until_s: f64,
    /// Whether the iteration converged.
    pub converged: bool,
    /// Number of Gauss-Newton iterations of the last round.
    pub iterations: usize,
    /// Number of visibilities used.
    pub visibilities: u64,
    /// Number of visibilities left out as outliers.
    pub outliers: u64,
    /// Reduced chi-square: 1 for a perfect model.
    pub chi_square: f64,
    /// Fraction of the signal in each channel that is due to errors of the model; 0 where it may be noise.
    pub model_error: Vec<f64>,
    /// Verdict on the model of each channel.
    pub models: Vec<ModelVerdict>,
    /// Daughter that phases are relative to, from 1: the configured one, or another if that is dead or unstable.
    pub reference: u32,
    /// Whether the solution begins at a jump of a gain within a pass.
    pub begins_with_jump: bool,
    /// Whether the pass is held out of maps, to test them.
    pub is_held_out: bool,
    /// Estimates by daughter.
    pub daughters: Vec<DaughterEstimate>,
    /// Distribution of outliers over channels and time.
    #[serde(skip)]
    pub outlier_fractions: OutlierFractions,
    /// Normal of each daughter's orbit, on ecliptic axes.
    #[serde(skip)]
    pub normal_hat: Vec<Vec3>,
    /// Correlations of the errors of maps by gains, by channel: of ln amplitude and of phase, of daughter 2 with 1, 3 with 1, 3 with 2, and so on.
    #[serde(skip)]
    pub correlations: Vec<Vec<[f64; 2]>>,
}

impl PassSolution {
    /// Marks good gains as ambiguous where another position of the daughter explains the data as well.
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
    /// Interval, s since the epoch; excludes its end.
    pub span_s: [f64; 2],
    /// Visibilities with their model.
    pub blocks: &'a mut [ModelledBlock],
    /// Normal of each daughter's orbit.
    pub normal_hat: Vec<Vec3>,
}

/// Solves for the gains, clocks and positions of daughters in channels of these frequencies, over one interval. Marks
/// outliers in the blocks.
#[must_use]
pub fn solve_pass(config: &SolverConfig, frequencies_hz: &[f64], data: PassData<'_>) -> PassSolution {
    let position_m = vec![[0.0; 3]; data.normal_hat.len()];
    solve_from(config, frequencies_hz, data, &position_m)
}

/// Solves a pass in parts: before and after each instant at which a gain jumps.
#[must_use]
pub fn solve_pass_in_parts(
    config: &SolverConfig,
    frequencies_hz: &[f64],
    data: PassData<'_>,
) -> Vec<PassSolution> {
    let PassData { pass, span_s, blocks, normal_hat } = data;
    let position_m = vec![[0.0; 3]; normal_hat.len()];
    let full_interval = new_interval(config, frequencies_hz, span_s, &position_m);
    let mut drifting = vec![false; position_m.len() * frequencies_hz.len()];
    let (parts, jumps) = loop {
        let (parts, jumps) = divide_at_jumps(&full_interval, blocks, &drifting);
        // A gain that jumps twice within a pass drifts, and one that changes beside its jump.
        let changing = changing_in(&parts, &jumps, &full_interval, blocks);
        let is_drift = |k: &usize| changing[*k] || jumps.iter().filter(|jump| *jump == k).count() > 1;
        let newly: Vec<usize> = jumps.iter().copied().filter(is_drift).collect();
        if newly.is_empty() {
            break (parts, jumps);
        }
        newly.into_iter().for_each(|k| drifting[k] = true);
    };
    let suspects: Vec<bool> = (0..drifting.len()).map(|k| drifting[k] || jumps.contains(&k)).collect();
    let solution = |(k, span_s): (usize, [f64; 2])| {
        let interval = Interval { span_s, ..full_interval };
        let fitted = interval.fit(blocks, None);
        let solution =
            check_fit(&interval, fitted, blocks, &suspects).solution(&interval, (pass, normal_hat.clone()));
        PassSolution { begins_with_jump: k > 0, ..solution }
    };
    parts.into_iter().enumerate().map(solution).collect()
}

/// Divides an interval at jumps of gains; returns the parts, and the gains that jump: by channel, then daughter, once
/// for each jump.
fn divide_at_jumps(
    full_interval: &Interval<'_>,
    blocks: &mut [ModelledBlock],
    drifting: &[bool],
) -> (Vec<[f64; 2]>, Vec<usize>) {
    // Stack of intervals, the earliest last.
    let (mut stack, mut steady, mut jumps) = (vec![full_interval.span_s], Vec::new(), Vec::new());
    while let Some(span_s) = stack.pop() {
        let interval = Interval { span_s, ..*full_interval };
        let can_divide = steady.len() + stack.len() + 2 <= PARTS_MAX;
        let fitted = can_divide.then(|| interval.fit(blocks, None));
        match fitted.and_then(|fitted| largest_jump(&interval, &fitted, (&*blocks, drifting))) {
            Some((at_s, gains)) => {
                jumps.extend(gains);
                stack.extend([[at_s, span_s[1]], [span_s[0], at_s]]);
            }
            None => steady.push(span_s),
        }
    }
    (steady, jumps)
}

/// Whether each gain changes within a part; only looked at if there are jumps.
fn changing_in(
    parts: &[[f64; 2]],
    jumps: &[usize],
    full_interval: &Interval<'_>,
    blocks: &mut [ModelledBlock],
) -> Vec<bool> {
    let mut changing = vec![false; full_interval.satellites * full_interval.frequencies_hz.len()];
    let no_suspects = changing.clone();
    for span_s in parts.iter().filter(|_| !jumps.is_empty()) {
        let interval = Interval { span_s: *span_s, ..*full_interval };
        let fitted = interval.fit(blocks, None);
        let (excess, _) = interval.residuals(&fitted, blocks, None).excess(&no_suspects);
        for (changing, excess) in changing.iter_mut().zip(excess) {
            *changing |= excess.scatter != [0.0; 2];
        }
    }
    changing
}

fn new_interval<'a>(
    config: &'a SolverConfig,
    frequencies_hz: &'a [f64],
    span_s: [f64; 2],
    position_m: &'a [[f64; 3]],
) -> Interval<'a> {
    Interval { config, frequencies_hz, satellites: position_m.len(), span_s, position_m }
}

/// Instant of the largest jump of a gain, and the gains that jump then; `None` without a jump.
fn largest_jump(
    interval: &Interval<'_>,
    fitted: &RobustFit,
    (blocks, drifting): (&[ModelledBlock], &[bool]),
) -> Option<(f64, Vec<usize>)> {
    let (daughter, channels) =
        interval.residuals(fitted, blocks, Some(interval.config.outlier_sigma)).largest_jumping(drifting)?;
    let RobustFit { layout, newton, variance_factors, is_pair_used, .. } = fitted;
    let selection = (interval.config.outlier_sigma, daughter, &channels[..]);
    let at_s =
        jump_s(layout, &newton.values, blocks, (variance_factors, is_pair_used), interval.span_s, selection)?;
    Some((at_s, channels.into_iter().map(|c| c * layout.satellites + daughter).collect()))
}

/// Solves a pass, starting with daughters at offsets of `position_m`.
pub(super) fn solve_from(
    config: &SolverConfig,
    frequencies_hz: &[f64],
    data: PassData<'_>,
    position_m: &[[f64; 3]],
) -> PassSolution {
    let PassData { pass, span_s, blocks, normal_hat } = data;
    let interval = new_interval(config, frequencies_hz, span_s, position_m);
    let fitted = interval.fit(blocks, None);
    let suspects = vec![false; fitted.dropped_gains.len()];
    check_fit(&interval, fitted, blocks, &suspects).solution(&interval, (pass, normal_hat))
}

/// A fit, and the diagnostics of its residuals.
struct CheckedFit {
    fitted: RobustFit,
    excess: Vec<Excess>,
    model_error: Vec<f64>,
    unexplained: Unexplained,
    counts: Counts,
}

/// Diagnoses a fit. If the reference is not steady, solves once more with phases relative to another daughter.
fn check_fit(
    interval: &Interval<'_>,
    mut fitted: RobustFit,
    blocks: &mut [ModelledBlock],
    suspects: &[bool],
) -> CheckedFit {
    let (mut excess, mut model_error) = interval.residuals(&fitted, blocks, None).excess(suspects);
    if let Some(steady) = steadier_reference(interval.config, &fitted, &excess) {
        fitted = interval.fit(blocks, Some(steady));
        (excess, model_error) = interval.residuals(&fitted, blocks, None).excess(suspects);
    }
    let unexplained = unexplained(&fitted, blocks, interval.span_s, interval.config.unexplained_max);
    let counts = Counts::of(blocks, interval.span_s, &fitted);
    CheckedFit { fitted, excess, model_error, unexplained, counts }
}

/// Another daughter for the reference, steady and detected in as many channels, if the current one changes too much.
fn steadier_reference(config: &SolverConfig, fitted: &RobustFit, excess: &[Excess]) -> Option<usize> {
    let layout = &fitted.layout;
    let n = layout.satellites;
    let phase_variance_max = config.phase_sigma_deg_max.to_radians().powi(2);
    let is_steady = |daughter: usize| {
        (0..layout.channels()).all(|c| excess[c * n + daughter].scatter[1] <= phase_variance_max)
    };
    let channels =
        |daughter: usize| (0..layout.channels()).filter(|c| fitted.is_detected(*c, daughter)).count();
    let reference = layout.reference;
    if is_steady(reference) {
        return None;
    }
    (0..n).find(|daughter| is_steady(*daughter) && channels(*daughter) == channels(reference))
}

impl CheckedFit {
    fn solution(self, interval: &Interval<'_>, (pass, normal_hat): (u64, Vec<Vec3>)) -> PassSolution {
        let Self { fitted, excess, model_error, unexplained, counts } = &self;
        let (config, RobustFit { layout, newton, .. }) = (interval.config, fitted);
        let (square, count) =
            fitted.chi_squares.iter().fold((0.0, 0.0), |(a, b), (square, count)| (a + square, b + count));
        let contradicted = layout.solves_positions()
            && newton.converged
            && config.unexplained_max < 1.0
            && is_contradicted(layout, newton, &fitted.used_sums());
        let assessment = GainAssessment { config, fitted, counts, unexplained, excess };
        let mut daughters = assessment.estimates();
        let models = self.models(config, &mut daughters, &assessment);
        let correlations = (0..model_error.len()).map(|c| assessment.correlations(c, &daughters)).collect();
        let mut solution = PassSolution {
            pass,
            from_s: interval.span_s[0],
            until_s: interval.span_s[1],
            // Without data in the solution there is nothing to converge.
            converged: newton.converged && count > 0.0,
            iterations: newton.iterations,
            visibilities: counts.used,
            outliers: counts.out,
            chi_square: if count > 0.0 { square / (2.0 * count) } else { f64::NAN },
            model_error: model_error.clone(),
            models,
            reference: layout.reference as u32 + 1,
            begins_with_jump: false,
            is_held_out: false,
            outlier_fractions: counts.parts(),
            daughters,
            normal_hat,
            correlations,
        };
        if contradicted {
            solution.mark_ambiguous(|n, _| n != layout.reference);
        }
        solution
    }

    /// Verdicts on the models of all channels. A factor that amplitudes have in common is added to their errors.
    fn models(
        &self,
        config: &SolverConfig,
        daughters: &mut [DaughterEstimate],
        assessment: &GainAssessment<'_>,
    ) -> Vec<ModelVerdict> {
        let channels = self.model_error.len();
        let uncertainty: Vec<f64> =
            (0..channels).map(|c| assessment.common_amplitude_variance(c).sqrt()).collect();
        let common = common_amplitudes(config, daughters, &uncertainty);
        for daughter in &mut *daughters {
            for (gain, common) in daughter.gains.iter_mut().zip(&common) {
                gain.amplitude_sigma = gain.amplitude_sigma.hypot(common.unwrap_or(0.0));
            }
        }
        let verdict = |channel: usize| {
            let sums: Vec<PairSums> =
                self.fitted.sums.iter().filter(|sums| sums.channel == channel).copied().collect();
            let verdict = model_verdict(config, (daughters, channel), self.model_error[channel], &sums);
            match (verdict, common[channel]) {
                (ModelVerdict::Right, Some(common)) => {
                    ModelVerdict::OtherStrength { factor: (-2.0 * common).exp() }
                }
                (verdict, _) => verdict,
            }
        };
        let verdicts: Vec<ModelVerdict> = (0..channels).map(verdict).collect();
        for daughter in daughters {
            let weak = daughter.gains.iter_mut().zip(&verdicts).filter(|(_, is)| **is == ModelVerdict::Weak);
            weak.filter(|(gain, _)| gain.state == GainState::Good)
                .for_each(|(gain, _)| gain.state = GainState::PoorFit);
        }
        verdicts
    }
}
