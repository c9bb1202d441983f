//! Gibbs sampling: the power given the sky and the sky given the power, in turn, so that samples scatter by what is not known of either
//! (Wandelt, Larson and Lakshminarayanan 2004; Eriksen et al. 2004).
//!
//! Where the data say little of a degree, its power moves slowly from turn to turn. So no chain is followed: each sample begins at parameters
//! of its own, drawn from the Gaussian of the evidence around its maximum, and is what a few turns make of them.

use faer::{Mat, Side};
use rand::{Rng, RngExt};
use rand_distr::{Distribution, StandardNormal};

use super::knots::{FREE_DEGREES, Knots};
use super::{ExpectedLimit, FoundPower};
use crate::units::{StreamKind, random_stream};

/// Turns of each sample: one repairs what the Gaussian of the evidence is wrong in, and a second what is left.
const TURNS: usize = 2;
/// Steps of Metropolis' walk through the few parameters; a tenth of them make one that is independent.
const WALK: usize = 200;
/// Length of a step in units of the conditional distribution's width, over the root of the number of parameters (Gelman et al. 1996).
const STEP: f64 = 2.4;

impl FoundPower {
    /// A sky as likely as the data say, C_l not known: of the coefficients that `draw` gives for R by degree, each drawn given the data and R.
    pub(in crate::imaging) fn gibbs(
        &self,
        number: u64,
        draw: &mut dyn FnMut(&[f64]) -> Vec<f64>,
    ) -> Vec<f64> {
        let mut stream = random_stream(5, StreamKind::Probe, [self.solution.len() as u64, number]);
        let knots = self.fit.knots.clone();
        let mut theta = moved(&self.fit.theta, &self.covariance, 1.0, &mut stream);
        let mut draw =
            |theta: &[f64]| draw(&knots.power(theta).into_iter().map(f64::recip).collect::<Vec<f64>>());
        let mut sky = draw(&theta);
        for _ in 0..TURNS {
            let squares = self.squares(&sky);
            theta = given_sky((&knots, &self.fit.limit), theta, &squares, &mut stream);
            sky = draw(&theta);
        }
        sky
    }

    /// Sums of squares of coefficients by degree, of data whose noise is one.
    fn squares(&self, sky: &[f64]) -> Vec<f64> {
        let mut squares = vec![0.0; self.regularisation.len()];
        for (l, x) in self.degrees.iter().zip(sky) {
            squares[*l] += (x / self.power.noise_factor).powi(2);
        }
        squares
    }
}

/// Parameters moved by a draw of this covariance.
fn moved(theta: &[f64], covariance: &Mat<f64>, scale: f64, stream: &mut impl Rng) -> Vec<f64> {
    let Ok(factor) = covariance.llt(Side::Lower) else { return theta.to_vec() };
    let normal: Vec<f64> = theta.iter().map(|_| StandardNormal.sample(stream)).collect();
    let step = |k: usize| (0..=k).map(|j| factor.L()[(k, j)] * normal[j]).sum::<f64>();
    theta.iter().enumerate().map(|(k, theta)| theta + scale * step(k)).collect()
}

/// Logarithm of the density of parameters given the sums of squares of coefficients by degree.
fn log_density((knots, limit): (&Knots, &ExpectedLimit), theta: &[f64], squares: &[f64]) -> f64 {
    let term = |(l, ln): (usize, f64)| -0.5 * ((2 * l + 1) as f64 * ln + squares[l] * (-ln).exp());
    let of_sky: f64 = knots.log_power(theta).into_iter().enumerate().skip(FREE_DEGREES).map(term).sum();
    of_sky + knots.hyperprior(theta).value + limit.log_prior(&knots.power(theta))
}

