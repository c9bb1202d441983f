//! Maximum-likelihood estimate of the sky's angular power C_l from the data (empirical Bayes), which gives R = s^2 / C_l, s the noise factor.
//!
//! With `b = A x + n`, n of covariance A, and a Gaussian sky of power C_l(theta), for data divided by s, `R_l = 1 / C_l`,
//!
//! ```text
//! ln p(b | theta) = 1/2 b.(A + R)^-1 b + 1/2 ln det R - 1/2 ln det(A + R) + const,
//! its gradient in ln C_l:  1/2 (R_l |x_l|^2 - gamma_l),   gamma_l = (2 l + 1) - R_l Tr_l (A + R)^-1
//! ```
//!
//! x is the solution, and gamma_l the number of coefficients that the data determine (MacKay 1992). All of this is cheap if A is block
//! diagonal, exactly or as an approximation that preconditions it. With the true A, each round solves for x. Then the blocks
//! replace A, and b is replaced by the right-hand side for which the blocks have the solution x; true traces are estimated from posterior samples. Both problems have the same gradient at
//! theta, so that rounds converge to the maximum for the true A.
//!
//! A map is band-limited and the sky is not. If the residual `|V - B x|^2`, which follows from the sums, exceeds the noise by a factor
//! s^2, it counts as noise: everything is done for data divided by s.

mod blocks;
mod gibbs;
mod knots;
mod newton;
mod rounds;
mod samples;
#[cfg(test)]
mod tests;

use std::f64::consts::PI;

use faer::linalg::solvers::DenseSolveCore;
use faer::{Mat, Side};
use serde::Serialize;

pub(super) use blocks::{Block, Coupling, Factors, log_evidence, multiply};
pub(super) use knots::{FREE_DEGREES, Hyperprior, Knots};
pub(super) use newton::{Derivatives, maximise};
pub(super) use rounds::{FoundPower, MapsWithPower, PowerProblem};
pub(super) use samples::{PosteriorPrecision, PosteriorSample, SAMPLE_TOLERANCE};

use self::blocks::{evidence, largest_diagonal};
use crate::imaging::SolveError;
use crate::sky::healpix::pixel_count;

/// Decades of amplitude that are searched, in units of the smallest noise variance.
const DECADES: std::ops::RangeInclusive<i32> = -3..=13;
/// Share of the power of residuals beyond the noise that the coefficients of a map take up, where it is of a sky with more degrees: 0.004 to 0.01 in full
/// missions at nside 4 to 16 and 3 and 10 MHz (0.05 in one).
const TAKEN: f64 = 0.007;
/// Gain in evidence per step below which the iteration ends.
const GAIN_MIN: f64 = 1e-4;

/// Limit of the `V'N^-1V` that C_l predicts for degrees from 2 on, in units of that of the data. Rounds of data that leave most of the sky open
/// could otherwise run away: a larger C_l makes a larger map, which makes a larger C_l. Beyond it a narrow Gaussian prior in the logarithm sets in.
const EXPECTED_MAX: f64 = 30.0;
/// Standard deviation of that prior: a wall that is smooth enough for Newton's steps.
const EXPECTED_SIGMA: f64 = 1e-3;

/// The angular power of the sky's difference from the prior map, estimated from the data, with its uncertainty. R is s^2 / C_l, s the noise factor.
#[derive(Clone, Debug, PartialEq, Serialize, bincode::Encode, bincode::Decode)]
pub struct SkyPower {
    /// C_l of the ensemble, K^2, from l = 0, as a smooth curve. Values at l = 0 and 1 are no estimates, but so large that mean and dipole are
    /// free.
    pub power_k2: Vec<f64>,
    /// Standard deviation of ln C_l, from the curvature of the evidence; 0 for l = 0 and 1.
    pub sigma_ln: Vec<f64>,
    /// gamma_l: how many of the 2 l + 1 coefficients the data constrain.
    pub constrained: Vec<f64>,
    /// Scatter of the residuals in units of the noise, at least 1. The excess, from the sky beyond the map's degrees or from instrument errors,
    /// counts as noise.
    pub noise_factor: f64,
}

