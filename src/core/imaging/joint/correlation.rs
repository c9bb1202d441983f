//! The covariance of the sky's structure between channels, by degree, as a curve with few parameters.
//!
//! ```text
//! <x(nu) x(nu')> = s_l(nu) s_l(nu') e^(a_l(nu) + a_l(nu')) rho_l(nu, nu'),     s_l^2 = C_l of the single channel,
//! rho_l = (1 - p_l) exp(-(ln nu / nu')^2 / (2 L_l^2)) + p_l [nu = nu']
//! ```
//!
//! L is the number of e-foldings of frequency over which the structure is correlated, p the fraction of power that is independent in each
//! channel, a a correction of the root of C_l by what the channels say of each other. ln L, logit p and a are linear in ln(l + 1) between knots an octave apart.

use faer::linalg::triangular_solve::solve_lower_triangular_in_place;
use faer::{Mat, Par, Side};
use serde::Serialize;

use crate::imaging::SolveError;
use crate::imaging::power::{FREE_DEGREES, Hyperprior, Knots};

/// Prior mean and standard deviation of ln L: spectra of the sky bend over an e-folding or several.
const LN_LENGTH: [f64; 2] = [0.7, 1.0];
/// Prior mean (p = 1 %) and standard deviation of logit p.
const LOGIT_OWN_SHARE: [f64; 2] = [-4.6, 1.0];
/// Prior standard deviation of the amplitudes a, about that of C_l from a channel alone.
const AMPLITUDE_SIGMA: f64 = 0.15;
/// Prior standard deviations of the changes of ln L, logit p and a from knot to knot.
const CHANGE_SIGMA: [f64; 3] = [0.7, 1.0, 0.15];
/// Parameters of a knot before the amplitudes: ln L and logit p.
const AMPLITUDES_FROM: usize = 2;

/// The correlation of the sky's structure between frequencies at one degree.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Correlation {
    /// The degree l.
    pub degree: usize,
    /// Correlation length L, e-foldings of frequency.
    pub length: f64,
    /// Fraction p of a channel's power that is independent of all other channels.
    pub own_share: f64,
}

impl Correlation {
    /// What two frequencies share, without what is their own.
    fn shared(self, a_hz: f64, b_hz: f64) -> f64 {
        (-0.5 * ((a_hz / b_hz).ln() / self.length).powi(2)).exp()
    }

    /// The correlation coefficient of two frequencies.
    pub(super) fn between(self, a_hz: f64, b_hz: f64) -> f64 {
        let own = if a_hz == b_hz { self.own_share } else { 0.0 };
        (1.0 - self.own_share) * self.shared(a_hz, b_hz) + own
    }

    /// The lower Cholesky factor of the channels' correlation matrix; its upper left corner is the factor for the first few channels.
    pub(super) fn cholesky_factor(self, frequencies_hz: &[f64]) -> Result<Mat<f64>, SolveError> {
        let count = frequencies_hz.len();
        let matrix = Mat::from_fn(count, count, |i, j| self.between(frequencies_hz[i], frequencies_hz[j]));
        let factor = matrix.llt(Side::Lower).map_err(|_| SolveError::NoPower)?;
        Ok(factor.L().to_owned())
    }
}

/// The parameters of the covariance by degree.
#[derive(Clone, Debug)]
pub(super) struct Covariance {
    frequencies_hz: Vec<f64>,
    knots: Knots,
    l_max: usize,
    /// By knot: ln L, logit p, and a of each channel.
    pub(super) theta: Vec<f64>,
}

impl Covariance {
    /// The same correlation at all degrees up to `l_max`, and the amplitudes of single channels.
    pub(super) fn constant(frequencies_hz: Vec<f64>, l_max: usize, length: f64, own_share: f64) -> Self {
        let knots = Knots::new(l_max, 0.0);
        let mut of_knot = vec![length.ln(), (own_share / (1.0 - own_share)).ln()];
        of_knot.resize(AMPLITUDES_FROM + frequencies_hz.len(), 0.0);
        Self { frequencies_hz, theta: of_knot.repeat(knots.count()), knots, l_max }
    }