/// Parameters drawn given the sky, by Metropolis' walk from `theta`.
fn given_sky(
    prior: (&Knots, &ExpectedLimit),
    mut theta: Vec<f64>,
    squares: &[f64],
    stream: &mut impl Rng,
) -> Vec<f64> {
    let (knots, _) = prior;
    // Fisher's information of coefficients that are known: half of each.
    let mut precision = knots.hyperprior(&theta).precision;
    for l in FREE_DEGREES..squares.len() {
        for (k, a) in knots.weights(l) {
            for (j, b) in knots.weights(l) {
                precision[(k, j)] += 0.5 * (2 * l + 1) as f64 * a * b;
            }
        }
    }
    let Ok(factor) = precision.llt(Side::Lower) else { return theta };
    let covariance = faer::linalg::solvers::DenseSolveCore::inverse(&factor);
    let scale = STEP / (theta.len() as f64).sqrt();
    let mut here = log_density(prior, &theta, squares);
    for _ in 0..WALK {
        let there = moved(&theta, &covariance, scale, stream);
        let found = log_density(prior, &there, squares);
        if stream.random::<f64>().ln() < found - here {
            (theta, here) = (there, found);
        }
    }
    theta
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The walk's mean and variance of one parameter are those of the density itself, by quadrature over a grid of both parameters.
    #[test]
    fn parameters_given_a_sky_have_their_density() {
        const DRAWS: usize = 1500;
        let knots = Knots::new(4, 1.0);
        assert_eq!(knots.count(), 2);
        let squares = [0.0, 0.0, 9.0, 4.0, 2.0];
        let limit = ExpectedLimit { traces: Vec::new(), max: f64::INFINITY };
        let mut stream = random_stream(9, StreamKind::Probe, [1, 2]);
        let draws: Vec<f64> = (0..DRAWS)
            .map(|_| given_sky((&knots, &limit), vec![1.0, 0.0], &squares, &mut stream)[1])
            .collect();
        // Inverse gamma densities of l = 2, 3, 4 with ln C_l on the line between knots at l + 1 = 3 and 6, times the prior by hand: level,
        // fall, and the edge at which it may not rise.
        let density = |a: f64, b: f64| -> f64 {
            let ln = |l: f64| a + (b - a) * ((l + 1.0) / 3.0).log2();
            let sky: f64 = [2, 3, 4]
                .iter()
                .map(|&l| {
                    let at = ln(l as f64);
                    -0.5 * ((2 * l + 1) as f64 * at + squares[l as usize] * (-at).exp())
                })
                .sum();
            let fall = 2.7 * 2.0_f64.ln();
            let mut prior = ((a - 1.0) / 6.0).powi(2) + ((b - a + fall) / 1.4).powi(2);
            if b > a {
                prior += ((b - a) / 0.1).powi(2);
            }
            if b - a < -8.0 * 2.0_f64.ln() {
                prior += ((b - a + 8.0 * 2.0_f64.ln()) / 0.1).powi(2);
            }
            (sky - 0.5 * prior).exp()
        };
        let grid: Vec<f64> = (-160..160).map(|k| 0.05 * f64::from(k)).collect();
        let mut sums = [0.0; 3];
        for a in &grid {
            for b in &grid {
                let p = density(*a, *b);
                sums = [sums[0] + p, sums[1] + p * b, sums[2] + p * b * b];
            }
        }
        let expected = sums[1] / sums[0];
        let variance = sums[2] / sums[0] - expected * expected;
        let found = draws.iter().sum::<f64>() / DRAWS as f64;
        let scatter = draws.iter().map(|b| (b - found).powi(2)).sum::<f64>() / DRAWS as f64;
        // Four standard errors of independent draws; of a variance with a kurtosis of some 4.
        let error = (variance / DRAWS as f64).sqrt();
        assert!((found - expected).abs() < 4.0 * error, "{found} {expected} {error}");
        let error = variance * (3.0 / DRAWS as f64).sqrt();
        assert!((scatter - variance).abs() < 4.0 * error, "{scatter} {variance}");
    }
}