impl SkyPower {
    /// The interval that holds C_l with 68 % probability, K^2.
    #[must_use]
    pub fn interval_k2(&self, l: usize) -> Option<[f64; 2]> {
        let (power, sigma) = (self.power_k2.get(l)?, self.sigma_ln.get(l)?);
        Some([power * (-sigma).exp(), power * sigma.exp()])
    }

    /// C_l / s^2, the inverse of R by degree.
    #[must_use]
    pub fn over_noise_k2(&self) -> Vec<f64> {
        self.power_k2.iter().map(|power| power / self.noise_factor.powi(2)).collect()
    }

    /// Variance of pixel means from the sky beyond these degrees, K^2, with the curve extrapolated.
    pub(super) fn variance_beyond_k2(&self, nside: usize) -> f64 {
        let first = self.power_k2.len();
        let term = |l: usize| {
            let power_k2 = self.continued_k2(l);
            let l = l as f64;
            // The window of a disc of a pixel's area, 2 J_1(x) / x with x = 2 l / sqrt(N_pix): ln w_l^2 = -x^2 / 4 - x^4 / 192 - ..
            let q = l * l / pixel_count(nside) as f64;
            (2.0 * l + 1.0) / (4.0 * PI) * power_k2 * (-q - q * q / 12.0).exp()
        };
        // w_l^2 falls to a hundredth at 8 nside.
        (first..=8 * nside).map(term).sum()
    }

    /// C_l of a degree beyond the last, K^2, with the curve extrapolated.
    pub(super) fn continued_k2(&self, l: usize) -> f64 {
        let [.., before, last] = self.power_k2[..] else { return 0.0 };
        let first = self.power_k2.len();
        let fall = (last / before).ln() / (first as f64 / (first - 1) as f64).ln();
        last * ((l + 1) as f64 / first as f64).powf(fall)
    }

    /// How many times too small errors from so many visibilities are if residuals exceed the noise because the sky has more than the degrees solved
    /// for: independent noise averages out in a coefficient, this sky does not. A rule, 1.2 times too high to 2.6 times too low in six simulated missions.
    #[must_use]
    pub fn errors_low_by(&self, visibilities: u64) -> f64 {
        let excess = 1.0 - self.noise_factor.powi(-2);
        let measured: f64 = self.constrained.iter().sum();
        (1.0 + TAKEN * excess * 2.0 * visibilities as f64 / measured.max(1.0)).sqrt()
    }

    /// Converts an estimate from data divided by `factor`.
    fn scaled_from_divided_data(mut self, factor: f64) -> Self {
        self.power_k2.iter_mut().for_each(|power| *power *= factor * factor);
        self.noise_factor = factor;
        self
    }

    /// Formats a table with a line for each degree from l = 2.
    #[must_use]
    pub fn csv(&self) -> String {
        let mut table = String::from(
            "# Angular power of the sky from the data, with the interval that holds it with 68 % probability; constrained: how many of the\n\
             # 2 l + 1 coefficients the data constrain. R = s^2 / C_l, s the noise factor. The interval is that of a smooth curve; in the last tenth of the degrees\n\
             # the sky beyond the map adds some 10 %, which it does not include.\n\
             l,power_k2,low_k2,high_k2,constrained\n",
        );
        for l in FREE_DEGREES..self.power_k2.len() {
            let [low, high] = self.interval_k2(l).unwrap_or_default();
            let constrained = self.constrained.get(l).copied().unwrap_or_default();
            table.push_str(&format!("{l},{:e},{low:e},{high:e},{constrained:.3}\n", self.power_k2[l]));
        }
        table
    }
}

