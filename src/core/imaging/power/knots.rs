//! The angular power as a curve with few parameters: ln C_l is linear in ln(l + 1) between knots an octave apart.

use faer::Mat;

/// Degree of the first knot; lower degrees are free.
pub(super) const FIRST: usize = 2;
/// Number of degrees with a free prior: mean and dipole do not follow the power of structure.
pub(in crate::imaging) const FREE_DEGREES: usize = FIRST;
/// Prior power of monopole and dipole in units of the power at [`FIRST`]: far more than of any sky.
const FREE_FACTORS: [f64; FREE_DEGREES] = [1e6, 1e4];
/// Prior mean of the fall of ln C_l from knot to knot: the sky between 1 and 100 MHz falls as `l^-2` to `l^-3.5` at all scales.
const FALL: f64 = 2.7 * std::f64::consts::LN_2;
/// Prior standard deviation of the fall.
const FALL_SIGMA: f64 = 1.4;
/// Prior standard deviation of the change of the fall from knot to knot.
const BEND_SIGMA: f64 = 0.7;
/// Prior standard deviation of ln C_l at the first knot from the initial amplitude.
const LEVEL_SIGMA: f64 = 6.0;
/// Maximum fall from knot to knot (`l^-8`).
const FALL_MAX: f64 = 8.0 * std::f64::consts::LN_2;
/// Standard deviation of the soft limits: a fall between 0 and [`FALL_MAX`].
const LIMIT_SIGMA: f64 = 0.1;

/// The knots for degrees up to `l_max`.
#[derive(Clone, Debug, PartialEq)]
pub(in crate::imaging) struct Knots {
    l_max: usize,
    count: usize,
    /// Initial ln C_l of the first knot.
    level: f64,
}

/// The logarithm of the parameters' prior, with its derivatives.
pub(in crate::imaging) struct Hyperprior {
    pub(in crate::imaging) value: f64,
    pub(in crate::imaging) gradient: Vec<f64>,
    /// The negative second derivative.
    pub(in crate::imaging) precision: Mat<f64>,
}

impl Knots {
    pub(in crate::imaging) fn new(l_max: usize, level: f64) -> Self {
        let octaves = ((l_max + 1) as f64 / (FIRST + 1) as f64).log2().ceil().max(1.0);
        Self { l_max, count: octaves as usize + 1, level }
    }

    pub(in crate::imaging) fn count(&self) -> usize {
        self.count
    }

    /// The degree of a knot.
    pub(in crate::imaging) fn degree(knot: usize) -> usize {
        ((FIRST + 1) << knot) - 1
    }

    /// The initial parameters: `C_l` proportional to `(l + 1)^-2`, with `level` at the first knot.
    pub(super) fn start(&self) -> Vec<f64> {
        (0..self.count).map(|k| self.level - 2.0 * std::f64::consts::LN_2 * k as f64).collect()
    }

    /// The knots on both sides of a degree with their weights, which are 0 for a free degree.
    pub(in crate::imaging) fn weights(&self, l: usize) -> [(usize, f64); 2] {
        if l < FREE_DEGREES {
            return [(0, 0.0), (0, 0.0)];
        }
        let position = ((l + 1) as f64 / (FIRST + 1) as f64).log2();
        let below = (position.floor() as usize).min(self.count - 2);
        let share = position - below as f64;
        [(below, 1.0 - share), (below + 1, share)]
    }

    /// The values ln C_l for l = 0 ..= l_max.
    pub(super) fn log_power(&self, theta: &[f64]) -> Vec<f64> {
        let of_degree = |l: usize| match FREE_FACTORS.get(l) {
            // Relative to the initial level, because free degrees do not follow the structure.
            Some(factor) => self.level + factor.ln(),
            None => self.weights(l).iter().map(|(k, share)| share * theta[*k]).sum(),
        };
        (0..=self.l_max).map(of_degree).collect()
    }

    /// C_l for l = 0 ..= l_max.
    pub(super) fn power(&self, theta: &[f64]) -> Vec<f64> {
        self.log_power(theta).into_iter().map(f64::exp).collect()
    }

    /// The prior of the parameters.
    pub(super) fn hyperprior(&self, theta: &[f64]) -> Hyperprior {
        let mut prior = Hyperprior::flat(self.count);
        prior.add(&[(0, 1.0)], theta[0] - self.level, LEVEL_SIGMA);
        for k in 1..self.count {
            let terms = [(k - 1, -1.0), (k, 1.0)];
            let rise = theta[k] - theta[k - 1];
            prior.add(&terms, rise + FALL, FALL_SIGMA);
            if rise > 0.0 {
                prior.add(&terms, rise, LIMIT_SIGMA);
            }
            if rise < -FALL_MAX {
                prior.add(&terms, rise + FALL_MAX, LIMIT_SIGMA);
            }
            if k > 1 {
                let bend = theta[k] - 2.0 * theta[k - 1] + theta[k - 2];
                prior.add(&[(k - 2, 1.0), (k - 1, -2.0), (k, 1.0)], bend, BEND_SIGMA);
            }
        }
        prior
    }
}

impl Hyperprior {
    /// No knowledge of this many parameters.
    pub(in crate::imaging) fn flat(count: usize) -> Self {
        Self { value: 0.0, gradient: vec![0.0; count], precision: Mat::zeros(count, count) }
    }

    /// Adds a Gaussian prior of width `sigma` for the linear combination `terms`, which deviates from its mean by `deviation`.
    pub(in crate::imaging) fn add(&mut self, terms: &[(usize, f64)], deviation: f64, sigma: f64) {
        let weight = sigma.powi(-2);
        self.value -= 0.5 * weight * deviation * deviation;
        for &(k, factor) in terms {
            self.gradient[k] -= weight * deviation * factor;
            for &(j, other) in terms {
                self.precision[(k, j)] += weight * factor * other;
            }
        }
    }
}
