//! The sky's angular power from the data: the C_l that make the data most likely, whose inverse is R (empirical Bayes).
//!
//! With `b = A x + n`, n of covariance A, and a Gaussian sky of power C_l(theta), `R_l = 1 / C_l`,
//!
//! ```text
//! ln p(b | theta) = 1/2 b.(A + R)^-1 b + 1/2 ln det R - 1/2 ln det(A + R) + const,
//! its gradient in ln C_l:  1/2 (R_l |x_l|^2 - gamma_l),   gamma_l = (2 l + 1) - R_l Tr_l (A + R)^-1
//! ```
//!
//! x the solution, gamma_l the number of coefficients that the data decide (MacKay 1992). Where A is known as blocks (exactly, or as an
//! approximation that preconditions it) all of it costs little. With the true A a round solves for x, and the blocks stand for A with
//! the data that would make x their solution, and with the true traces where a draw tells them: both have the same gradient at theta, so
//! that where rounds end is the maximum for the true A.
//!
//! A map ends at some degree and the sky does not. What the map leaves of the data is known (`|V - B x|^2` from sums): where it exceeds the
//! noise, by a factor s^2, it counts as noise, and all of this is done for data divided by s.

mod blocks;
mod draws;
mod gibbs;
mod knots;
mod rounds;
#[cfg(test)]
mod tests;

use std::f64::consts::PI;

use faer::linalg::solvers::DenseSolveCore;
use faer::{Mat, Side};
use serde::Serialize;

pub(super) use blocks::{Block, Factors, multiply, value};
pub(super) use draws::{Covariance, Drawn, SAMPLE_SETTLED};
pub(super) use rounds::{FoundPower, PowerProblem};

use self::blocks::{evidence, greatest};
use self::knots::{FREE, Knots};
use crate::imaging::solver::SolveError;
use crate::sky::healpix::pixel_count;

/// Decades of amplitude that are searched, in units of the least variance of noise.
const DECADES: std::ops::RangeInclusive<i32> = -3..=13;
/// Most steps of Newton's iteration, and the gain in evidence below which it ends.
const STEPS_MAX: usize = 20;
const GAIN_MIN: f64 = 1e-4;
/// Greatest change of ln C_l in one step.
const STEP_MAX: f64 = 2.0;
/// Halvings of a step that gains nothing.
const HALVINGS: usize = 8;

/// The angular power of the sky (less its prior map) as the data have it, with its uncertainty: R = 1 / C_l of a map.
#[derive(Clone, Debug, PartialEq, Serialize, bincode::Encode, bincode::Decode)]
pub struct SkyPower {
    /// C_l of the ensemble, K^2, from l = 0: a smooth curve. Values at l = 0 and 1 are not estimates but so large that mean and dipole are free.
    pub power_k2: Vec<f64>,
    /// Standard deviation of ln C_l, from the curvature of the evidence; 0 for l = 0 and 1.
    pub sigma_ln: Vec<f64>,
    /// Number of coefficients that the data decide, of 2 l + 1.
    pub decided: Vec<f64>,
    /// Scatter of what the map leaves of the data in units of their noise, at least 1: above it is sky beyond the map's degrees, or errors of
    /// the instrument. It counts as noise.
    pub noise_factor: f64,
}

impl SkyPower {
    /// The interval that holds C_l with 68 % probability, K^2.
    #[must_use]
    pub fn interval_k2(&self, l: usize) -> Option<[f64; 2]> {
        let (power, sigma) = (self.power_k2.get(l)?, self.sigma_ln.get(l)?);
        Some([power * (-sigma).exp(), power * sigma.exp()])
    }

    /// One over R by degree: the power less what the data scatter more than their noise.
    #[must_use]
    pub fn over_noise_k2(&self) -> Vec<f64> {
        self.power_k2.iter().map(|power| power / self.noise_factor.powi(2)).collect()
    }

