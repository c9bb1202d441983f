//! Gauss-Newton over the physical parameters of one solution.
//!
//! A visibility is `G (f_0 + sum_a e_ia f_a + sum_a e_ja f_a+3)`, `G = exp(a_i + a_j + i (psi_i - psi_j))`,
//! `psi_n = p_n - 2 pi nu tau_n`: logarithmic amplitude a and phase p by channel, clock tau and position e of a daughter.
//! Priors are Gaussian about zero. The reference daughter has no phase, clock and position: those of the others are relative
//! to it.

use std::f64::consts::TAU;

use num_complex::Complex64;

use super::config::{AmplitudeScale, SolverConfig};
use super::dense::DenseFactor;
use super::sums::{MODEL_TERMS, PairSums};

/// Standard deviation of the mean logarithmic amplitude where it is fixed to zero.
const MEAN_SIGMA: f64 = 1e-6;

/// Change of every parameter, in units of its own standard deviation, below which an iteration has converged.
const CONVERGED: f64 = 1e-3;

/// Iterations for starting values by channel.
const START_ITERATIONS: usize = 200;

/// Parameters, and where each is in the vector that is solved for.
#[derive(Clone, Debug)]
pub(super) struct ParameterLayout {
    pub(super) satellites: usize,
    pub(super) frequencies_hz: Vec<f64>,
    reference: usize,
    amplitude_sigma: f64,
    phase_sigma: f64,
    clock_sigma_ns: f64,
    position_sigma_m: f64,
    scale: AmplitudeScale,
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

/// What Gauss-Newton found.
pub(super) struct Found {
    pub(super) values: Values,
    /// Inverse of the Fisher information with the priors, row after row.
    pub(super) covariance: Vec<f64>,
    pub(super) iterations: usize,
    pub(super) converged: bool,
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