/// Errors of a map with R from the data.
#[derive(Clone, Debug, PartialEq)]
pub struct Uncertainty {
    /// Posterior standard deviation of every pixel, K. Harmonic maps include errors up to their maximum degree, pixel maps also the sky's
    /// higher degrees.
    pub sigma_k: Vec<f64>,
    /// Root of the sky's solid angle over the number of coefficients that the data constrain, by pixel, degrees: `sqrt(4 pi) / (l_max + 1)` rad of a map that
    /// keeps all degrees up to l_max.
    pub resolution_deg: Vec<f64>,
    /// Standard deviation of the mean, K.
    pub mean_sigma_k: f64,
    /// Dipole along the ecliptic's x, y and z, K: the map's degrees 0 and 1 are `mean + dipole . n`.
    pub dipole_k: [f64; 3],
    /// Standard deviations of the dipole, K.
    pub dipole_sigma_k: [f64; 3],
    /// The sky's power.
    pub power: SkyPower,
    /// The part of these errors that is by errors of the applied gains; `None` if it is not known, and not among them.
    pub gains: Option<GainUncertainty>,
    /// Posterior samples, if requested.
    pub samples: Vec<Sample>,
}

/// The part of a map's errors that is by errors of the applied gains. Standard deviations from K draws are themselves uncertain by
/// `1 / sqrt(2 K)`; those of pixels less, as they are means over a ring.
#[derive(Clone, Debug, PartialEq, Serialize, bincode::Encode, bincode::Decode)]
pub struct GainUncertainty {
    /// Number of draws.
    pub draws: usize,
    /// Standard deviation of a pixel, K: rms over the sphere.
    pub sigma_rms_k: f64,
    /// Standard deviation of the mean, K.
    pub mean_sigma_k: f64,
    /// Angular power that the errors add to that of the map, K^2, from l = 0.
    pub power_k2: Vec<f64>,
}

impl GainUncertainty {
    /// That of the map divided by `factor`.
    pub(in crate::imaging) fn divided_by(mut self, factor: f64) -> Self {
        self.sigma_rms_k /= factor;
        self.mean_sigma_k /= factor;
        self.power_k2.iter_mut().for_each(|power| *power /= factor * factor);
        self
    }
}

/// How many draws from the posterior are wanted beside a map.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Samples {
    /// Their number.
    pub count: usize,
    /// Whether the sky's power is drawn with each (Gibbs sampling), in place of that which was found.
    pub gibbs: bool,
}

/// A draw from the posterior of the map.
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
    /// Converts the errors to those of the map divided by `factor`.
    #[must_use]
    pub(super) fn divided_by(mut self, factor: f64) -> Self {
        let samples = self.samples.iter_mut();
        let samples = samples.flat_map(|sample| sample.map_k.iter_mut().chain(&mut sample.dipole_k));
        let dipole = self.dipole_k.iter_mut().chain(&mut self.dipole_sigma_k);
        self.sigma_k.iter_mut().chain(samples).chain(dipole).for_each(|value| *value /= factor);
        self.mean_sigma_k /= factor;
        self.gains = self.gains.map(|gains| gains.divided_by(factor));
        let powers = self.samples.iter_mut().flat_map(|sample| &mut sample.power_k2);
        self.power.power_k2.iter_mut().chain(powers).for_each(|power| *power /= factor * factor);
        self
    }

    /// 1 for the pixels that the data measure: those whose posterior variance is less than half of the prior variance of the sky's structure
    /// (l >= 2); 0 for the others.
    #[must_use]
    pub fn mask(&self) -> Vec<f64> {
        let of_degree = |(l, power): (usize, &f64)| (2 * l + 1) as f64 / (4.0 * PI) * power;
        let expected: f64 = self.power.power_k2.iter().enumerate().skip(FREE_DEGREES).map(of_degree).sum();
        self.sigma_k.iter().map(|sigma| f64::from(u8::from(sigma * sigma < 0.5 * expected))).collect()
    }
}

/// The state of the search for the maximum-likelihood power.
#[derive(Clone, Debug)]
pub(in crate::imaging) struct PowerFit {
    knots: Knots,
    /// Parameters: ln C_l at the knots.
    theta: Vec<f64>,
    /// C_l, K^2.
    power: Vec<f64>,
    limit: ExpectedLimit,
}

/// A soft limit of C_l: it predicts a `V'N^-1V` of the sum of C_l times the traces of the normal matrix by degree. Mean and dipole are free.
#[derive(Clone, Debug)]
struct ExpectedLimit {
    traces: Vec<f64>,
    max: f64,
}