    /// Variance that the sky's degrees beyond these have in means over pixels, K^2: of the curve continued as it ends.
    pub(super) fn variance_beyond_k2(&self, nside: usize) -> f64 {
        let [.., before, last] = self.power_k2[..] else { return 0.0 };
        let first = self.power_k2.len();
        let fall = (last / before).ln() / (first as f64 / (first - 1) as f64).ln();
        let term = |l: usize| {
            let l = l as f64;
            let power_k2 = last * ((l + 1.0) / first as f64).powf(fall);
            // The window of a disc of a pixel's area, 2 J_1(x) / x with x = 2 l / sqrt(N_pix): ln w_l^2 = -x^2 / 4 - x^4 / 192 - ..
            let q = l * l / pixel_count(nside) as f64;
            (2.0 * l + 1.0) / (4.0 * PI) * power_k2 * (-q - q * q / 12.0).exp()
        };
        // Of w_l^2 a hundredth is left at 8 nside.
        (first..=8 * nside).map(term).sum()
    }

    /// As found for data that were divided by `factor`.
    fn of_data_divided_by(mut self, factor: f64) -> Self {
        self.power_k2.iter_mut().for_each(|power| *power *= factor * factor);
        self.noise_factor = factor;
        self
    }

    /// A table: a line a degree from l = 2.
    #[must_use]
    pub fn csv(&self) -> String {
        let mut table = String::from(
            "# Angular power of the sky from the data, with the interval that holds it with 68 % probability; decided: how many of the 2 l + 1\n\
             # coefficients the data decide. R = 1 / C_l. The interval is that of a smooth curve; of the last tenth of the degrees it leaves out\n\
             # what the sky beyond the map's adds, some 10 %.\n\
             l,power_k2,low_k2,high_k2,decided\n",
        );
        for l in FREE..self.power_k2.len() {
            let [low, high] = self.interval_k2(l).unwrap_or_default();
            let decided = self.decided.get(l).copied().unwrap_or_default();
            table.push_str(&format!("{l},{:e},{low:e},{high:e},{decided:.3}\n", self.power_k2[l]));
        }
        table
    }
}

/// What is known of a map's errors, with R from the data.
#[derive(Clone, Debug, PartialEq)]
pub struct Uncertainty {
    /// Standard deviation of every pixel, K: of noise and of what the data leave open. Of harmonic maps up to their degrees, of pixels also
    /// of what the sky has beyond.
    pub sigma_k: Vec<f64>,
    /// Root of the solid angle for each coefficient that the data decide, by pixel, degrees: `sqrt(4 pi) / (l_max + 1)` rad of a map that
    /// keeps all degrees up to l_max.
    pub resolution_deg: Vec<f64>,
    /// Standard deviation of the mean, K.
    pub mean_sigma_k: f64,
    /// Dipole along the ecliptic's x, y and z, K: the map has `mean + dipole . n` of degrees 0 and 1.
    pub dipole_k: [f64; 3],
    /// Standard deviations of the dipole, K.
    pub dipole_sigma_k: [f64; 3],
    /// The sky's power that R is the inverse of.
    pub power: SkyPower,
    /// Draws from the posterior, if any were asked for.
    pub samples: Vec<Sample>,
}

/// Draws from the posterior that are wanted beside a map.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Samples {
    /// Their number.
    pub count: usize,
    /// Whether the sky's power is drawn with each (Gibbs sampling), in place of that which was found.
    pub gibbs: bool,
}

/// A map as likely as the map itself: a draw from the posterior.
#[derive(Clone, Debug, PartialEq)]
pub struct Sample {
    /// The map, K.
    pub map_k: Vec<f64>,
    /// Its dipole along the ecliptic's x, y and z, K.
    pub dipole_k: [f64; 3],
    /// Its own angular power, K^2, from l = 0.
    pub power_k2: Vec<f64>,
}