    /// A start of the search, which is also the prior of one channel alone.
    pub(super) fn initial(frequencies_hz: Vec<f64>, l_max: usize) -> Self {
        Self::constant(frequencies_hz, l_max, 2.0, 0.01)
    }

    pub(super) fn frequencies_hz(&self) -> &[f64] {
        &self.frequencies_hz
    }

    pub(super) fn with_theta(&self, theta: &[f64]) -> Self {
        Self { theta: theta.to_vec(), ..self.clone() }
    }

    /// The number of parameters of a knot.
    fn per_knot(&self) -> usize {
        AMPLITUDES_FROM + self.frequencies_hz.len()
    }

    /// A parameter at a degree; mean and dipole have that of l = 2.
    fn value(&self, l: usize, parameter: usize) -> f64 {
        let weights = self.knots.weights(l.max(FREE_DEGREES));
        weights.iter().map(|(knot, share)| share * self.theta[knot * self.per_knot() + parameter]).sum()
    }

    pub(super) fn correlation(&self, l: usize) -> Correlation {
        let own_share = (1.0 + (-self.value(l, 1)).exp()).recip();
        Correlation { degree: l, length: self.value(l, 0).exp(), own_share }
    }

    /// The factor e^a of each channel.
    pub(super) fn amplitudes(&self, l: usize) -> Vec<f64> {
        let of_channel = |channel| self.value(l, AMPLITUDES_FROM + channel).exp();
        (0..self.frequencies_hz.len()).map(of_channel).collect()
    }

    /// The correlation at every knot.
    pub(super) fn at_knots(&self) -> Vec<Correlation> {
        let mut degrees: Vec<usize> =
            (0..self.knots.count()).map(|knot| Knots::degree(knot).min(self.l_max)).collect();
        degrees.dedup();
        degrees.into_iter().map(|l| self.correlation(l)).collect()
    }

    /// `F^-1 dC F^-T` of the first `count` channels for each parameter at a degree, C the covariance and F its Cholesky factor.
    fn slopes(&self, l: usize, factor: &Mat<f64>, count: usize) -> Vec<Mat<f64>> {
        let correlation = self.correlation(l);
        let amplitudes = self.amplitudes(l);
        let Correlation { length, own_share: p, .. } = correlation;
        let f = factor.submatrix(0, 0, count, count);
        let scaled = |of_pair: &dyn Fn(usize, usize) -> f64| {
            let mut slope = Mat::from_fn(count, count, |i, j| amplitudes[i] * of_pair(i, j) * amplitudes[j]);
            solve_lower_triangular_in_place(f, slope.as_mut(), Par::Seq);
            let mut slope = slope.transpose().to_owned();
            solve_lower_triangular_in_place(f, slope.as_mut(), Par::Seq);
            slope
        };
        let hz = &self.frequencies_hz;
        let shared = |i: usize, j: usize| correlation.shared(hz[i], hz[j]);
        let of_length =
            |i: usize, j: usize| (1.0 - p) * shared(i, j) * ((hz[i] / hz[j]).ln() / length).powi(2);
        let of_own_share = |i: usize, j: usize| p * (1.0 - p) * (f64::from(u8::from(i == j)) - shared(i, j));
        let mut all = vec![scaled(&of_length), scaled(&of_own_share)];
        for channel in 0..count {
            // dC = e e' C + C e e', e the unit vector of the channel: F^-1 e e' F and its transpose.
            let mut unit = Mat::from_fn(count, 1, |i, _| f64::from(u8::from(i == channel)));
            solve_lower_triangular_in_place(f, unit.as_mut(), Par::Seq);
            let of_pair = |i: usize, j: usize| unit[(i, 0)] * f[(channel, j)];
            all.push(Mat::from_fn(count, count, |i, j| of_pair(i, j) + of_pair(j, i)));
        }
        all
    }

