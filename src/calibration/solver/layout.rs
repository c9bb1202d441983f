//! The parameters of one solution: which there are, where each is in the vector that is solved for, and what they do to a pair.

use std::f64::consts::TAU;

use num_complex::Complex64;

use super::config::{AmplitudeScale, SolverConfig};
use super::sums::MODEL_TERMS;
use crate::units::Pair;

/// Parameters, and where each is in the vector that is solved for.
#[derive(Clone, Debug)]
pub(super) struct ParameterLayout {
    pub(super) satellites: usize,
    pub(super) frequencies_hz: Vec<f64>,
    pub(super) reference: usize,
    pub(super) amplitude_sigma: f64,
    pub(super) phase_sigma: f64,
    pub(super) clock_sigma_ns: f64,
    position_sigma_m: f64,
    pub(super) scale: AmplitudeScale,
}

/// Values of all parameters.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Values {
    /// By channel and daughter.
    pub(super) amplitude: Vec<f64>,
    /// By channel and daughter, rad.
    pub(super) phase: Vec<f64>,
    /// By daughter.
    pub(super) clock_ns: Vec<f64>,
    /// By daughter.
    pub(super) position_m: Vec<[f64; 3]>,
}
impl ParameterLayout {
    pub(super) fn new(config: &SolverConfig, satellites: usize, frequencies_hz: &[f64]) -> Self {
        Self {
            satellites,
            frequencies_hz: frequencies_hz.to_vec(),
            reference: (config.reference_daughter as usize)
                .saturating_sub(1)
                .min(satellites.saturating_sub(1)),
            amplitude_sigma: config.amplitude_sigma,
            phase_sigma: config.phase_sigma_deg.to_radians(),
            clock_sigma_ns: config.clock_sigma_ns,
            position_sigma_m: config.position_sigma_m,
            scale: config.amplitude_scale,
        }
    }

    pub(super) fn channels(&self) -> usize {
        self.frequencies_hz.len()
    }

    /// Number of parameters.
    pub(super) fn order(&self) -> usize {
        let (n, c) = (self.satellites, self.channels());
        let on = |sigma: f64| usize::from(sigma > 0.0);
        let relative = n.saturating_sub(1);
        on(self.amplitude_sigma) * n * c
            + on(self.phase_sigma) * relative * c
            + on(self.clock_sigma_ns) * relative
            + on(self.position_sigma_m) * relative * 3
    }

    /// Place of a daughter among those that are not the reference.
    fn relative(&self, daughter: usize) -> Option<usize> {
        (daughter != self.reference).then(|| daughter - usize::from(daughter > self.reference))
    }

    pub(super) fn amplitude(&self, channel: usize, daughter: usize) -> Option<usize> {
        (self.amplitude_sigma > 0.0).then_some(channel * self.satellites + daughter)
    }

    fn phases_from(&self) -> usize {
        if self.amplitude_sigma > 0.0 { self.satellites * self.channels() } else { 0 }
    }

    pub(super) fn phase(&self, channel: usize, daughter: usize) -> Option<usize> {
        let place = self.relative(daughter).filter(|_| self.phase_sigma > 0.0)?;
        Some(self.phases_from() + channel * (self.satellites - 1) + place)
    }

    fn clocks_from(&self) -> usize {
        let phases = if self.phase_sigma > 0.0 { (self.satellites - 1) * self.channels() } else { 0 };
        self.phases_from() + phases
    }

    pub(super) fn clock(&self, daughter: usize) -> Option<usize> {
        let place = self.relative(daughter).filter(|_| self.clock_sigma_ns > 0.0)?;
        Some(self.clocks_from() + place)
    }

    pub(super) fn position(&self, daughter: usize, axis: usize) -> Option<usize> {
        let place = self.relative(daughter).filter(|_| self.position_sigma_m > 0.0)?;
        let clocks = if self.clock_sigma_ns > 0.0 { self.satellites - 1 } else { 0 };
        Some(self.clocks_from() + clocks + 3 * place + axis)
    }

    /// Terms of the model that are used.
    pub(super) fn terms(&self) -> usize {
        if self.position_sigma_m > 0.0 { MODEL_TERMS } else { 1 }
    }

    /// Phase of a nanosecond of a clock, rad.
    pub(super) fn per_ns(&self, channel: usize) -> f64 {
        -TAU * self.frequencies_hz[channel] * 1e-9
    }

    /// No errors.
    pub(super) fn ideal(&self) -> Values {
        let (n, c) = (self.satellites, self.channels());
        Values {
            amplitude: vec![0.0; n * c],
            phase: vec![0.0; n * c],
            clock_ns: vec![0.0; n],
            position_m: vec![[0.0; 3]; n],
        }
    }

    /// Calls `each` with every parameter's place, value and prior's standard deviation.
    pub(super) fn for_each(&self, values: &Values, mut each: impl FnMut(usize, f64, f64)) {
        for n in 0..self.satellites {
            for c in 0..self.channels() {
                let k = c * self.satellites + n;
                if let Some(place) = self.amplitude(c, n) {
                    each(place, values.amplitude[k], self.amplitude_sigma);
                }
                if let Some(place) = self.phase(c, n) {
                    each(place, values.phase[k], self.phase_sigma);
                }
            }
            if let Some(place) = self.clock(n) {
                each(place, values.clock_ns[n], self.clock_sigma_ns);
            }
            for axis in 0..3 {
                if let Some(place) = self.position(n, axis) {
                    each(place, values.position_m[n][axis], self.position_sigma_m);
                }
            }
        }
    }

    /// Values after a step.
    pub(super) fn stepped(&self, values: &Values, step: &[f64]) -> Values {
        let mut out = values.clone();
        let at = |place: Option<usize>| place.map_or(0.0, |place| step[place]);
        for n in 0..self.satellites {
            for c in 0..self.channels() {
                let k = c * self.satellites + n;
                out.amplitude[k] += at(self.amplitude(c, n));
                out.phase[k] += at(self.phase(c, n));
            }
            out.clock_ns[n] += at(self.clock(n));
            for axis in 0..3 {
                out.position_m[n][axis] += at(self.position(n, axis));
            }
        }
        out
    }

    /// Gain of a daughter in a channel, clock included.
    pub(super) fn gain(&self, values: &Values, channel: usize, daughter: usize) -> Complex64 {
        let k = channel * self.satellites + daughter;
        let phase = values.phase[k] + self.per_ns(channel) * values.clock_ns[daughter];
        Complex64::from_polar(values.amplitude[k].exp(), phase)
    }

    /// The product of the gains of a pair, and the factors of the model's terms.
    pub(super) fn pair(
        &self,
        values: &Values,
        channel: usize,
        pair: Pair,
    ) -> (Complex64, [f64; MODEL_TERMS]) {
        let [i, j] = [pair.i, pair.j].map(usize::from);
        let gain = self.gain(values, channel, i) * self.gain(values, channel, j).conj();
        let ([a, b, c], [d, e, f]) = (values.position_m[i], values.position_m[j]);
        (gain, [1.0, a, b, c, d, e, f])
    }
}
