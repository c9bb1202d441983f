//! Gauss-Newton over the physical parameters of one solution.
//!
//! A visibility is `G (f_0 + sum_a e_ia f_a + sum_a e_ja f_a+3)`, `G = exp(a_i + a_j + i (psi_i - psi_j))`,
//! `psi_n = p_n - 2 pi nu tau_n`: logarithmic amplitude a and phase p by channel, clock tau and position e of a daughter.
//! Priors are Gaussian about zero. The reference daughter has no phase, clock and position: those of the others are relative
//! to it.

use num_complex::Complex64;

use super::config::AmplitudeScale;
use super::dense::DenseFactor;
use super::layout::{ParameterLayout, Values};
use super::sums::{MODEL_TERMS, PairSums};

/// Standard deviation of the mean logarithmic amplitude where it is fixed to zero.
const MEAN_SIGMA: f64 = 1e-6;

/// Change of every parameter, in units of its own standard deviation, below which an iteration has converged.
const CONVERGED: f64 = 1e-3;

/// Fall of the cost, with positions, that is not worth another step: a hundredth of a standard deviation.
const PROMISED: f64 = 1e-4;

/// What Gauss-Newton found.
pub(super) struct NewtonFit {
    pub(super) values: Values,
    /// Inverse of the Fisher information with the priors, row after row.
    pub(super) covariance: Vec<f64>,
    pub(super) iterations: usize,
    pub(super) converged: bool,
}

/// Keeps positions near the point about which the model is linear. The term vanishes there, and is not part of the prior.
pub(super) struct PositionPrior<'a> {
    pub(super) position_m: &'a [[f64; 3]],
    /// Along each axis.
    pub(super) sigma_m: f64,
}

impl ParameterLayout {
    /// Calls `each` with the place of each component of a position, its distance from the near one, and the deviation.
    fn for_each_near(
        &self,
        values: &Values,
        near: Option<&PositionPrior<'_>>,
        mut each: impl FnMut(usize, f64, f64),
    ) {
        let Some(near) = near else { return };
        for (n, (now_m, near_m)) in values.position_m.iter().zip(near.position_m).enumerate() {
            for axis in 0..3 {
                if let Some(place) = self.position(n, axis) {
                    each(place, now_m[axis] - near_m[axis], near.sigma_m);
                }
            }
        }
    }

    /// Sum of squared residuals in units of their noise, with priors.
    pub(super) fn cost(&self, values: &Values, sums: &[PairSums], near: Option<&PositionPrior<'_>>) -> f64 {
        let mut cost = 0.0;
        for sums in sums {
            let (gain, u) = self.pair(values, sums.channel, sums.pair);
            let along: Complex64 = (0..MODEL_TERMS).map(|k| u[k] * sums.cross[k]).sum();
            let gram = sums.gram_of(&u);
            let model: f64 = (0..MODEL_TERMS).map(|k| u[k] * gram[k].re).sum();
            cost += sums.power - 2.0 * (gain.conj() * along).re + gain.norm_sqr() * model;
        }
        self.for_each_near(values, near, |_, away, sigma| cost += (away / sigma).powi(2));
        self.with_priors(values, cost)
    }

    /// A cost with squared parameters in units of their priors.
    pub(super) fn with_priors(&self, values: &Values, mut cost: f64) -> f64 {
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
    pub(super) fn normal(
        &self,
        values: &Values,
        sums: &[PairSums],
        near: Option<&PositionPrior<'_>>,
    ) -> (Vec<f64>, Vec<f64>) {
        let order = self.order();
        let (mut matrix, mut right) = (vec![0.0; order * order], vec![0.0; order]);
        for sums in sums {
            self.add_pair(values, sums, &mut matrix, &mut right);
        }
        self.for_each(values, |place, value, sigma| {
            matrix[place * order + place] += sigma.powi(-2);
            right[place] -= value * sigma.powi(-2);
        });
        self.for_each_near(values, near, |place, away, sigma| {
            matrix[place * order + place] += sigma.powi(-2);
            right[place] -= away * sigma.powi(-2);
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
        let (gain, u) = self.pair(values, sums.channel, sums.pair);
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

    /// Iterates from values to the least cost.
    pub(super) fn minimise(
        &self,
        mut values: Values,
        sums: &[PairSums],
        near: Option<&PositionPrior<'_>>,
        iterations_max: usize,
    ) -> NewtonFit {
        let order = self.order();
        if self.phase_sigma <= 0.0 {
            values.phase.fill(0.0);
        }
        if self.amplitude_sigma <= 0.0 {
            values.amplitude.fill(0.0);
        }
        let (mut cost, mut damping, mut converged) = (self.cost(&values, sums, near), 0.0, false);
        let mut iterations = 0;
        let mut covariance = vec![0.0; order * order];
        while iterations < iterations_max {
            iterations += 1;
            let (matrix, right) = self.normal(&values, sums, near);
            let mut damped = matrix.clone();
            for k in 0..order {
                damped[k * order + k] *= 1.0 + damping;
            }
            let Some(factor) = DenseFactor::new(&damped, order) else { break };
            let mut step = right.clone();
            factor.solve(&mut step);
            // What the step promises: half of it is what the cost is above its least.
            let promised: f64 = step.iter().zip(&right).map(|(step, right)| step * right).sum();
            let next = self.stepped(&values, &step);
            let next_cost = self.cost(&next, sums, near);
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
            // Where data leave a direction open, as one wave does to positions across it, rounding moves values along it for ever.
            let is_least = self.terms() > 1 && promised < PROMISED;
            if (moved < CONVERGED || is_least) && damping <= 1.0 {
                converged = true;
                break;
            }
            damping = if damping > 0.01 { 0.4 * damping } else { 0.0 };
        }
        let (matrix, _) = self.normal(&values, sums, None);
        match DenseFactor::new(&matrix, order) {
            Some(factor) => covariance = factor.inverse(),
            None => converged = false,
        }
        NewtonFit { values, covariance, iterations, converged }
    }
}
