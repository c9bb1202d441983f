//! What is told of each gain: its errors with what residuals show beyond noise, and whether it can be trusted.

use super::config::{AmplitudeScale, SolverConfig};
use super::detect::SignalPresence;
use super::estimates::{Counts, DaughterEstimate, GainEstimate, GainState};
use super::fit::Unexplained;
use super::robust_fit::Fitted;
use super::stability::Excess;

/// Standard deviations that have to hold errors: angles wrap, and noise turns a weak gain further than its bound says.
const COVERED: f64 = 4.0;

/// By this much stated deviations exceed the bound: weights are estimates, too, and of ten thousand errors none is to be beyond
/// [`COVERED`] of them (Gaussian errors exceed 4 deviations 0.6 times in ten thousand, 4.4 deviations 0.1 times).
const MARGIN: f64 = 1.1;

/// Signal-to-noise ratio at which channels that tell nothing alone tell of a daughter together.
const SEEN_TOGETHER: f64 = 5.0;

/// Inputs of the verdict on gains.
pub(super) struct VerdictInputs<'a> {
    pub(super) config: &'a SolverConfig,
    pub(super) fitted: &'a Fitted,
    pub(super) counts: &'a Counts,
    pub(super) unexplained: &'a Unexplained,
    pub(super) excess: &'a [Excess],
}

/// A standard deviation (rad) of noise that holds phases, too.
fn with_wraps(sigma: f64) -> f64 {
    (MARGIN * sigma).max((COVERED * sigma).min(1.0).asin() / COVERED)
}

