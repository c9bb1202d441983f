//! Detection of the known signal in the data of a daughter in a channel.
//!
//! With the gains of the others fixed, a daughter's data determine its gain, amplitude and phase, without a prior:
//! `numerator / denominator`, with variance `1 / denominator` of the real and imaginary part. `|numerator|^2 /
//! denominator` is the squared signal-to-noise ratio; noise alone exceeds x with probability exp(-x / 2). A daughter
//! that is not detected is left out of the solution of the others.

use num_complex::Complex64;

use super::config::SolverConfig;
use super::layout::{ParameterLayout, ParameterValues};
use super::sums::{MODEL_TERMS, PairSums};

/// Squared signal-to-noise ratio from which a gain is detected: noise alone reaches it in 4 of a million cases, and a
/// phase is known to 11.5 deg.
pub(super) const DETECTED_SNR2: f64 = 25.0;

/// Increase of the squared signal-to-noise ratio required of all pairs of a channel together, for each daughter
/// beyond two: gains fitted to noise reach about ten for each daughter.
const DETECTED_SNR2_PER_DAUGHTER: f64 = 10.0;

/// Squared signal-to-noise ratio that a working receiver must have before an undetected one counts as dead.
const DEAD_SNR2: f64 = 100.0;

/// Prior standard deviations by which the amplitude of a working receiver can be below one.
const PRIOR_SIGMAS: f64 = 3.0;

/// Significance, in standard deviations, of power beyond noise.
const SIGMAS: f64 = 3.0;

/// Presence of the known signal in the data of a gain.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum SignalPresence {
    /// There are no data.
    NoData,
    /// The known signal is detected.
    Detected,
    /// The data are too few to decide.
    Undetermined,
    /// There is only noise, where a working receiver would deliver signal.
    Dead,
    /// There is a signal other than the known one.
    Unmodelled,
}

/// Gain of a daughter in a channel, from its own data and the gains of the others.
#[derive(Clone, Copy, Debug)]
pub(super) struct OwnGain {
    pub(super) gain: Complex64,
    /// Inverse variance of the real and imaginary part.
    pub(super) information: f64,
    /// Information if the gains of the others were one.
    ideal: f64,
    /// Information with all daughters that are not dead, dropped ones included, gains of one, and noise alone.
    ideal_of_all: f64,
    pub(super) presence: SignalPresence,
}

impl OwnGain {
    /// State of an undetected gain, by the signal that a working receiver would deliver.
    fn undetected_presence(&self, config: &SolverConfig) -> SignalPresence {
        if self.is_detectable(config) { SignalPresence::Unmodelled } else { SignalPresence::Undetermined }
    }

    /// Smallest squared signal-to-noise ratio of a working receiver.
    pub(super) fn expected_snr_squared(&self, config: &SolverConfig) -> f64 {
        let amplitude_min = (-PRIOR_SIGMAS * config.amplitude_sigma).exp().max(config.dead_amplitude);
        self.ideal * amplitude_min * amplitude_min
    }

    /// Whether a working receiver would be detected if all other daughters work.
    pub(super) fn is_detectable(&self, config: &SolverConfig) -> bool {
        Self { ideal: self.ideal_of_all, ..*self }.expected_snr_squared(config) >= DEAD_SNR2
    }

    /// Squared signal-to-noise ratio.
    pub(super) fn snr_squared(&self) -> f64 {
        self.gain.norm_sqr() * self.information
    }
}

/// Whether each gain is left out of the solution; by channel, then daughter.
pub(super) type DroppedGains = Vec<bool>;

/// Whether both gains of a pair are in the solution.
pub(super) fn is_pair_used(layout: &ParameterLayout, dropped_gains: &[bool], sums: &PairSums) -> bool {
    let [i, j] = [sums.pair.i, sums.pair.j].map(usize::from);
    let at = sums.channel * layout.satellites;
    !dropped_gains[at + i] && !dropped_gains[at + j]
}

