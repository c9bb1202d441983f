//! What the residuals of a channel say of its model: right, wrong, too weak, or of another strength.

use bincode::{Decode, Encode};
use serde::Serialize;

use super::config::{AmplitudeScale, CalibrationMode, SolverConfig};
use super::diagnosis::ModelFault;
use super::estimates::{DaughterEstimate, GainEstimate, GainState};
use super::sums::PairSums;
use crate::numerics::median;

/// Verdict on the model of a channel.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Encode, Decode)]
#[serde(tag = "is", rename_all = "kebab-case")]
pub enum ModelVerdict {
    /// Gains explain the data.
    #[default]
    Right,
    /// Gains leave a part of the signal.
    Wrong {
        /// Fraction of the signal that no gains explain.
        unexplained: f64,
        /// What is wrong, if that is known.
        #[serde(flatten, skip_serializing_if = "Option::is_none")]
        fault: Option<ModelFault>,
    },
    /// The known signal is too weak for any gain.
    Weak,
    /// The model is of another strength: amplitudes have a factor in common.
    OtherStrength {
        /// Strength of the model over that of the signal, if amplitudes are one on average.
        factor: f64,
    },
}

impl ModelVerdict {
    /// Whether both are of one kind.
    pub(super) fn is_like(self, other: Self) -> bool {
        std::mem::discriminant(&self) == std::mem::discriminant(&other)
    }
}

/// Smallest unexplained fraction of the signal that is reported.
const UNEXPLAINED_MIN: f64 = 0.01;

/// Factor by which what a drift leaves unexplained may exceed what its scatter tells.
const DRIFT_MARGIN: f64 = 1.5;

/// Part of what a drift leaves unexplained that changes within parts of the interval may make look like an error of the
/// model.
const BLURRED_FRACTION: f64 = 0.2;

/// Part of the power of the data that other signals have, from which an artificial one is too weak.
const OTHERS_MAX: f64 = 0.5;

/// Power of the data over that of the artificial signal, below which it is taken for absent.
const BEACON_POWER_MIN: f64 = 0.5;

/// Verdict on a channel with this fraction of `model_error`; `sums` are those of its pairs.
pub(super) fn model_verdict(
    config: &SolverConfig,
    (estimates, channel): (&[DaughterEstimate], usize),
    model_error: f64,
    sums: &[PairSums],
) -> ModelVerdict {
    let gains: Vec<&GainEstimate> = estimates.iter().map(|daughter| &daughter.gains[channel]).collect();
    let is_beacon = config.mode == CalibrationMode::Beacon;
    // The sky under the artificial signal is expected.
    let least = if is_beacon { config.unexplained_max } else { UNEXPLAINED_MIN };
    let unexplained = unexplained_if_wrong(&gains, model_error, least);
    if is_beacon && is_beacon_weak(sums, unexplained.is_some()) {
        return ModelVerdict::Weak;
    }
    if let Some(unexplained) = unexplained {
        // Gains that are left out explain nothing, and are not seen in what the others leave.
        let unexplained = if unexplained < UNEXPLAINED_MIN { left_out(sums, &gains) } else { unexplained };
        return if unexplained < UNEXPLAINED_MIN {
            ModelVerdict::Weak
        } else {
            ModelVerdict::Wrong { unexplained, fault: None }
        };
    }
    // A daughter whose partners are all dead says nothing of the model.
    let has_partner = |n: usize| {
        let pairs = sums.iter().filter(|sums| sums.count > 0.0).map(|sums| [sums.pair.i, sums.pair.j]);
        let mut others = pairs.filter_map(|[i, j]| match n {
            n if n == usize::from(i) => Some(usize::from(j)),
            n if n == usize::from(j) => Some(usize::from(i)),
            _ => None,
        });
        others.any(|other| gains[other].state != GainState::Dead)
    };
    let count = |is: fn(GainState) -> bool| {
        let chosen = gains.iter().enumerate().filter(|(n, gain)| is(gain.state) && has_partner(*n));
        chosen.count()
    };
    let with_data = count(|state| !matches!(state, GainState::NoData | GainState::Dead));
    if 2 * count(|state| state == GainState::Uncertain) > with_data
        && count(|state| state == GainState::Good) == 0
    {
        return ModelVerdict::Weak;
    }
    ModelVerdict::Right
}

/// Significance, in standard deviations of noise, of the power of a signal.
const POWER_SIGMAS: f64 = 3.0;

/// Part of the power beyond noise that pairs with poor gains have; 0 where there may be noise alone.
fn left_out(sums: &[PairSums], gains: &[&GainEstimate]) -> f64 {
    let (mut all, mut poor, mut count) = (0.0, 0.0, 0.0);
    for sums in sums.iter().filter(|sums| sums.count > 0.0) {
        let excess = sums.variance_factor * sums.power - 2.0 * sums.count;
        let is_poor =
            [sums.pair.i, sums.pair.j].iter().any(|n| gains[usize::from(*n)].state == GainState::PoorFit);
        all += excess;
        poor += if is_poor { excess } else { 0.0 };
        count += sums.count;
    }
    if all > POWER_SIGMAS * 2.0 * f64::sqrt(count) { (poor / all).clamp(0.0, 1.0) } else { 0.0 }
}

