//! Gauss-Newton over the physical parameters of one solution.
//!
//! A visibility is `G (f_0 + sum_a e_ia f_a + sum_a e_ja f_a+3)`, `G = exp(a_i + a_j + i (psi_i - psi_j))`, `psi_n =
//! p_n - 2 pi nu tau_n`, with log amplitude a and phase p by channel, clock tau and position error e by daughter.
//! Priors are Gaussian about zero. The reference daughter has no phase, clock and position parameters: those of the
//! others are relative to it.

use num_complex::Complex64;

use super::config::AmplitudeScale;
use super::layout::{ParameterLayout, ParameterValues};
use super::sums::{MODEL_TERMS, PairSums};
use crate::numerics::DenseFactor;

/// Standard deviation of the mean log amplitude where it is fixed to zero.
const MEAN_SIGMA: f64 = 1e-6;

/// Largest change of a parameter, in units of its own standard deviation, at convergence.
const CONVERGED: f64 = 1e-3;

/// Predicted decrease of the cost, with positions, below which a fit has converged: a hundredth of a standard
/// deviation.
const DECREASE_MIN: f64 = 1e-4;

/// Result of Gauss-Newton.
pub(super) struct NewtonFit {
    pub(super) values: ParameterValues,
    /// Inverse of the Fisher information with the priors, row by row.
    pub(super) covariance: Vec<f64>,
    pub(super) iterations: usize,
    pub(super) converged: bool,
}

/// Soft trust region of positions about the point where the model is linearised. Its term vanishes there, and is not
/// part of the covariance.
pub(super) struct TrustRegion<'a> {
    pub(super) centre_m: &'a [[f64; 3]],
    /// Standard deviation along each axis.
    pub(super) sigma_m: f64,
}

impl ParameterLayout {
    /// Calls `visit` with the index of each position component, its distance from the centre of the trust region, and
    /// the standard deviation.
    fn for_each_in_trust_region(
        &self,
        values: &ParameterValues,
        trust_region: Option<&TrustRegion<'_>>,
        mut visit: impl FnMut(usize, f64, f64),
    ) {
        let Some(trust_region) = trust_region else { return };
        for (n, (now_m, centre_m)) in values.position_m.iter().zip(trust_region.centre_m).enumerate() {
            for axis in 0..3 {
                if let Some(index) = self.position(n, axis) {
                    visit(index, now_m[axis] - centre_m[axis], trust_region.sigma_m);
                }
            }
        }
    }

    /// Sum of squared residuals in units of their noise, plus priors.
    pub(super) fn cost(
        &self,
        values: &ParameterValues,
        sums: &[PairSums],
        trust_region: Option<&TrustRegion<'_>>,
    ) -> f64 {
        let mut cost = 0.0;
        for sums in sums {
            let (gain, u) = self.pair(values, sums.channel, sums.pair);
            let projection: Complex64 = (0..MODEL_TERMS).map(|k| u[k] * sums.cross[k]).sum();
            let gram = sums.gram_times(&u);
            let model: f64 = (0..MODEL_TERMS).map(|k| u[k] * gram[k].re).sum();
            cost += sums.power - 2.0 * (gain.conj() * projection).re + gain.norm_sqr() * model;
        }
        self.for_each_in_trust_region(values, trust_region, |_, away, sigma| cost += (away / sigma).powi(2));
        self.with_priors(values, cost)
    }

    /// Adds to a cost the squares of the parameters in units of their priors.
    pub(super) fn with_priors(&self, values: &ParameterValues, mut cost: f64) -> f64 {
        self.for_each_prior(values, |_, value, sigma| cost += (value / sigma).powi(2));
        cost + self.mean_amplitudes(values).map(|mean| (mean / MEAN_SIGMA).powi(2)).sum::<f64>()
    }

    /// Mean log amplitude of each channel, where it is fixed.
    fn mean_amplitudes<'a>(&'a self, values: &'a ParameterValues) -> impl Iterator<Item = f64> + 'a {
        let fixed = self.scale == AmplitudeScale::UnitMean && self.amplitude_sigma > 0.0;
        let rows = values.amplitude.chunks(self.satellites).filter(move |_| fixed);
        rows.map(|row| row.iter().sum::<f64>() / row.len() as f64)
    }

    /// Normal matrix (row by row) and right-hand side of a step.
    pub(super) fn normal(
        &self,
        values: &ParameterValues,
        sums: &[PairSums],
        trust_region: Option<&TrustRegion<'_>>,
    ) -> (Vec<f64>, Vec<f64>) {
        let order = self.order();
        let (mut matrix, mut right) = (vec![0.0; order * order], vec![0.0; order]);
        for sums in sums {
            self.add_pair(values, sums, &mut matrix, &mut right);
        }
        self.for_each_prior(values, |index, value, sigma| {
            matrix[index * order + index] += sigma.powi(-2);
            right[index] -= value * sigma.powi(-2);
        });
        self.for_each_in_trust_region(values, trust_region, |index, away, sigma| {
            matrix[index * order + index] += sigma.powi(-2);
            right[index] -= away * sigma.powi(-2);
        });
        for (channel, mean) in self.mean_amplitudes(values).enumerate() {
            let share = 1.0 / self.satellites as f64;
            let indices: Vec<usize> =
                (0..self.satellites).filter_map(|n| self.amplitude(channel, n)).collect();
            for &a in &indices {
                right[a] -= share * mean * MEAN_SIGMA.powi(-2);
                for &b in &indices {
                    matrix[a * order + b] += share * share * MEAN_SIGMA.powi(-2);
                }
            }
        }
        (matrix, right)
    }