impl VerdictInputs<'_> {
    /// What is told of all daughters.
    pub(super) fn daughters(&self) -> Vec<DaughterEstimate> {
        let mut daughters: Vec<DaughterEstimate> =
            (0..self.fitted.layout.satellites).map(|n| self.daughter(n)).collect();
        for c in 0..self.fitted.layout.channels() {
            let good = daughters.iter().filter(|one| one.gains[c].state == GainState::Good).count();
            let visible: Vec<usize> =
                (0..daughters.len()).filter(|n| self.is_visible(c, *n, &daughters)).collect();
            if self.fitted.layout.terms() == 1 && visible.len() > 2 * good {
                // A model that most daughters refuse serves none.
                visible.into_iter().for_each(|n| daughters[n].gains[c].state = GainState::PoorFit);
            }
            let mut all: Vec<&mut GainState> =
                daughters.iter_mut().map(|one| &mut one.gains[c].state).collect();
            all.retain(|state| **state == GainState::Good);
            if let [alone] = &mut all[..] {
                // A gain alone is none: a phase is against another.
                **alone = GainState::Uncertain;
            }
        }
        daughters
    }

    /// Whether a daughter that works and is steady would be seen in a channel.
    fn is_visible(&self, c: usize, n: usize, daughters: &[DaughterEstimate]) -> bool {
        let own = &self.fitted.own[c * self.fitted.layout.satellites + n];
        let state = daughters[n].gains[c].state;
        own.is_visible(self.config)
            && !matches!(state, GainState::NoData | GainState::Dead | GainState::Unstable)
    }

    /// Variance of the logarithm of the amplitudes of a channel that all have in common: the strength of a model is known no better than
    /// its shape, and an amplitude is the root of a visibility's.
    fn strength(&self, c: usize) -> f64 {
        let n = self.fitted.layout.satellites;
        if self.config.amplitude_scale == AmplitudeScale::UnitMean {
            return 0.0;
        }
        let mut parts = self.unexplained.of_gains[c * n..(c + 1) * n].to_vec();
        parts.sort_unstable_by(f64::total_cmp);
        // All pairs show together what is noise in those of most daughters.
        0.25 * parts.get(n / 2).copied().unwrap_or(0.0).max(self.unexplained.of_channels[c])
    }

    /// Variance of a gain's logarithm by errors of the model: those that are seen to stay for the interval; where the daughter's
    /// residuals show any, as much of them as may stay unseen.
    fn model(&self, k: usize) -> f64 {
        let Excess { model, model_unseen, model_whole, .. } = self.excess[k];
        model.max(model_unseen.min(self.unexplained.of_gains[k] * model_whole))
    }

    fn daughter(&self, n: usize) -> DaughterEstimate {
        let (layout, values) = (&self.fitted.layout, &self.fitted.found.values);
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
            (Some(a), Some(b)) => self.fitted.found.covariance[a * order + b],
            _ => 0.0,
        }
    }

    /// Standard deviation of the sum of a phase and what the clock turns, by noise, rad.
    fn phase_sigma(&self, c: usize, n: usize) -> f64 {
        let layout = &self.fitted.layout;
        let (phase, clock, per_ns) = (layout.phase(c, n), layout.clock(n), layout.per_ns(c));
        let variance = self.covariance(phase, phase)
            + 2.0 * per_ns * self.covariance(phase, clock)
            + per_ns * per_ns * self.covariance(clock, clock);
        variance.max(0.0).sqrt()
    }

    fn gain(&self, c: usize, n: usize) -> GainEstimate {
        let (layout, found) = (&self.fitted.layout, &self.fitted.found);
        let k = c * layout.satellites + n;
        let (own, excess) = (&self.fitted.own[k], &self.excess[k]);
        let reference = c * layout.satellites + layout.reference;
        let of_reference = match n == layout.reference {
            true => [0.0; 2],
            false => [self.excess[reference].scatter[1], self.model(reference)],
        };
        // One that has no part in the solution is told by its own data.
        let is_alone = self.fitted.dropped[k] && own.presence != SignalPresence::None;
        let (gain, noise) = match is_alone {
            true => {
                let sigma = own.signal().sqrt().recip().min(layout.phase_sigma.max(1.0));
                (own.gain, [sigma, if n == layout.reference { 0.0 } else { sigma }])
            }
            false => {
                let amplitude = layout.amplitude(c, n);
                let sigma = self.covariance(amplitude, amplitude).sqrt();
                (layout.gain(&found.values, c, n), [sigma, self.phase_sigma(c, n)])
            }
        };
        let is_relative = f64::from(u8::from(n != layout.reference));
        let scatter = [excess.scatter[0], excess.scatter[1] + of_reference[0]];
        let own_model = self.model(k);
        let model = [own_model + self.strength(c), is_relative * (own_model + of_reference[1])];
        let noise = noise.map(with_wraps);
        let total = |axis: usize| (noise[axis].powi(2) + scatter[axis] + model[axis]).sqrt();
        let [visibilities, outliers] = self.counts.by_gain[k];
        GainEstimate {
            frequency_hz: layout.frequencies_hz[c],
            amplitude: gain.norm(),
            amplitude_sigma: total(0),
            phase_deg: gain.arg().to_degrees(),
            phase_sigma_deg: if is_relative > 0.0 { total(1).to_degrees() } else { 0.0 },
            phase_scatter_deg: excess.scatter[1].sqrt().to_degrees(),
            unexplained: self.unexplained.of_gains[k],
            visibilities,
            outliers,
            data_s: self.counts.data_s[k],
            noise_sigma: [noise[0], is_relative * noise[1]],
            state: self.state(
                (c, n),
                gain.norm(),
                [noise[0].max(noise[1]), scatter[0].max(scatter[1]), model[1]],
            ),
        }
    }

    /// `noise` is a standard deviation, `scatter` and `model` are variances.
    fn state(&self, (c, n): (usize, usize), amplitude: f64, [noise, scatter, model]: [f64; 3]) -> GainState {
        let Self { config, fitted, .. } = self;
        let k = c * fitted.layout.satellites + n;
        let most = config.phase_sigma_deg_max.to_radians().powi(2);
        let is_dropped = fitted.dropped[k];
        match fitted.own[k].presence {
            SignalPresence::None => GainState::NoData,
            SignalPresence::Dead => GainState::Dead,
            SignalPresence::Other if is_dropped => GainState::PoorFit,
            SignalPresence::Weak | SignalPresence::Seen if is_dropped => GainState::Uncertain,
            _ if !fitted.found.converged => GainState::NotConverged,
            SignalPresence::Weak | SignalPresence::Other if !self.is_seen_together(n) => GainState::Uncertain,
            _ if amplitude < config.dead_amplitude => GainState::Dead,
            _ if noise * noise > most => GainState::Uncertain,
            _ if noise * noise + scatter > most => GainState::Unstable,
            _ if noise * noise + scatter + model > most => GainState::PoorFit,
            _ if self.unexplained.of_gains[k] > config.unexplained_max => GainState::PoorFit,
            _ => GainState::Good,
        }
    }

    /// Whether all channels in which a daughter is not seen have its signal together, with the gains of the solution.
    fn is_seen_together(&self, n: usize) -> bool {
        let fitted = self.fitted;
        let (mut signal, mut expected) = (0.0, 0.0);
        for c in 0..fitted.layout.channels() {
            let own = &fitted.own[c * fitted.layout.satellites + n];
            if !matches!(own.presence, SignalPresence::Seen | SignalPresence::None) {
                let gain = fitted.layout.gain(&fitted.found.values, c, n);
                signal += (gain.conj() * own.gain).re * own.information;
                expected += gain.norm_sqr() * own.information;
            }
        }
        signal >= SEEN_TOGETHER * f64::sqrt(expected)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn stated_deviations_hold_the_phase_of_a_vector_in_noise() {
        // The phase of a vector of length a in unit noise is beyond an angle p with a probability of erfc(a sin p / sqrt 2) at most; that is
        // the Gaussian one of four deviations where a sin p is 4.
        for a in [5.0_f64, 7.0, 10.0, 30.0] {
            let p = 4.0 * with_wraps(a.recip());
            assert!(a * p.sin() >= 4.0 - 1e-9, "{a}: {p}");
            // And is no more than a fifth above the bound.
            assert!(p * a / 4.0 < 1.2, "{a}: {p}");
        }
    }
}