impl Uncertainty {
    /// Of a map that is divided by `factor`.
    #[must_use]
    pub(super) fn reduced(mut self, factor: f64) -> Self {
        let samples = self.samples.iter_mut();
        let samples = samples.flat_map(|sample| sample.map_k.iter_mut().chain(&mut sample.dipole_k));
        let dipole = self.dipole_k.iter_mut().chain(&mut self.dipole_sigma_k);
        self.sigma_k.iter_mut().chain(samples).chain(dipole).for_each(|value| *value /= factor);
        self.mean_sigma_k /= factor;
        let powers = self.samples.iter_mut().flat_map(|sample| &mut sample.power_k2);
        self.power.power_k2.iter_mut().chain(powers).for_each(|power| *power /= factor * factor);
        self
    }

    /// 1 for the pixels that the data measure, 0 for the others: those where they leave open more than half of the variance that R expects of
    /// the sky's structure (l >= 2), so that the map shows the expectation more than the sky.
    #[must_use]
    pub fn mask(&self) -> Vec<f64> {
        let of_degree = |(l, power): (usize, &f64)| (2 * l + 1) as f64 / (4.0 * PI) * power;
        let expected: f64 = self.power.power_k2.iter().enumerate().skip(FREE).map(of_degree).sum();
        self.sigma_k.iter().map(|sigma| f64::from(u8::from(sigma * sigma < 0.5 * expected))).collect()
    }
}

/// A power on its way to the most likely one.
#[derive(Clone, Debug)]
pub(in crate::imaging) struct PowerFit {
    knots: Knots,
    theta: Vec<f64>,
    /// C_l, K^2.
    power: Vec<f64>,
}

/// What a fit takes the data to be.
#[derive(Clone, Copy)]
pub(super) struct BlockData<'a> {
    /// The normal matrix.
    pub(super) blocks: &'a [Block<'a>],
    /// Right-hand side.
    pub(super) right: &'a [f64],
    /// By how much the gradient in ln C_l is more than that of the blocks.
    pub(super) tilt: &'a [f64],
}

impl PowerFit {
    fn new(knots: Knots, theta: Vec<f64>) -> Self {
        let power = knots.log_power(&theta).into_iter().map(f64::exp).collect();
        Self { knots, theta, power }
    }