    fn add_pair(&self, values: &ParameterValues, sums: &PairSums, matrix: &mut [f64], right: &mut [f64]) {
        let order = self.order();
        let [i, j] = [sums.pair.i, sums.pair.j].map(usize::from);
        let (gain, u) = self.pair(values, sums.channel, sums.pair);
        let gram = sums.gram_times(&u);
        let power = gain.norm_sqr();
        let model: f64 = power * (0..MODEL_TERMS).map(|k| u[k] * gram[k].re).sum::<f64>();
        let projection: Complex64 =
            gain.conj() * (0..MODEL_TERMS).map(|k| u[k] * sums.cross[k]).sum::<Complex64>();
        // Second derivatives by the pair's own coordinates: log amplitude, phase, six offsets.
        let mut curvature = [[0.0; 2 + 6]; 2 + 6];
        let mut slope = [0.0; 2 + 6];
        (curvature[0][0], curvature[1][1]) = (model, model);
        (slope[0], slope[1]) = (projection.re - model, projection.im);
        let offsets = self.model_terms() - 1;
        for k in 0..offsets {
            let cross_term = power * gram[k + 1];
            (curvature[0][k + 2], curvature[1][k + 2]) = (cross_term.re, cross_term.im);
            (curvature[k + 2][0], curvature[k + 2][1]) = (cross_term.re, cross_term.im);
            slope[k + 2] = (gain.conj() * sums.cross[k + 1]).re - cross_term.re;
            for l in 0..offsets {
                curvature[k + 2][l + 2] = power * sums.gram[k + 1][l + 1].re;
            }
        }
        // Each coordinate is a linear combination of parameters.
        let c = sums.channel;
        let mut coordinate_terms: Vec<(usize, usize, f64)> = Vec::with_capacity(12);
        let mut add_term = |coordinate: usize, index: Option<usize>, factor: f64| {
            coordinate_terms.extend(index.map(|index| (coordinate, index, factor)));
        };
        for (daughter, sign) in [(i, 1.0), (j, -1.0)] {
            add_term(0, self.amplitude(c, daughter), 1.0);
            add_term(1, self.phase(c, daughter), sign);
            add_term(1, self.clock(daughter), sign * self.rad_per_ns(c));
        }
        for axis in 0..offsets / 2 {
            add_term(2 + axis, self.position(i, axis), 1.0);
            add_term(5 + axis, self.position(j, axis), 1.0);
        }
        for &(p, a, x) in &coordinate_terms {
            right[a] += x * slope[p];
            for &(q, b, y) in &coordinate_terms {
                matrix[a * order + b] += x * y * curvature[p][q];
            }
        }
    }

    /// Iterates from `values` to the minimum of the cost.
    pub(super) fn minimise(
        &self,
        mut values: ParameterValues,
        sums: &[PairSums],
        trust_region: Option<&TrustRegion<'_>>,
        iterations_max: usize,
    ) -> NewtonFit {
        let order = self.order();
        if self.phase_sigma <= 0.0 {
            values.phase.fill(0.0);
        }
        if self.amplitude_sigma <= 0.0 {
            values.amplitude.fill(0.0);
        }
        let (mut cost, mut damping, mut converged) = (self.cost(&values, sums, trust_region), 0.0, false);
        let mut iterations = 0;
        let mut covariance = vec![0.0; order * order];
        while iterations < iterations_max {
            iterations += 1;
            let (matrix, right) = self.normal(&values, sums, trust_region);
            let mut damped = matrix.clone();
            for k in 0..order {
                damped[k * order + k] *= 1.0 + damping;
            }
            let Some(factor) = DenseFactor::new(&damped, order) else { break };
            let mut step = right.clone();
            factor.solve(&mut step);
            // Predicted decrease: half of it is the distance of the cost from its minimum.
            let predicted_decrease: f64 = step.iter().zip(&right).map(|(step, right)| step * right).sum();
            let next = self.values_after(&values, &step);
            let next_cost = self.cost(&next, sums, trust_region);
            // In units of the standard deviation with all other parameters known: never too large.
            let moved = (0..order).map(|k| step[k].abs() * matrix[k * order + k].sqrt()).fold(0.0, f64::max);
            // Costs are sums of large numbers: a rise by rounding does not count.
            let rounding = 1e-12 * sums.iter().map(|sums| sums.power).sum::<f64>();
            if next_cost > cost + rounding || next_cost.is_nan() {
                damping = (8.0 * damping).max(0.05);
                if damping > 1e12 {
                    break;
                }
                continue;
            }
            (values, cost) = (next, next_cost);
            // A damping of one halves a step, so the remaining distance is as small as the step.
            // In a direction that the data do not constrain, as positions perpendicular to a single wave, rounding
            // moves values indefinitely.
            let is_at_minimum = self.model_terms() > 1 && predicted_decrease < DECREASE_MIN;
            if (moved < CONVERGED || is_at_minimum) && damping <= 1.0 {
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