/// Gains of all daughters, by channel, then daughter, each from its pairs with daughters in the solution. Pairs with a dead daughter say
/// nothing of the other one.
pub(super) fn solve_own_gains(
    config: &SolverConfig,
    layout: &ParameterLayout,
    values: &ParameterValues,
    sums: &[PairSums],
    dropped_gains: &[bool],
) -> Vec<OwnGain> {
    let n = layout.satellites.max(1);
    let mut left_out = dropped_gains.to_vec();
    let mut has_data = vec![false; left_out.len()];
    for sums in sums.iter().filter(|sums| sums.count > 0.0) {
        [sums.pair.i, sums.pair.j].iter().for_each(|k| has_data[sums.channel * n + usize::from(*k)] = true);
    }
    // If all daughters of a channel that have data are left out, all are used.
    for (channel, has_data) in left_out.chunks_mut(n).zip(has_data.chunks(n)) {
        if channel.iter().zip(has_data).all(|(is_left_out, has_data)| *is_left_out || !has_data) {
            channel.fill(false);
        }
    }
    let none_dead = vec![false; left_out.len()];
    let mut own = gains_beside(config, layout, values, sums, (&left_out, &none_dead));
    let dead = dead_gains(&own, n);
    if dead.contains(&true) {
        own = gains_beside(config, layout, values, sums, (&left_out, &dead));
    }
    for (channel, dead) in own.chunks_mut(n).zip(dead.chunks(n)) {
        // If no daughter is detected, the daughters are not the cause; unless other channels show which one is.
        let is_any_detected = channel.iter().any(|own| own.presence == SignalPresence::Detected);
        for (own, is_dead) in channel.iter_mut().zip(dead) {
            if *is_dead {
                own.presence = SignalPresence::Dead;
            } else if own.presence == SignalPresence::Dead && !is_any_detected {
                own.presence = SignalPresence::Unmodelled;
            }
        }
    }
    own
}

/// Gains that are dead: in a channel in which others are detected, or as in another such channel; `n` daughters.
fn dead_gains(own: &[OwnGain], n: usize) -> Vec<bool> {
    let is_any_detected: Vec<bool> = own
        .chunks(n)
        .map(|channel| channel.iter().any(|own| own.presence == SignalPresence::Detected))
        .collect();
    let is_dead = |k: usize| own[k].presence == SignalPresence::Dead;
    let is_known = |daughter: usize| {
        is_any_detected.iter().enumerate().any(|(c, detected)| *detected && is_dead(c * n + daughter))
    };
    (0..own.len()).map(|k| is_dead(k) && is_known(k % n)).collect()
}

/// Gains with pairs of those that are `left_out`, or that are `dead`, for themselves only.
fn gains_beside(
    config: &SolverConfig,
    layout: &ParameterLayout,
    values: &ParameterValues,
    sums: &[PairSums],
    (left_out, dead): (&[bool], &[bool]),
) -> Vec<OwnGain> {
    let n = layout.satellites;
    let mut found = vec![GainSums::default(); n * layout.channels()];
    for sums in sums {
        let [i, j] = [sums.pair.i, sums.pair.j].map(usize::from);
        let at = sums.channel * n;
        let (_, u) = layout.pair(values, sums.channel, sums.pair);
        let gram = sums.gram_times(&u);
        let projection: Complex64 = (0..MODEL_TERMS).map(|k| u[k] * sums.cross[k]).sum();
        let model: f64 = (0..MODEL_TERMS).map(|k| u[k] * gram[k].re).sum();
        for (own, other, projection) in [(i, j, projection), (j, i, projection.conj())] {
            found[at + own].has_data |= sums.count > 0.0;
            if dead[at + other] {
                continue;
            }
            found[at + own].ideal_of_all += model * sums.variance_factor;
            if !left_out[at + other] {
                let gain = layout.gain(values, sums.channel, other);
                found[at + own].add(projection * gain, [model * gain.norm_sqr(), model], sums);
            }
        }
    }
    let mut own: Vec<OwnGain> = found.into_iter().map(|sums| sums.gain(config)).collect();
    let is_left: Vec<bool> = left_out.iter().zip(dead).map(|(a, b)| *a || *b).collect();
    for (c, channel) in own.chunks_mut(n.max(1)).enumerate() {
        // Gains fitted to noise agree with it.
        let used = channel.iter().enumerate().filter(|(n_own, _)| !is_left[c * n + n_own]);
        let used = used.filter(|(_, own)| own.presence != SignalPresence::NoData).count();
        let required = DETECTED_SNR2 + DETECTED_SNR2_PER_DAUGHTER * used.saturating_sub(2) as f64;
        if channel_snr_squared(layout, values, sums, &is_left, c) < required {
            let detected = channel.iter_mut().filter(|own| own.presence == SignalPresence::Detected);
            detected.for_each(|own| own.presence = own.undetected_presence(config));
        }
    }
    own
}

