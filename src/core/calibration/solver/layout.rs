//! Parameters of one solution: their order in the solution vector, and their effect on a pair.

use std::f64::consts::TAU;

use num_complex::Complex64;

use super::config::{AmplitudeScale, SolverConfig};
use super::sums::MODEL_TERMS;
use crate::units::Pair;

/// Which parameters are solved for, and their indices in the solution vector.
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
pub(super) struct ParameterValues {
    /// Log amplitudes, by channel, then daughter.
    pub(super) amplitude: Vec<f64>,
    /// Phases, by channel, then daughter, rad.
    pub(super) phase: Vec<f64>,
    /// Clocks, by daughter.
    pub(super) clock_ns: Vec<f64>,
    /// Position offsets, by daughter.
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
        let count_if_solved = |sigma: f64| usize::from(sigma > 0.0);
        let others = n.saturating_sub(1);
        count_if_solved(self.amplitude_sigma) * n * c
            + count_if_solved(self.phase_sigma) * others * c
            + count_if_solved(self.clock_sigma_ns) * others
            + count_if_solved(self.position_sigma_m) * others * 3
    }

    /// Index of a daughter among those that are not the reference.
    fn relative_index(&self, daughter: usize) -> Option<usize> {
        (daughter != self.reference).then(|| daughter - usize::from(daughter > self.reference))
    }

    pub(super) fn amplitude(&self, channel: usize, daughter: usize) -> Option<usize> {
        (self.amplitude_sigma > 0.0).then_some(channel * self.satellites + daughter)
    }

    fn first_phase(&self) -> usize {
        if self.amplitude_sigma > 0.0 { self.satellites * self.channels() } else { 0 }
    }

    pub(super) fn phase(&self, channel: usize, daughter: usize) -> Option<usize> {
        let index = self.relative_index(daughter).filter(|_| self.phase_sigma > 0.0)?;
        Some(self.first_phase() + channel * (self.satellites - 1) + index)
    }

    fn first_clock(&self) -> usize {
        let phases = if self.phase_sigma > 0.0 { (self.satellites - 1) * self.channels() } else { 0 };
        self.first_phase() + phases
    }

    pub(super) fn clock(&self, daughter: usize) -> Option<usize> {
        let index = self.relative_index(daughter).filter(|_| self.clock_sigma_ns > 0.0)?;
        Some(self.first_clock() + index)
    }

    pub(super) fn position(&self, daughter: usize, axis: usize) -> Option<usize> {
        let index = self.relative_index(daughter).filter(|_| self.position_sigma_m > 0.0)?;
        let clocks = if self.clock_sigma_ns > 0.0 { self.satellites - 1 } else { 0 };
        Some(self.first_clock() + clocks + 3 * index + axis)
    }

    /// Whether positions are solved for.
    pub(super) fn solves_positions(&self) -> bool {
        self.position_sigma_m > 0.0
    }

    /// Number of model terms that are used.
    pub(super) fn model_terms(&self) -> usize {
        if self.position_sigma_m > 0.0 { MODEL_TERMS } else { 1 }
    }

    /// Phase per nanosecond of a clock, rad.
    pub(super) fn rad_per_ns(&self, channel: usize) -> f64 {
        -TAU * self.frequencies_hz[channel] * 1e-9
    }

    /// Values without errors.
    pub(super) fn ideal(&self) -> ParameterValues {
        let (n, c) = (self.satellites, self.channels());
        ParameterValues {
            amplitude: vec![0.0; n * c],
            phase: vec![0.0; n * c],
            clock_ns: vec![0.0; n],
            position_m: vec![[0.0; 3]; n],
        }
    }

    /// Calls `visit` with the index, value and prior standard deviation of every parameter.
    pub(super) fn for_each_prior(&self, values: &ParameterValues, mut visit: impl FnMut(usize, f64, f64)) {
        for n in 0..self.satellites {
            for c in 0..self.channels() {
                let k = c * self.satellites + n;
                if let Some(index) = self.amplitude(c, n) {
                    visit(index, values.amplitude[k], self.amplitude_sigma);
                }
                if let Some(index) = self.phase(c, n) {
                    visit(index, values.phase[k], self.phase_sigma);
                }
            }
            if let Some(index) = self.clock(n) {
                visit(index, values.clock_ns[n], self.clock_sigma_ns);
            }
            for axis in 0..3 {
                if let Some(index) = self.position(n, axis) {
                    visit(index, values.position_m[n][axis], self.position_sigma_m);
                }
            }
        }
    }

    /// Values after adding a step.
    pub(super) fn values_after(&self, values: &ParameterValues, step: &[f64]) -> ParameterValues {
        let mut out = values.clone();
        let step_at = |index: Option<usize>| index.map_or(0.0, |index| step[index]);
        for n in 0..self.satellites {
            for c in 0..self.channels() {
                let k = c * self.satellites + n;
                out.amplitude[k] += step_at(self.amplitude(c, n));
                out.phase[k] += step_at(self.phase(c, n));
            }
            out.clock_ns[n] += step_at(self.clock(n));
            for axis in 0..3 {
                out.position_m[n][axis] += step_at(self.position(n, axis));
            }
        }
        out
    }

    /// Gain of a daughter in a channel, clock included.
    pub(super) fn gain(&self, values: &ParameterValues, channel: usize, daughter: usize) -> Complex64 {
        let k = channel * self.satellites + daughter;
        let phase = values.phase[k] + self.rad_per_ns(channel) * values.clock_ns[daughter];
        Complex64::from_polar(values.amplitude[k].exp(), phase)
    }

    /// Product of the gains of a pair, and the factors of the model's terms.
    pub(super) fn pair(
        &self,
        values: &ParameterValues,
        channel: usize,
        pair: Pair,
    ) -> (Complex64, [f64; MODEL_TERMS]) {
        let [i, j] = [pair.i, pair.j].map(usize::from);
        let gain = self.gain(values, channel, i) * self.gain(values, channel, j).conj();
        let ([a, b, c], [d, e, f]) = (values.position_m[i], values.position_m[j]);
        (gain, [1.0, a, b, c, d, e, f])
    }
}