impl ExpectedLimit {
    fn new(blocks: &[Block<'_>], l_max: usize, data_chi2: f64) -> Self {
        let mut traces = vec![0.0; l_max + 1];
        for block in blocks {
            for (k, l) in block.degrees.iter().enumerate() {
                traces[*l] += block.places.len() as f64 * block.matrix[(k, k)];
            }
        }
        traces.iter_mut().take(FREE_DEGREES).for_each(|trace| *trace = 0.0);
        Self { traces, max: EXPECTED_MAX * data_chi2 }
    }

    /// How far the logarithm of the expectation is above the limit, in standard deviations; 0 if it is not.
    fn excess(&self, power: &[f64]) -> f64 {
        let expected: f64 = self.traces.iter().zip(power).map(|(trace, c)| trace * c).sum();
        if expected > self.max { (expected / self.max).ln() / EXPECTED_SIGMA } else { 0.0 }
    }

    /// The logarithm of the prior.
    fn log_prior(&self, power: &[f64]) -> f64 {
        -0.5 * self.excess(power).powi(2)
    }

    /// Derivatives of the excess with respect to ln C_l.
    fn slopes(&self, power: &[f64]) -> Vec<f64> {
        let terms: Vec<f64> = self.traces.iter().zip(power).map(|(trace, c)| trace * c).collect();
        let expected: f64 = terms.iter().sum();
        terms.iter().map(|term| term / (expected * EXPECTED_SIGMA)).collect()
    }
}

/// `V'N^-1V` of the data divided by a factor, at least its mean for pure noise in as many coefficients as unknowns.
fn chi2_in_found_noise(data_chi2: f64, factor: f64, unknowns: usize) -> f64 {
    (data_chi2 / factor.powi(2)).max(unknowns as f64)
}

/// The data and matrix of a fit.
#[derive(Clone, Copy)]
pub(super) struct BlockData<'a> {
    /// Blocks of the normal matrix.
    pub(super) blocks: &'a [Block<'a>],
    pub(super) right: &'a [f64],
    /// Correction of the gradient in ln C_l for the difference between the true matrix and the blocks.
    pub(super) gradient_correction: &'a [f64],
}

impl PowerFit {
    fn new(knots: Knots, theta: Vec<f64>, limit: ExpectedLimit) -> Self {
        let power = knots.power(&theta);
        Self { knots, theta, power, limit }
    }

    /// The same for data whose noise is larger by `factor`, and which are divided by it; `data_chi2` is their `V'N^-1V` before the division.
    pub(super) fn with_noise_factor(mut self, data_chi2: f64, factor: f64, unknowns: usize) -> Self {
        self.limit.max = EXPECTED_MAX * chi2_in_found_noise(data_chi2, factor, unknowns);
        self
    }