/// Squared signal-to-noise ratio of all pairs of a channel together, with the gains of the solution.
fn channel_snr_squared(
    layout: &ParameterLayout,
    values: &ParameterValues,
    sums: &[PairSums],
    dropped_gains: &[bool],
    channel: usize,
) -> f64 {
    let of_channel = sums.iter().filter(|sums| sums.channel == channel);
    let (mut projection, mut model) = (0.0, 0.0);
    for sums in of_channel.filter(|sums| is_pair_used(layout, dropped_gains, sums)) {
        let (gain, u) = layout.pair(values, channel, sums.pair);
        let gram = sums.gram_times(&u);
        projection += (0..MODEL_TERMS).map(|k| (gain.conj() * u[k] * sums.cross[k]).re).sum::<f64>();
        model += gain.norm_sqr() * (0..MODEL_TERMS).map(|k| u[k] * gram[k].re).sum::<f64>();
    }
    if model > 0.0 && projection > 0.0 { projection * projection / model } else { 0.0 }
}

#[derive(Clone, Copy, Default)]
struct GainSums {
    numerator: Complex64,
    denominator: f64,
    ideal: f64,
    power: f64,
    count: f64,
    has_data: bool,
    ideal_of_all: f64,
}

impl GainSums {
    fn add(&mut self, numerator: Complex64, [denominator, ideal]: [f64; 2], sums: &PairSums) {
        self.numerator += numerator;
        self.denominator += denominator;
        self.ideal += ideal;
        self.power += sums.power;
        self.count += sums.count;
    }

    fn gain(self, config: &SolverConfig) -> OwnGain {
        let Self { numerator, denominator, ideal, power, count, has_data, ideal_of_all } = self;
        if denominator <= 0.0 || count == 0.0 {
            let presence = if has_data { SignalPresence::Undetermined } else { SignalPresence::NoData };
            return OwnGain { gain: Complex64::ONE, information: 0.0, ideal: 0.0, ideal_of_all, presence };
        }
        let gain = numerator / denominator;
        let own = OwnGain {
            gain,
            information: denominator,
            ideal,
            ideal_of_all,
            presence: SignalPresence::Undetermined,
        };
        let expected_snr_squared = own.expected_snr_squared(config);
        // Sum of |V|^2 in units of its noise, minus its expectation for noise alone.
        let excess = power - 2.0 * count;
        let presence = match () {
            () if own.snr_squared() >= DETECTED_SNR2 && gain.norm() >= config.dead_amplitude => {
                SignalPresence::Detected
            }
            () if own.snr_squared() >= DETECTED_SNR2 => SignalPresence::Dead,
            () if expected_snr_squared < DEAD_SNR2 => own.undetected_presence(config),
            () if excess > 0.5 * expected_snr_squared + SIGMAS * 2.0 * count.sqrt() => {
                SignalPresence::Unmodelled
            }
            () => SignalPresence::Dead,
        };
        OwnGain { presence, ..own }
    }
}

/// Gains left out of the solution: those not detected, unless other channels determine them.
pub(super) fn dropped_gains(layout: &ParameterLayout, own: &[OwnGain]) -> DroppedGains {
    // All channels together determine a clock or a position.
    let is_determined_jointly =
        layout.channels() > 1 && layout.clock_sigma_ns > 0.0 || layout.model_terms() > 1;
    own.iter()
        .map(|own| match own.presence {
            SignalPresence::Detected | SignalPresence::NoData => false,
            SignalPresence::Undetermined => !is_determined_jointly,
            // With unknown positions little of the signal is detected.
            SignalPresence::Unmodelled => layout.model_terms() == 1,
            SignalPresence::Dead => true,
        })
        .collect()
}

/// Daughter that phases are relative to: the configured one, unless another is detected in more channels.
pub(super) fn best_reference(layout: &ParameterLayout, own: &[OwnGain], configured: usize) -> usize {
    let n = layout.satellites;
    let detected_channels = |daughter: usize| {
        (0..layout.channels()).filter(|c| own[c * n + daughter].presence == SignalPresence::Detected).count()
    };
    let best = (0..n).map(detected_channels).max().unwrap_or(0);
    if detected_channels(configured) == best {
        configured
    } else {
        (0..n).find(|daughter| detected_channels(*daughter) == best).unwrap_or(configured)
    }
}