    /// Gradient and Fisher information of the log evidence and the prior of the parameters, from what the data say of the unknowns at each
    /// degree; `factors` are the covariance's Cholesky factors. The information averages over orders, and
    /// leaves out that degrees share data.
    pub(super) fn derivatives(&self, factors: &[Mat<f64>], moments: &[Moments]) -> (Vec<f64>, Mat<f64>) {
        let Hyperprior { mut gradient, precision: mut information, .. } = self.hyperprior();
        for (l, found) in moments.iter().enumerate().skip(FREE_DEGREES) {
            let count = found.square.nrows();
            let slopes = self.slopes(l, &factors[l], count);
            let learnt = found.learnt();
            let projected: Vec<Mat<f64>> = slopes.iter().map(|slope| &learnt * slope).collect();
            let trace = |a: &Mat<f64>, b: &Mat<f64>| -> f64 {
                (0..count)
                    .flat_map(|i| (0..count).map(move |j| (i, j)))
                    .map(|(i, j)| a[(i, j)] * b[(j, i)])
                    .sum()
            };
            let excess =
                Mat::from_fn(count, count, |i, j| found.square[(i, j)] - found.copies * learnt[(i, j)]);
            for (knot, share) in self.knots.weights(l) {
                for (k, slope) in slopes.iter().enumerate() {
                    gradient[knot * self.per_knot() + k] += 0.5 * share * trace(slope, &excess);
                }
            }
            for (k, a) in projected.iter().enumerate() {
                for (j, b) in projected.iter().enumerate() {
                    let of_degree = 0.5 * found.copies * trace(a, b);
                    for (knot, share) in self.knots.weights(l) {
                        for (other, share_of_other) in self.knots.weights(l) {
                            let at = (knot * self.per_knot() + k, other * self.per_knot() + j);
                            information[at] += share * share_of_other * of_degree;
                        }
                    }
                }
            }
        }
        (gradient, information)
    }

    /// The prior of the parameters.
    pub(super) fn hyperprior(&self) -> Hyperprior {
        let per_knot = self.per_knot();
        let mut prior = Hyperprior::flat(self.theta.len());
        for parameter in 0..per_knot {
            let [mean, sigma] = match parameter {
                0 => LN_LENGTH,
                1 => LOGIT_OWN_SHARE,
                _ => [0.0, AMPLITUDE_SIGMA],
            };
            let change = CHANGE_SIGMA[parameter.min(AMPLITUDES_FROM)];
            for k in (parameter..self.theta.len()).step_by(per_knot) {
                prior.add(&[(k, 1.0)], self.theta[k] - mean, sigma);
                if k >= per_knot {
                    let terms = [(k - per_knot, -1.0), (k, 1.0)];
                    prior.add(&terms, self.theta[k] - self.theta[k - per_knot], change);
                }
            }
        }
        prior
    }
}

/// What data say of the unknowns of one degree, whose prior is unit normal: sums over orders and parts.
#[derive(Clone)]
pub(super) struct Moments {
    /// The number of orders and parts.
    pub(super) copies: f64,
    /// Products of the solutions of pairs of channels.
    pub(super) square: Mat<f64>,
    /// Posterior covariances of pairs of channels.
    pub(super) spread: Mat<f64>,
}

impl Moments {
    pub(super) fn none(channels: usize) -> Self {
        let zero = Mat::zeros(channels, channels);
        Self { copies: 0.0, square: zero.clone(), spread: zero }
    }

    pub(super) fn add(&mut self, other: &Self) {
        self.copies += other.copies;
        self.square += &other.square;
        self.spread += &other.spread;
    }

    /// The mean of 1 less the posterior covariance.
    fn learnt(&self) -> Mat<f64> {
        Mat::from_fn(self.spread.nrows(), self.spread.ncols(), |i, j| {
            f64::from(u8::from(i == j)) - self.spread[(i, j)] / self.copies.max(1.0)
        })
    }
}