/// Whether other signals are stronger than an artificial one whose direction is right, or it is absent.
fn is_beacon_weak(sums: &[PairSums], is_wrong: bool) -> bool {
    let (mut power, mut known, mut explained) = (0.0, 0.0, 0.0);
    for sums in sums.iter().filter(|sums| sums.count > 0.0) {
        let of_model = sums.gram[0][0].re;
        power += sums.variance_factor * (sums.power - 2.0 * sums.count / sums.variance_factor);
        known += sums.variance_factor * of_model;
        // Noise alone has two.
        explained += sums.variance_factor * sums.cross[0].norm_sqr() / of_model.max(f64::MIN_POSITIVE) - 2.0;
    }
    let others = power - explained;
    let is_absent = is_wrong && power < BEACON_POWER_MIN * known;
    let has_its_power = power < known / BEACON_POWER_MIN;
    is_absent
        || others > OTHERS_MAX * power && !(is_wrong && has_its_power && power > BEACON_POWER_MIN * known)
}

/// Fraction of a channel's signal that gains leave unexplained, if its model is wrong.
fn unexplained_if_wrong(gains: &[&GainEstimate], model_error: f64, least: f64) -> Option<f64> {
    let has_signal = |gain: &&&GainEstimate| !matches!(gain.state, GainState::NoData | GainState::Dead);
    let count = gains.iter().filter(has_signal).count();
    let poor = gains.iter().filter(|gain| gain.state == GainState::PoorFit).count();
    // Gains that change within the interval leave a part of the signal, too: of the daughter's own, and of its partners'.
    let squares: Vec<f64> = gains
        .iter()
        .map(|gain| gain.phase_scatter_deg.to_radians().powi(2) + gain.amplitude_scatter.powi(2))
        .collect();
    let of_all = squares.iter().sum::<f64>();
    let partners = (gains.len() as f64 - 1.0).max(1.0);
    let by_drift = |square: f64| 1.0 - (-(square + (of_all - square) / partners)).exp();
    let drifts: Vec<f64> = squares.iter().map(|square| by_drift(*square)).collect();
    let fractions =
        gains.iter().zip(&drifts).map(|(gain, by_drift)| gain.unexplained - DRIFT_MARGIN * by_drift);
    // The median over daughters: a single daughter may have another problem.
    let fraction = model_error.max(median(fractions.collect()).unwrap_or(0.0));
    let most_fit_poorly = count > 0 && 2 * poor > count;
    let by_drift = median(drifts).unwrap_or(0.0);
    (most_fit_poorly || fraction > least.max(BLURRED_FRACTION * by_drift)).then_some(fraction)
}

/// Twice the logarithm of the likelihood ratio from which amplitudes have a factor in common. Independent amplitudes of eight
/// daughters have it in one of 20,000 cases (Student's t of 8.8 with seven degrees of freedom).
const COMMON_TWICE_LOG: f64 = 20.0;

/// Smallest common log amplitude that is told, and the same in deviations of the model's own uncertainty.
const COMMON_MIN: f64 = 0.03;
const COMMON_SIGMAS: f64 = 4.0;

/// Least number of gains that tell their scatter.
const GAINS_MIN: usize = 3;

/// Mean log amplitude of the good gains of each channel, where it is larger than the differences between daughters allow;
/// `uncertainty` is the model's, by channel.
pub(super) fn common_amplitudes(
    config: &SolverConfig,
    estimates: &[DaughterEstimate],
    uncertainty: &[f64],
) -> Vec<Option<f64>> {
    let channels = uncertainty.len();
    if config.amplitude_scale == AmplitudeScale::UnitMean {
        return vec![None; channels];
    }
    let good = |daughter: &DaughterEstimate, channel: usize| {
        let gain = &daughter.gains[channel];
        (gain.state == GainState::Good).then(|| (gain.amplitude.ln(), gain.noise_sigma[0].powi(2)))
    };
    let of_channel = |channel: usize| -> Vec<(f64, f64)> {
        estimates.iter().filter_map(|one| good(one, channel)).collect()
    };
    let mean_over_channels = |daughter: &DaughterEstimate| {
        let gains: Option<Vec<(f64, f64)>> = (0..channels).map(|channel| good(daughter, channel)).collect();
        let gains = gains.filter(|gains| !gains.is_empty())?;
        let count = gains.len() as f64;
        let sum = gains.iter().fold((0.0, 0.0), |sum, gain| (sum.0 + gain.0, sum.1 + gain.1));
        Some((sum.0 / count, sum.1 / (count * count)))
    };
    let of_all: Vec<(f64, f64)> = estimates.iter().filter_map(mean_over_channels).collect();
    let is_common = significant_mean(&of_all).is_some();
    let common = |channel: usize| {
        let gains = of_channel(channel);
        let mean = significant_mean(&gains).or_else(|| is_common.then(|| mean(&gains)))?;
        (mean.abs() > COMMON_MIN.max(COMMON_SIGMAS * uncertainty[channel])).then_some(mean)
    };
    (0..channels).map(common).collect()
}

fn mean(values: &[(f64, f64)]) -> f64 {
    values.iter().map(|(value, _)| value).sum::<f64>() / values.len().max(1) as f64
}

/// Mean of values with variances of noise, if it is significant against their scatter.
fn significant_mean(values: &[(f64, f64)]) -> Option<f64> {
    let (count, mean) = (values.len() as f64, mean(values));
    let scatter: f64 = values.iter().map(|(value, noise)| (value - mean).powi(2) + noise).sum();
    let twice_log = count * (count * mean * mean / scatter).ln_1p();
    (values.len() >= GAINS_MIN && twice_log > COMMON_TWICE_LOG).then_some(mean)
}
