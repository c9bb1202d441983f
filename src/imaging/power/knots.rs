//! The angular power as a curve of few parameters: straight lines in logarithms between knots an octave apart.

use faer::Mat;

/// Degree of the first knot: those below it are free.
pub(super) const FIRST: usize = 2;
/// Degrees whose prior is free: a mean and a dipole are what they are, whatever the power of structure.
pub(super) const FREE: usize = FIRST;
/// How many times the power at [`FIRST`] a monopole and a dipole have in their prior: far more than any sky.
const FREE_FACTORS: [f64; FREE] = [1e6, 1e4];
/// Fall of ln C_l from knot to knot that is expected where the data say nothing, and how far it may be off: the sky between 1 and 100
/// MHz falls like `l^-2` to `l^-3.5` at all scales.
const FALL: f64 = 2.7 * std::f64::consts::LN_2;
const FALL_SIGMA: f64 = 1.4;
/// Change of the fall from knot to knot, likewise.
const BEND_SIGMA: f64 = 0.7;
/// How far ln C_l of the first knot may be off the amplitude with which the search began.
const LEVEL_SIGMA: f64 = 6.0;
/// Greatest fall from knot to knot (`l^-8`), and how far beyond it, or above none at all, a curve may go.
const FALL_MAX: f64 = 8.0 * std::f64::consts::LN_2;
const EDGE_SIGMA: f64 = 0.1;

/// Knots for the degrees up to `l_max`.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Knots {
    l_max: usize,
    count: usize,
    /// ln C_l of the first knot at which the search began.
    level: f64,
}

/// Logarithm of the parameters' prior with its derivatives.
pub(super) struct Hyperprior {
    pub(super) value: f64,
    pub(super) gradient: Vec<f64>,
    /// The negative second derivative.
    pub(super) precision: Mat<f64>,
}

impl Knots {
    pub(super) fn new(l_max: usize, level: f64) -> Self {
        let octaves = ((l_max + 1) as f64 / (FIRST + 1) as f64).log2().ceil().max(1.0);
        Self { l_max, count: octaves as usize + 1, level }
    }

    pub(super) fn count(&self) -> usize {
        self.count
    }

    /// The parameters of `C_l` proportional to `(l + 1)^-2`, with `level` at the first knot.
    pub(super) fn plain(&self) -> Vec<f64> {
        (0..self.count).map(|k| self.level - 2.0 * std::f64::consts::LN_2 * k as f64).collect()
    }

    /// The knots between which a degree lies, with their weights; nothing for a free degree.
    pub(super) fn weights(&self, l: usize) -> [(usize, f64); 2] {
        if l < FREE {
            return [(0, 0.0), (0, 0.0)];
        }
        let place = ((l + 1) as f64 / (FIRST + 1) as f64).log2();
        let below = (place.floor() as usize).min(self.count - 2);
        let share = place - below as f64;
        [(below, 1.0 - share), (below + 1, share)]
    }

    /// ln C_l for l = 0 ..= l_max.
    pub(super) fn log_power(&self, theta: &[f64]) -> Vec<f64> {
        let of_degree = |l: usize| match FREE_FACTORS.get(l) {
            // Of the beginning: what is free does not follow the structure.
            Some(factor) => self.level + factor.ln(),
            None => self.weights(l).iter().map(|(k, share)| share * theta[*k]).sum(),
        };
        (0..=self.l_max).map(of_degree).collect()
    }

    /// What is expected of the parameters before any data.
    pub(super) fn hyperprior(&self, theta: &[f64]) -> Hyperprior {
        let mut prior = Hyperprior {
            value: 0.0,
            gradient: vec![0.0; self.count],
            precision: Mat::zeros(self.count, self.count),
        };
        prior.add(&[(0, 1.0)], theta[0] - self.level, LEVEL_SIGMA);
        for k in 1..self.count {
            let terms = [(k - 1, -1.0), (k, 1.0)];
            let rise = theta[k] - theta[k - 1];
            prior.add(&terms, rise + FALL, FALL_SIGMA);
            if rise > 0.0 {
                prior.add(&terms, rise, EDGE_SIGMA);
            }
            if rise < -FALL_MAX {
                prior.add(&terms, rise + FALL_MAX, EDGE_SIGMA);
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
    /// A Gaussian of width `sigma` of the sum of `terms`, which is `off` its mean.
    fn add(&mut self, terms: &[(usize, f64)], off: f64, sigma: f64) {
        let weight = sigma.powi(-2);
        self.value -= 0.5 * weight * off * off;
        for &(k, factor) in terms {
            self.gradient[k] -= weight * off * factor;
            for &(j, other) in terms {
                self.precision[(k, j)] += weight * factor * other;
            }
        }
    }
}