    /// `C_l` proportional to `(l + 1)^-2` with the most likely amplitude.
    ///
    /// # Errors
    /// A matrix that no R makes positive definite: of numbers that are not finite.
    pub(super) fn begin(blocks: &[Block<'_>], l_max: usize, right: &[f64]) -> Result<Self, SolveError> {
        let unit = greatest(blocks).recip();
        let of = |decade: i32| {
            let knots = Knots::new(l_max, (unit * 10.0_f64.powi(decade)).ln());
            let fit = Self::new(knots.clone(), knots.plain());
            Some((value(blocks, &fit.power, right)?, fit))
        };
        let best = DECADES.filter_map(of).max_by(|(a, _), (b, _)| a.total_cmp(b));
        best.map(|(_, fit)| fit).ok_or(SolveError::NoPower)
    }

    /// R by degree, K^-2.
    pub(in crate::imaging) fn regularisation(&self) -> Vec<f64> {
        self.power.iter().map(|power| power.recip()).collect()
    }

    /// The right-hand side for which `solution` solves the equations with this R and the blocks as normal matrix.
    pub(super) fn data_of(&self, blocks: &[Block<'_>], solution: &[f64], degrees: &[usize]) -> Vec<f64> {
        let mut data = multiply(blocks, solution);
        for ((data, x), l) in data.iter_mut().zip(solution).zip(degrees) {
            *data += x / self.power[*l];
        }
        data
    }

    /// Evidence and hyperprior at some parameters.
    fn objective(&self, theta: &[f64], data: BlockData<'_>) -> Option<f64> {
        let log_power = self.knots.log_power(theta);
        let power: Vec<f64> = log_power.iter().map(|ln| ln.exp()).collect();
        let tilted: f64 = data.tilt.iter().zip(&log_power).skip(FREE).map(|(t, ln)| t * ln).sum();
        Some(value(data.blocks, &power, data.right)? + tilted + self.knots.hyperprior(theta).value)
    }

    /// Gradient and information of the objective.
    fn derivatives(&self, data: BlockData<'_>) -> Option<(Vec<f64>, Mat<f64>)> {
        let found = evidence(data.blocks, &self.knots, &self.power, data.right)?;
        let prior = self.knots.hyperprior(&self.theta);
        let mut gradient = prior.gradient;
        for (l, of_degree) in found.gradient.iter().enumerate().skip(FREE) {
            let of_degree = of_degree + data.tilt.get(l).copied().unwrap_or(0.0);
            for (knot, share) in self.knots.weights(l) {
                gradient[knot] += share * of_degree;
            }
        }
        Some((gradient, found.fisher + prior.precision))
    }

    /// The most likely power.
    ///
    /// # Errors
    /// As [`PowerFit::begin`].
    pub(super) fn maximised(&self, data: BlockData<'_>) -> Result<Self, SolveError> {
        let mut fit = self.clone();
        let mut best = fit.objective(&fit.theta, data).ok_or(SolveError::NoPower)?;
        for _ in 0..STEPS_MAX {
            let (gradient, information) = fit.derivatives(data).ok_or(SolveError::NoPower)?;
            let Ok(factor) = information.llt(Side::Lower) else { break };
            let covariance = factor.inverse();
            let mut step: Vec<f64> = (0..gradient.len())
                .map(|k| gradient.iter().enumerate().map(|(j, g)| covariance[(k, j)] * g).sum())
                .collect();
            let longest = step.iter().fold(0.0_f64, |most, step| most.max(step.abs()));
            if longest > STEP_MAX {
                step.iter_mut().for_each(|step| *step *= STEP_MAX / longest);
            }
            let tried = (0..HALVINGS).find_map(|halving| {
                let share = 0.5_f64.powi(halving as i32);
                let theta: Vec<f64> = fit.theta.iter().zip(&step).map(|(t, s)| t + share * s).collect();
                let found = fit.objective(&theta, data).filter(|found| *found > best)?;
                Some((found, theta))
            });
            let Some((found, theta)) = tried else { break };
            let gain = found - best;
            (best, fit) = (found, Self::new(fit.knots, theta));
            if gain < GAIN_MIN {
                break;
            }
        }
        Ok(fit)
    }

    /// Greatest change of ln C_l at a knot.
    pub(in crate::imaging) fn change(&self, from: &Self) -> f64 {
        self.theta.iter().zip(&from.theta).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max)
    }

    /// The estimate with its uncertainty, and the covariance of the parameters; `traces` are those of `(A + R)^-1` by degree.
    ///
    /// # Errors
    /// As [`PowerFit::begin`].
    pub(super) fn estimate(
        &self,
        data: BlockData<'_>,
        traces: &[f64],
    ) -> Result<(SkyPower, Mat<f64>), SolveError> {
        let (_, information) = self.derivatives(data).ok_or(SolveError::NoPower)?;
        let covariance = information.llt(Side::Lower).map_err(|_| SolveError::NoPower)?.inverse();
        let sigma = |l: usize| {
            let weights = self.knots.weights(l);
            let term = |(k, a): (usize, f64)| weights.iter().map(move |(j, b)| (k, *j, a * b));
            let variance: f64 = weights
                .iter()
                .flat_map(|one| term(*one))
                .map(|(k, j, share)| share * covariance[(k, j)])
                .sum();
            variance.max(0.0).sqrt()
        };
        let mut count = vec![0.0; self.power.len()];
        for block in data.blocks {
            block.degrees.iter().for_each(|l| count[*l] += block.places.len() as f64);
        }
        let decided =
            (count.iter().zip(traces)).zip(&self.power).map(|((n, trace), c)| (n - trace / c).max(0.0));
        let power = SkyPower {
            power_k2: self.power.clone(),
            sigma_ln: (0..self.power.len()).map(sigma).collect(),
            decided: decided.collect(),
            noise_factor: 1.0,
        };
        Ok((power, covariance))
    }
}