    fn channels(&self) -> usize {
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
    fn for_each(&self, values: &Values, mut each: impl FnMut(usize, f64, f64)) {
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
    fn stepped(&self, values: &Values, step: &[f64]) -> Values {
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
    pub(super) fn pair(&self, values: &Values, sums: &PairSums) -> (Complex64, [f64; MODEL_TERMS]) {
        let [i, j] = [sums.pair.i, sums.pair.j].map(usize::from);
        let gain = self.gain(values, sums.channel, i) * self.gain(values, sums.channel, j).conj();
        let ([a, b, c], [d, e, f]) = (values.position_m[i], values.position_m[j]);
        (gain, [1.0, a, b, c, d, e, f])
    }

    /// Sum of squared residuals in units of their noise, and of squared parameters in units of their priors.
    fn cost(&self, values: &Values, sums: &[PairSums]) -> f64 {
        let mut cost = 0.0;
        for sums in sums {
            let (gain, u) = self.pair(values, sums);
            let along: Complex64 = (0..MODEL_TERMS).map(|k| u[k] * sums.cross[k]).sum();
            let gram = sums.gram_of(&u);
            let model: f64 = (0..MODEL_TERMS).map(|k| u[k] * gram[k].re).sum();
            cost += sums.power - 2.0 * (gain.conj() * along).re + gain.norm_sqr() * model;
        }
        self.for_each(values, |_, value, sigma| cost += (value / sigma).powi(2));
        cost + self.means(values).map(|mean| (mean / MEAN_SIGMA).powi(2)).sum::<f64>()
    }

    /// Mean logarithmic amplitude of each channel, where it is fixed.
    fn means<'a>(&'a self, values: &'a Values) -> impl Iterator<Item = f64> + 'a {
        let fixed = self.scale == AmplitudeScale::UnitMean && self.amplitude_sigma > 0.0;
        let rows = values.amplitude.chunks(self.satellites).filter(move |_| fixed);
        rows.map(|row| row.iter().sum::<f64>() / row.len() as f64)
    }

    /// Normal matrix (row after row) and right side of a step.
    fn normal(&self, values: &Values, sums: &[PairSums]) -> (Vec<f64>, Vec<f64>) {
        let order = self.order();
        let (mut matrix, mut right) = (vec![0.0; order * order], vec![0.0; order]);
        for sums in sums {
            self.add_pair(values, sums, &mut matrix, &mut right);
        }
        self.for_each(values, |place, value, sigma| {
            matrix[place * order + place] += sigma.powi(-2);
            right[place] -= value * sigma.powi(-2);
        });
        for (channel, mean) in self.means(values).enumerate() {
            let share = 1.0 / self.satellites as f64;
            let places: Vec<usize> =
                (0..self.satellites).filter_map(|n| self.amplitude(channel, n)).collect();
            for &a in &places {
                right[a] -= share * mean * MEAN_SIGMA.powi(-2);
                for &b in &places {
                    matrix[a * order + b] += share * share * MEAN_SIGMA.powi(-2);
                }
            }
        }
        (matrix, right)
    }

    fn add_pair(&self, values: &Values, sums: &PairSums, matrix: &mut [f64], right: &mut [f64]) {
        let order = self.order();
        let [i, j] = [sums.pair.i, sums.pair.j].map(usize::from);
        let (gain, u) = self.pair(values, sums);
        let gram = sums.gram_of(&u);
        let power = gain.norm_sqr();
        let model: f64 = power * (0..MODEL_TERMS).map(|k| u[k] * gram[k].re).sum::<f64>();
        let along: Complex64 =
            gain.conj() * (0..MODEL_TERMS).map(|k| u[k] * sums.cross[k]).sum::<Complex64>();
        // Derivatives by the pair's own coordinates: logarithmic amplitude, phase, six offsets.
        let mut own = [[0.0; 2 + 6]; 2 + 6];
        let mut slope = [0.0; 2 + 6];
        (own[0][0], own[1][1]) = (model, model);
        (slope[0], slope[1]) = (along.re - model, along.im);
        let offsets = self.terms() - 1;
        for k in 0..offsets {
            let with = power * gram[k + 1];
            (own[0][k + 2], own[1][k + 2]) = (with.re, with.im);
            (own[k + 2][0], own[k + 2][1]) = (with.re, with.im);
            slope[k + 2] = (gain.conj() * sums.cross[k + 1]).re - with.re;
            for l in 0..offsets {
                own[k + 2][l + 2] = power * sums.gram[k + 1][l + 1].re;
            }
        }
        // Each coordinate is a sum of parameters.
        let c = sums.channel;
        let mut parts: Vec<(usize, usize, f64)> = Vec::with_capacity(12);
        let mut part = |coordinate: usize, place: Option<usize>, factor: f64| {
            parts.extend(place.map(|place| (coordinate, place, factor)));
        };
        for (daughter, sign) in [(i, 1.0), (j, -1.0)] {
            part(0, self.amplitude(c, daughter), 1.0);
            part(1, self.phase(c, daughter), sign);
            part(1, self.clock(daughter), sign * self.per_ns(c));
        }
        for axis in 0..offsets / 2 {
            part(2 + axis, self.position(i, axis), 1.0);
            part(5 + axis, self.position(j, axis), 1.0);
        }
        for &(p, a, x) in &parts {
            right[a] += x * slope[p];
            for &(q, b, y) in &parts {
                matrix[a * order + b] += x * y * own[p][q];
            }
        }
    }

    /// Starting values: gains of every channel alone by alternating least squares (StEFCal, Salvini & Wijnholds 2014,
    /// A&A 571, A97), their phases shared between clocks and phases.
    pub(super) fn start(&self, sums: &[PairSums]) -> Values {
        let mut values = self.ideal();
        for c in 0..self.channels() {
            let gains = self.stefcal(sums, c);
            let reference = gains[self.reference];
            let turn =
                if reference.norm() > 0.0 { reference.conj() / reference.norm() } else { Complex64::ONE };
            for (n, gain) in gains.into_iter().enumerate() {
                let k = c * self.satellites + n;
                if self.amplitude_sigma > 0.0 {
                    // Within what the prior can hold; Gauss-Newton goes on from there.
                    let most = 4.0 * self.amplitude_sigma;
                    values.amplitude[k] = gain.norm().max(1e-9).ln().clamp(-most, most);
                }
                values.phase[k] = (gain * turn).arg();
            }
        }
        self.share_clocks(&mut values);
        values
    }

    fn stefcal(&self, sums: &[PairSums], channel: usize) -> Vec<Complex64> {
        let n = self.satellites;
        let mut gains = vec![Complex64::ONE; n];
        for round in 0..START_ITERATIONS {
            let (mut above, mut below) = (vec![Complex64::ZERO; n], vec![0.0; n]);
            for sums in sums.iter().filter(|sums| sums.channel == channel) {
                let [i, j] = [sums.pair.i, sums.pair.j].map(usize::from);
                let model = sums.gram[0][0].re;
                // V = g_i conj(g_j) M.
                above[i] += sums.cross[0] * gains[j];
                below[i] += model * gains[j].norm_sqr();
                above[j] += sums.cross[0].conj() * gains[i];
                below[j] += model * gains[i].norm_sqr();
            }
            let mut change = 0.0_f64;
            for k in 0..n {
                let found = if below[k] > 0.0 { above[k] / below[k] } else { Complex64::ONE };
                let next = if round % 2 == 1 { 0.5 * (found + gains[k]) } else { found };
                change = change.max((next - gains[k]).norm());
                gains[k] = next;
            }
            if change < 1e-8 {
                break;
            }
        }
        gains
    }

    /// Moves what a clock explains best from the phases of a daughter to its clock.
    fn share_clocks(&self, values: &mut Values) {
        if self.clock_sigma_ns <= 0.0 {
            return;
        }
        let fastest = (0..self.channels()).map(|c| self.per_ns(c).abs()).fold(0.0, f64::max);
        // A tenth of a radian apart, to four standard deviations.
        let reach = (40.0 * self.clock_sigma_ns * fastest).ceil().min(1e5) as i64;
        let sigma = if self.phase_sigma > 0.0 { self.phase_sigma.min(1.0) } else { 0.1 };
        for n in 0..self.satellites {
            if self.clock(n).is_none() {
                continue;
            }
            let left = |clock_ns: f64, c: usize| {
                let phase = values.phase[c * self.satellites + n] - self.per_ns(c) * clock_ns;
                Complex64::cis(phase).arg()
            };
            let cost = |clock_ns: f64| {
                let phases: f64 = (0..self.channels()).map(|c| (left(clock_ns, c) / sigma).powi(2)).sum();
                phases + (clock_ns / self.clock_sigma_ns).powi(2)
            };
            let candidates = (-reach..=reach).map(|k| 0.1 * k as f64 / fastest);
            let best = candidates.min_by(|a, b| cost(*a).total_cmp(&cost(*b))).unwrap_or(0.0);
            let phases: Vec<f64> = (0..self.channels()).map(|c| left(best, c)).collect();
            values.clock_ns[n] = best;
            for (c, phase) in phases.into_iter().enumerate() {
                values.phase[c * self.satellites + n] = phase;
            }
        }
    }

    /// Iterates from values to the least cost.
    pub(super) fn minimise(&self, mut values: Values, sums: &[PairSums], iterations_max: usize) -> Found {
        let order = self.order();
        if self.phase_sigma <= 0.0 {
            values.phase.fill(0.0);
        }
        if self.amplitude_sigma <= 0.0 {
            values.amplitude.fill(0.0);
        }
        let (mut cost, mut damping, mut converged) = (self.cost(&values, sums), 0.0, false);
        let mut iterations = 0;
        let mut covariance = vec![0.0; order * order];
        while iterations < iterations_max {
            iterations += 1;
            let (matrix, right) = self.normal(&values, sums);
            let mut damped = matrix.clone();
            for k in 0..order {
                damped[k * order + k] *= 1.0 + damping;
            }
            let Some(factor) = DenseFactor::new(&damped, order) else { break };
            let mut step = right;
            factor.solve(&mut step);
            let next = self.stepped(&values, &step);
            let next_cost = self.cost(&next, sums);
            // In units of the standard deviation that each would have if the others were known: never too large.
            let moved = (0..order).map(|k| step[k].abs() * matrix[k * order + k].sqrt()).fold(0.0, f64::max);
            // Costs are sums of large numbers: their rounding is no rise.
            let rounding = 1e-12 * sums.iter().map(|sums| sums.power).sum::<f64>();
            if next_cost > cost + rounding || next_cost.is_nan() {
                damping = (8.0 * damping).max(0.05);
                if damping > 1e12 {
                    break;
                }
                continue;
            }
            (values, cost) = (next, next_cost);
            // A damping of one halves a step: what is left is as small as the step then.
            if moved < CONVERGED && damping <= 1.0 {
                converged = true;
                break;
            }
            damping = if damping > 0.01 { 0.4 * damping } else { 0.0 };
        }
        let (matrix, _) = self.normal(&values, sums);
        match DenseFactor::new(&matrix, order) {
            Some(factor) => covariance = factor.inverse(),
            None => converged = false,
        }
        Found { values, covariance, iterations, converged }
    }
}
