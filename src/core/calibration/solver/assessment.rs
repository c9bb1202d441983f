//! Reported uncertainty and quality state of each gain, from noise, excess scatter of residuals and model errors.

use std::f64::consts::FRAC_PI_2;

use super::config::{AmplitudeScale, CalibrationMode, SolverConfig};
use super::detect::SignalPresence;
use super::estimates::{Counts, DaughterEstimate, GainEstimate, GainState};
use super::fit::Unexplained;
use super::robust_fit::RobustFit;
use super::stability::Excess;
use crate::numerics::median;

/// Coverage: errors must stay within this many stated standard deviations. Angles wrap, and at low signal-to-noise
/// the phase error of a gain exceeds the Cramer-Rao bound.
const COVERAGE_SIGMAS: f64 = 4.0;

/// Maximum number of daughters whose errors are stated with their correlations.
pub const CORRELATED_MAX: usize = 16;

/// Factor by which stated standard deviations exceed the Cramer-Rao bound, as weights are estimates too.
/// With it fewer than 1e-4 of the errors exceed [`COVERAGE_SIGMAS`] stated deviations: Gaussian errors exceed 4 deviations with
/// a probability of 0.6e-4, 4.4 deviations with 0.1e-4.
pub(super) const SIGMA_MARGIN: f64 = 1.1;

/// Signal-to-noise ratio at which a daughter counts as detected in several channels together, none of which suffices
/// alone.
const COMBINED_SNR_MIN: f64 = 5.0;

/// Assessment of the gains of a fit.
pub(super) struct GainAssessment<'a> {
    pub(super) config: &'a SolverConfig,
    pub(super) fitted: &'a RobustFit,
    pub(super) counts: &'a Counts,
    pub(super) unexplained: &'a Unexplained,
    pub(super) excess: &'a [Excess],
}

/// Enlarges a standard deviation (rad) so that it covers the non-Gaussian phase error of a weak gain.
pub(super) fn sigma_with_coverage(sigma: f64) -> f64 {
    (SIGMA_MARGIN * sigma).max((COVERAGE_SIGMAS * sigma).min(1.0).asin() / COVERAGE_SIGMAS)
}

/// Whether the noise of gains is among the errors of maps. It is not if they are found from the visibilities that are mapped: these are drawn
/// towards the model, by as much as the noise would draw them away, so that a map of data with noise N and gains of covariance C has that
/// of `N - T C T'`, T the derivative of the visibilities by the gains.
pub(super) fn noise_is_in_maps(config: &SolverConfig) -> bool {
    config.mode == CalibrationMode::Beacon
}

/// The standard deviation that [`sigma_with_coverage`] enlarges to this one; the largest, if there are several.
pub(super) fn bare_sigma(safe: f64) -> f64 {
    let (bare, angle) = (safe / SIGMA_MARGIN, COVERAGE_SIGMAS * safe);
    if angle < FRAC_PI_2 { bare.min(angle.sin() / COVERAGE_SIGMAS) } else { bare }
}

