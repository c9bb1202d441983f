//! Errors of a map by the gains that calibration applied: maps of draws of them.
//!
//! A map is linear in the data, so that errors e of the data make `x = (A + R)^-1 BtN^-1e` of it. With a draw of the errors of all gains for e, x
//! is a draw of the map's error; it is independent of that by noise and by what R expects of the sky.

use rand_distr::{Distribution, StandardNormal};

use super::coefficients;
use super::sigma::moments_k;
use crate::imaging::SolveError;
use crate::imaging::power::GainUncertainty;
use crate::imaging::solver::dot;
use crate::imaging::unknowns::degrees;
use crate::sky::harmonics::synthesis;
use crate::sky::healpix::pixel_directions;
use crate::units::{StreamKind, random_stream};

/// Unknowns of the maps of draws.
pub(super) struct ErrorDraws {
    pub(super) unknowns: Vec<Vec<f64>>,
    pub(super) l_max: usize,
}

impl ErrorDraws {
    fn mean(&self, of: impl Fn(&[f64]) -> f64) -> f64 {
        self.unknowns.iter().map(|draw| of(draw)).sum::<f64>() / self.unknowns.len() as f64
    }

    /// Variances of the pixels, K^2, by latitude alone, as those by noise are.
    pub(super) fn pixel_variances_k2(&self, nside: usize) -> Result<Vec<f64>, SolveError> {
        let z: Vec<f64> = pixel_directions(nside).iter().map(|direction| direction[2]).collect();
        let mut squares = vec![0.0; z.len()];
        for draw in &self.unknowns {
            let map_k = synthesis(&coefficients(draw, self.l_max), nside)?;
            squares.iter_mut().zip(map_k).for_each(|(sum, value)| *sum += value * value);
        }
        let mut first = 0;
        for ring in z.chunk_by(|a, b| a == b) {
            let pixels = &mut squares[first..first + ring.len()];
            let mean = pixels.iter().sum::<f64>() / (ring.len() * self.unknowns.len()) as f64;
            pixels.fill(mean);
            first += ring.len();
        }
        Ok(squares)
    }

    /// Variances of mean and dipole, K^2.
    pub(super) fn moment_variances_k2(&self) -> [f64; 4] {
        [0, 1, 2, 3].map(|k| self.mean(|draw| moments_k(draw, self.l_max)[k].powi(2)))
    }

    /// Variances of the logarithm of the angular power of a solution, by degree: of the power within half an octave on both sides, as the power
    /// of the sky is a curve that is smooth over an octave.
    pub(super) fn ln_power_variances(&self, solved: &[f64]) -> Vec<f64> {
        let mut variances = vec![0.0; self.l_max + 1];
        let power = by_degree(solved, solved, self.l_max);
        for draw in &self.unknowns {
            let (cross, own) = (by_degree(solved, draw, self.l_max), by_degree(draw, draw, self.l_max));
            for (l, variance) in variances.iter_mut().enumerate() {
                let [low, high] = [0.5_f64.sqrt(), 2.0_f64.sqrt()].map(|factor| factor * l as f64);
                let near = low.ceil() as usize..=(high.floor() as usize).min(self.l_max);
                let sum = |of: &[f64]| near.clone().filter_map(|l| of.get(l)).sum::<f64>();
                let change = (2.0 * sum(&cross) + sum(&own)) / sum(&power);
                *variance +=
                    if change.is_finite() { change * change / self.unknowns.len() as f64 } else { 0.0 };
            }
        }
        variances
    }

    /// The power of the data that a map takes from draws with these right-hand sides, as far as it is regularised by R.
    pub(super) fn fitted_power(&self, right: &[Vec<f64>], r: &[f64]) -> f64 {
        // |e|^2 - |e - B x|^2 = 2 x.b - x.A x, and A x = b - R x.
        let of_draw = |(x, b): (&Vec<f64>, &Vec<f64>)| {
            dot(x, b) + degrees(self.l_max).zip(x).map(|(l, x)| r[l] * x * x).sum::<f64>()
        };
        self.unknowns.iter().zip(right).map(of_draw).sum::<f64>() / self.unknowns.len() as f64
    }

    /// Another draw, as likely as these: a sum of all with Gaussian weights.
    pub(super) fn drawn(&self, number: u64) -> Vec<f64> {
        let mut sum = vec![0.0; self.unknowns.first().map_or(0, Vec::len)];
        let count = self.unknowns.len();
        let mut stream = random_stream(count as u64, StreamKind::GainErrors, [number, u64::MAX]);
        for draw in &self.unknowns {
            let normal: f64 = StandardNormal.sample(&mut stream);
            let weight = normal / (count as f64).sqrt();
            sum.iter_mut().zip(draw).for_each(|(sum, x)| *sum += weight * x);
        }
        sum
    }

    pub(super) fn summary(&self, pixel_variances_k2: &[f64], mean_variance_k2: f64) -> GainUncertainty {
        let mut power_k2 = vec![0.0; self.l_max + 1];
        for draw in &self.unknowns {
            for (l, square) in by_degree(draw, draw, self.l_max).into_iter().enumerate() {
                power_k2[l] += square / ((2 * l + 1) * self.unknowns.len()) as f64;
            }
        }
        GainUncertainty {
            draws: self.unknowns.len(),
            sigma_rms_k: (pixel_variances_k2.iter().sum::<f64>() / pixel_variances_k2.len() as f64).sqrt(),
            mean_sigma_k: mean_variance_k2.sqrt(),
            power_k2,
        }
    }
}

/// Sums of products of unknowns, by degree.
fn by_degree(x: &[f64], y: &[f64], l_max: usize) -> Vec<f64> {
    let mut sums = vec![0.0; l_max + 1];
    degrees(l_max).zip(x).zip(y).for_each(|((l, x), y)| sums[l] += x * y);
    sums
}