    /// Starts with `C_l` proportional to `(l + 1)^-2` and the maximum-likelihood amplitude, of data with this `V'N^-1V`.
    pub(super) fn begin(
        blocks: &[Block<'_>],
        l_max: usize,
        right: &[f64],
        data_chi2: f64,
    ) -> Result<Self, SolveError> {
        let unit = largest_diagonal(blocks).recip();
        let limit = ExpectedLimit::new(blocks, l_max, chi2_in_found_noise(data_chi2, 1.0, right.len()));
        let of = |decade: i32| {
            let knots = Knots::new(l_max, (unit * 10.0_f64.powi(decade)).ln());
            let fit = Self::new(knots.clone(), knots.start(), limit.clone());
            Some((log_evidence(blocks, &fit.power, right)? + limit.log_prior(&fit.power), fit))
        };
        let best = DECADES.filter_map(of).max_by(|(a, _), (b, _)| a.total_cmp(b));
        best.map(|(_, fit)| fit).ok_or(SolveError::NoPower)
    }

    /// R by degree, K^-2.
    pub(in crate::imaging) fn regularisation(&self) -> Vec<f64> {
        self.power.iter().map(|power| power.recip()).collect()
    }

    /// The right-hand side for which `solution` solves the equations with the blocks and this R.
    pub(super) fn equivalent_data(
        &self,
        blocks: &[Block<'_>],
        solution: &[f64],
        degrees: &[usize],
    ) -> Vec<f64> {
        let mut data = multiply(blocks, solution);
        for ((data, x), l) in data.iter_mut().zip(solution).zip(degrees) {
            *data += x / self.power[*l];
        }
        data
    }

    /// The sum of log evidence and log hyperprior at some parameters.
    fn objective(&self, theta: &[f64], data: BlockData<'_>) -> Option<f64> {
        let log_power = self.knots.log_power(theta);
        let power: Vec<f64> = log_power.iter().map(|ln| ln.exp()).collect();
        let correction: f64 =
            data.gradient_correction.iter().zip(&log_power).skip(FREE_DEGREES).map(|(t, ln)| t * ln).sum();
        let prior = self.knots.hyperprior(theta).value + self.limit.log_prior(&power);
        Some(log_evidence(data.blocks, &power, data.right)? + correction + prior)
    }

    /// Gradient and Fisher information of the objective. The information leaves out the limit, which is no knowledge of the sky.
    fn derivatives(&self, data: BlockData<'_>) -> Option<(Vec<f64>, Mat<f64>)> {
        let found = evidence(data.blocks, &self.knots, &self.power, data.right)?;
        let prior = self.knots.hyperprior(&self.theta);
        let mut gradient = prior.gradient;
        for (l, of_degree) in found.gradient.iter().enumerate().skip(FREE_DEGREES) {
            let of_degree = of_degree + data.gradient_correction.get(l).copied().unwrap_or(0.0);
            for (knot, share) in self.knots.weights(l) {
                gradient[knot] += share * of_degree;
            }
        }
        self.limit_slopes().iter().zip(&mut gradient).for_each(|(slope, gradient)| {
            *gradient -= self.limit.excess(&self.power) * slope;
        });
        Some((gradient, found.fisher + prior.precision))
    }

    /// Derivatives of the limit's excess with respect to the parameters; 0 below it.
    fn limit_slopes(&self) -> Vec<f64> {
        let mut slopes = vec![0.0; self.theta.len()];
        if self.limit.excess(&self.power) > 0.0 {
            for (l, slope) in self.limit.slopes(&self.power).iter().enumerate().skip(FREE_DEGREES) {
                self.knots.weights(l).iter().for_each(|(knot, share)| slopes[*knot] += share * slope);
            }
        }
        slopes
    }

    /// Maximises the objective by Newton's iteration.
    pub(super) fn maximised(&self, data: BlockData<'_>) -> Result<Self, SolveError> {
        let at = |theta: &[f64]| Self::new(self.knots.clone(), theta.to_vec(), self.limit.clone());
        let derivatives = |theta: &[f64]| {
            let fit = at(theta);
            let (gradient, mut information) = fit.derivatives(data)?;
            let slopes = fit.limit_slopes();
            for (j, a) in slopes.iter().enumerate() {
                slopes.iter().enumerate().for_each(|(k, b)| information[(j, k)] += a * b);
            }
            Some((gradient, information))
        };
        let found = maximise(
            (self.theta.clone(), GAIN_MIN),
            &|theta| self.objective(theta, data),
            &derivatives,
            &|_, _| true,
        );
        found.map(|theta| at(&theta)).ok_or(SolveError::NoPower)
    }

    /// Maximum change of ln C_l at a knot.
    pub(in crate::imaging) fn change(&self, from: &Self) -> f64 {
        self.theta.iter().zip(&from.theta).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max)
    }

    /// The estimate with its uncertainty, and the covariance of the parameters; `traces` are those of `(A + R)^-1` by degree.
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
                .flat_map(|pair| term(*pair))
                .map(|(k, j, share)| share * covariance[(k, j)])
                .sum();
            variance.max(0.0).sqrt()
        };
        let mut counts = vec![0.0; self.power.len()];
        for block in data.blocks {
            block.degrees.iter().for_each(|l| counts[*l] += block.places.len() as f64);
        }
        let constrained =
            (counts.iter().zip(traces)).zip(&self.power).map(|((n, trace), c)| (n - trace / c).max(0.0));
        let power = SkyPower {
            power_k2: self.power.clone(),
            sigma_ln: (0..self.power.len()).map(sigma).collect(),
            constrained: constrained.collect(),
            noise_factor: 1.0,
        };
        Ok((power, covariance))
    }
}