impl GainAssessment<'_> {
    /// Estimates of all daughters, with the states of their gains.
    pub(super) fn estimates(&self) -> Vec<DaughterEstimate> {
        let mut estimates: Vec<DaughterEstimate> =
            (0..self.fitted.layout.satellites).map(|n| self.daughter_estimate(n)).collect();
        for c in 0..self.fitted.layout.channels() {
            let good = estimates.iter().filter(|one| one.gains[c].state == GainState::Good).count();
            let detectable: Vec<usize> =
                (0..estimates.len()).filter(|n| self.is_detectable(c, *n, &estimates)).collect();
            if !self.fitted.layout.solves_positions() && detectable.len() > 2 * good {
                // If most daughters fit poorly, the model is wrong for the channel.
                detectable.into_iter().for_each(|n| estimates[n].gains[c].state = GainState::PoorFit);
            }
            let has = |state: GainState| estimates.iter().filter(|one| one.gains[c].state == state).count();
            let (poor, unstable) = (has(GainState::PoorFit), has(GainState::Unstable));
            if good <= 1 && (poor > 0 || (unstable > 0 && good + unstable <= 1)) {
                // Noise cannot be told from a signal that is not the model's.
                let states = estimates.iter_mut().map(|one| &mut one.gains[c].state);
                states
                    .filter(|state| **state == GainState::Dead)
                    .for_each(|state| *state = GainState::PoorFit);
            }
            let mut all: Vec<&mut GainState> =
                estimates.iter_mut().map(|one| &mut one.gains[c].state).collect();
            all.retain(|state| **state == GainState::Good);
            if let [alone] = &mut all[..] {
                // A single good gain is meaningless: phases are relative.
                **alone = GainState::Uncertain;
            }
        }
        estimates
    }

    /// Whether a working, stable daughter would be detected in a channel.
    fn is_detectable(&self, c: usize, n: usize, estimates: &[DaughterEstimate]) -> bool {
        let own_gain = &self.fitted.own_gains[c * self.fitted.layout.satellites + n];
        let state = estimates[n].gains[c].state;
        own_gain.is_detectable(self.config)
            && !matches!(state, GainState::NoData | GainState::Dead | GainState::Unstable)
    }

    /// Variance of the log amplitude common to all daughters of a channel: the flux scale of a model is assumed as
    /// uncertain as its shape. The factor is 1/4 as an amplitude is the square root of a visibility's.
    pub(super) fn common_amplitude_variance(&self, c: usize) -> f64 {
        let satellites = self.fitted.layout.satellites;
        if self.config.amplitude_scale == AmplitudeScale::UnitMean {
            return 0.0;
        }
        let fractions = self.unexplained.by_gain[c * satellites..(c + 1) * satellites].to_vec();
        // Errors below the noise of single daughters may be significant in the sum over all pairs.
        0.25 * median(fractions).unwrap_or(0.0).max(self.unexplained.by_channel[c])
    }

    /// Variance of a gain's logarithm due to errors of the model: the persistent error that was detected; if the daughter's residuals
    /// show unexplained power, also the part below the noise, limited by that power.
    fn model_variance(&self, k: usize) -> f64 {
        let Excess { model, model_below_noise, model_full_power, .. } = self.excess[k];
        model.max(model_below_noise.min(self.unexplained.by_gain[k] * model_full_power))
    }

    fn daughter_estimate(&self, n: usize) -> DaughterEstimate {
        let (layout, values) = (&self.fitted.layout, &self.fitted.newton.values);
        let sigma = |place: Option<usize>| self.covariance(place, place).sqrt();
        DaughterEstimate {
            daughter: n as u32 + 1,
            clock_ns: values.clock_ns[n],
            clock_sigma_ns: sigma(layout.clock(n)),
            position_m: values.position_m[n],
            position_sigma_m: [0, 1, 2].map(|axis| sigma(layout.position(n, axis))),
            gains: (0..layout.channels()).map(|c| self.gain(c, n)).collect(),
        }
    }

    fn covariance(&self, a: Option<usize>, b: Option<usize>) -> f64 {
        let order = self.fitted.layout.order();
        match (a, b) {
            (Some(a), Some(b)) => self.fitted.newton.covariance[a * order + b],
            _ => 0.0,
        }
    }

    /// Standard deviation, due to noise, of a phase with the contribution of the clock, rad.
    fn phase_sigma(&self, c: usize, n: usize) -> f64 {
        self.gain_covariance(1, c, (n, n)).max(0.0).sqrt()
    }

    fn gain(&self, c: usize, n: usize) -> GainEstimate {
        let (layout, newton) = (&self.fitted.layout, &self.fitted.newton);
        let k = c * layout.satellites + n;
        let (own_gain, excess) = (&self.fitted.own_gains[k], &self.excess[k]);
        let is_reference = n == layout.reference;
        let reference = c * layout.satellites + layout.reference;
        let [reference_scatter, reference_model] = if is_reference {
            [0.0; 2]
        } else {
            [
                self.excess[reference].scatter[1] + self.excess[reference].hidden,
                self.model_variance(reference),
            ]
        };
        // A daughter left out of the joint solution is assessed from its own data.
        let is_from_own_data = self.fitted.dropped_gains[k] && own_gain.presence != SignalPresence::NoData;
        let (gain, noise) = if is_from_own_data {
            let sigma = own_gain.snr_squared().sqrt().recip().min(layout.phase_sigma.max(1.0));
            (own_gain.gain, [sigma, if is_reference { 0.0 } else { sigma }])
        } else {
            let amplitude = layout.amplitude(c, n);
            let sigma = self.covariance(amplitude, amplitude).sqrt();
            (layout.gain(&newton.values, c, n), [sigma, self.phase_sigma(c, n)])
        };
        let relative = if is_reference { 0.0 } else { 1.0 };
        let scatter = [excess.scatter[0], excess.scatter[1] + excess.hidden + reference_scatter];
        let own_model = self.model_variance(k);
        let model = [own_model + self.common_amplitude_variance(c), relative * (own_model + reference_model)];
        let noise = noise.map(sigma_with_coverage);
        let total = |axis: usize| (noise[axis].powi(2) + scatter[axis] + model[axis]).sqrt();
        // The strength of the model is that of the map, too.
        let in_maps = if noise_is_in_maps(self.config) { noise.map(|sigma| sigma * sigma) } else { [0.0; 2] };
        let map_sigma =
            [in_maps[0] + scatter[0] + own_model, relative * (in_maps[1] + scatter[1]) + model[1]];
        let [visibilities, outliers] = self.counts.by_gain[k];
        GainEstimate {
            frequency_hz: layout.frequencies_hz[c],
            amplitude: gain.norm(),
            amplitude_sigma: total(0),
            phase_deg: gain.arg().to_degrees(),
            phase_sigma_deg: if is_reference { 0.0 } else { total(1).to_degrees() },
            phase_scatter_deg: excess.scatter[1].sqrt().to_degrees(),
            amplitude_scatter: excess.scatter[0].sqrt(),
            unexplained: self.unexplained.by_gain[k],
            visibilities,
            outliers,
            data_s: self.counts.data_s[k],
            noise_sigma: [noise[0], relative * noise[1]],
            map_sigma: map_sigma.map(f64::sqrt),
            state: self.state(
                (c, n),
                gain.norm(),
                [noise[0].max(noise[1]), scatter[0].max(scatter[1]), model[1]],
            ),
        }
    }

    /// Correlations of the errors of maps by the gains of a channel: of ln amplitude and of phase, of each daughter with those before it. Noise
    /// correlates them as the solution says; all share the error of the reference's phase. None for more than [`CORRELATED_MAX`] daughters, as
    /// files and states would grow with the square of their number.
    pub(super) fn correlations(&self, c: usize, estimates: &[DaughterEstimate]) -> Vec<[f64; 2]> {
        let layout = &self.fitted.layout;
        if layout.satellites > CORRELATED_MAX {
            return Vec::new();
        }
        let of = |n: usize| c * layout.satellites + n;
        let reference = &self.excess[of(layout.reference)];
        let of_reference =
            reference.scatter[1] + reference.hidden + self.model_variance(of(layout.reference));
        let correlation = |i: usize, j: usize| {
            let [a, b] = [i, j].map(|n| &estimates[n].gains[c]);
            let is_joint =
                noise_is_in_maps(self.config) && ![i, j].iter().any(|n| self.fitted.dropped_gains[of(*n)]);
            let is_relative = ![i, j].contains(&layout.reference);
            let noise = [0, 1].map(|axis| {
                let covariance = |i, j| self.gain_covariance(axis, c, (i, j));
                let found = covariance(i, j) / (covariance(i, i) * covariance(j, j)).sqrt();
                if is_joint && found.is_finite() {
                    found * a.noise_sigma[axis] * b.noise_sigma[axis]
                } else {
                    0.0
                }
            });
            let shared = [0.0, if is_relative { of_reference } else { 0.0 }];
            [0, 1].map(|axis| {
                let found = (noise[axis] + shared[axis]) / (a.map_sigma[axis] * b.map_sigma[axis]);
                if found.is_finite() { found.clamp(-1.0, 1.0) } else { 0.0 }
            })
        };
        (0..layout.satellites)
            .flat_map(|i| (0..i).map(move |j| (i, j)))
            .map(|(i, j)| correlation(i, j))
            .collect()
    }

    /// Covariance by noise of the gains of two daughters: of ln amplitude, or of the phase with that of the clock, rad^2.
    fn gain_covariance(&self, axis: usize, c: usize, (i, j): (usize, usize)) -> f64 {
        let layout = &self.fitted.layout;
        if axis == 0 {
            return self.covariance(layout.amplitude(c, i), layout.amplitude(c, j));
        }
        let ([a, b], rad_per_ns) =
            ([i, j].map(|n| (layout.phase(c, n), layout.clock(n))), layout.rad_per_ns(c));
        self.covariance(a.0, b.0)
            + rad_per_ns * (self.covariance(a.0, b.1) + self.covariance(a.1, b.0))
            + rad_per_ns * rad_per_ns * self.covariance(a.1, b.1)
    }

    /// State of a gain; `noise` is a standard deviation, `scatter` and `model` are variances.
    fn state(&self, (c, n): (usize, usize), amplitude: f64, [noise, scatter, model]: [f64; 3]) -> GainState {
        let Self { config, fitted, .. } = self;
        let k = c * fitted.layout.satellites + n;
        let phase_variance_max = config.phase_sigma_deg_max.to_radians().powi(2);
        let is_dropped = fitted.dropped_gains[k];
        match fitted.own_gains[k].presence {
            SignalPresence::NoData => GainState::NoData,
            SignalPresence::Dead => GainState::Dead,
            SignalPresence::Unmodelled if is_dropped => GainState::PoorFit,
            SignalPresence::Undetermined | SignalPresence::Detected if is_dropped => GainState::Uncertain,
            _ if !fitted.newton.converged => GainState::NotConverged,
            SignalPresence::Undetermined | SignalPresence::Unmodelled if !self.is_detected_together(n) => {
                GainState::Uncertain
            }
            _ if amplitude < config.dead_amplitude => GainState::Dead,
            _ if noise * noise > phase_variance_max => GainState::Uncertain,
            _ if noise * noise + scatter > phase_variance_max => GainState::Unstable,
            _ if noise * noise + scatter + model > phase_variance_max => GainState::PoorFit,
            _ if self.unexplained.by_gain[k] > config.unexplained_max => GainState::PoorFit,
            _ => GainState::Good,
        }
    }

    /// Whether a daughter's signal, summed coherently over the channels without a detection, is significant.
    fn is_detected_together(&self, n: usize) -> bool {
        let fitted = self.fitted;
        let (mut signal, mut expected) = (0.0, 0.0);
        for c in 0..fitted.layout.channels() {
            let own_gain = &fitted.own_gains[c * fitted.layout.satellites + n];
            if !matches!(own_gain.presence, SignalPresence::Detected | SignalPresence::NoData) {
                let gain = fitted.layout.gain(&fitted.newton.values, c, n);
                signal += (gain.conj() * own_gain.gain).re * own_gain.information;
                expected += gain.norm_sqr() * own_gain.information;
            }
        }
        signal >= COMBINED_SNR_MIN * f64::sqrt(expected)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn stated_sigmas_cover_the_phase_error_of_a_noisy_vector() {
        // In unit noise the phase of a vector of length a is beyond an angle p with a probability of at most erfc(a
        // sin p / sqrt 2), the Gaussian one of four deviations if a sin p is 4.
        for a in [5.0_f64, 7.0, 10.0, 30.0] {
            let p = 4.0 * sigma_with_coverage(a.recip());
            assert!(a * p.sin() >= 4.0 - 1e-9, "{a}: {p}");
            // It is at most a fifth above the bound.
            assert!(p * a / 4.0 < 1.2, "{a}: {p}");
            assert!((bare_sigma(0.25 * p) * a - 1.0).abs() < 1e-12, "{a}: {p}");
        }
    }
}
