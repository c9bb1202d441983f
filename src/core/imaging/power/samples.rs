//! Samples from the posterior, a Gaussian with covariance `(A + R)^-1`, for map errors and for stochastic trace estimates.
//!
//! A is the normal matrix and L the Cholesky factor of the preconditioner. `K = L^-1 (A + R) L^-t` is near the identity, so that a few Lanczos
//! steps from a standard normal vector w give `K^(-1/2) w`, and `d = L^-t K^(-1/2) w` has the covariance `(A + R)^-1`. With the factor of the
//! blocks alone, `L^-t w` is the matching sample of the blocks plus R: as both come from the same w, the difference of their squared norms has
//! little variance, so it serves as a control variate for the trace.

use faer::{Mat, Side};
use rand_distr::{Distribution, StandardNormal};

use super::blocks::Factors;
use crate::imaging::regulariser::Diagonal;
use crate::imaging::solver::SolveTask;
use crate::imaging::solver::{dot, normalised, orthogonalise};
use crate::units::{StreamKind, random_stream};

/// Relative change per Lanczos step at which a sample has converged; far below the scatter of samples.
pub(in crate::imaging) const SAMPLE_TOLERANCE: f64 = 1e-3;
/// Looser tolerance for trace estimates, whose error averages out over many degrees.
pub(super) const TRACE_TOLERANCE: f64 = 1e-2;
/// Maximum number of Lanczos steps.
const STEPS_MAX: usize = 100;
/// Seed of the random vectors; streams of probes have smaller ones.
const SAMPLE_SEED: u64 = 3;

/// A sample of the posterior without its mean, and one of the blocks plus R from the same random vector.
pub(in crate::imaging) struct PosteriorSample {
    pub(in crate::imaging) exact: Vec<f64>,
    pub(in crate::imaging) of_blocks: Vec<f64>,
}

/// Products of the normal matrix with several vectors.
pub(in crate::imaging) type Products<'a> = dyn Fn(&[&[f64]]) -> Vec<Vec<f64>> + 'a;

/// The posterior's precision matrix A + R with its preconditioner.
#[derive(Clone, Copy)]
pub(in crate::imaging) struct PosteriorPrecision<'a> {
    pub(in crate::imaging) products: &'a Products<'a>,
    pub(in crate::imaging) unknowns: usize,
    pub(in crate::imaging) regularisation: &'a Diagonal,
    pub(in crate::imaging) factors: &'a Factors<'a>,
}

/// The Lanczos iteration for one sample.
struct LanczosSampler {
    basis: Vec<Vec<f64>>,
    alphas: Vec<f64>,
    betas: Vec<f64>,
    /// Norm of the start vector.
    start_norm: f64,
    /// `T^(-1/2) e1` after the last step.
    coefficients: Vec<f64>,
    change: f64,
    tolerance: f64,
    is_running: bool,
}

impl LanczosSampler {
    fn new(start: Vec<f64>, tolerance: f64) -> Self {
        let start_norm = dot(&start, &start).sqrt();
        Self {
            basis: vec![normalised(start)],
            alphas: Vec::new(),
            betas: Vec::new(),
            start_norm,
            coefficients: Vec::new(),
            change: f64::INFINITY,
            tolerance,
            is_running: start_norm > 0.0,
        }
    }

    fn step(&mut self, mut next: Vec<f64>) {
        let Some(last) = self.basis.last() else { return };
        self.alphas.push(dot(last, &next));
        orthogonalise(&mut next, &self.basis);
        let Some(coefficients) = inverse_sqrt_first_column(&self.alphas, &self.betas) else {
            self.is_running = false;
            return;
        };
        let padded = self.coefficients.iter().copied().chain(std::iter::repeat(0.0));
        let square: f64 = coefficients.iter().zip(padded).map(|(a, b)| (a - b).powi(2)).sum();
        self.change = (square / dot(&coefficients, &coefficients)).sqrt();
        self.coefficients = coefficients;
        let beta = dot(&next, &next).sqrt();
        let has_broken_down = beta.is_nan() || beta <= 1e-12 * self.alphas[0].abs();
        self.is_running = !has_broken_down && self.change > self.tolerance && self.alphas.len() < STEPS_MAX;
        if self.is_running {
            self.betas.push(beta);
            self.basis.push(normalised(next));
        }
    }

    /// `K^(-1/2)` times the start vector; before the first step K counts as the identity.
    fn sample(&self) -> Vec<f64> {
        let mut sum = vec![0.0; self.basis[0].len()];
        let coefficients = if self.coefficients.is_empty() { &[1.0][..] } else { &self.coefficients };
        for (vector, factor) in self.basis.iter().zip(coefficients) {
            sum.iter_mut().zip(vector).for_each(|(sum, x)| *sum += self.start_norm * factor * x);
        }
        sum
    }
}

/// The first column of `T^(-1/2)` for a tridiagonal matrix T; `None` unless T is positive definite.
fn inverse_sqrt_first_column(alphas: &[f64], betas: &[f64]) -> Option<Vec<f64>> {
    let size = alphas.len();
    let matrix = Mat::from_fn(size, size, |i, j| match i.abs_diff(j) {
        0 => alphas[i],
        1 => betas[i.min(j)],
        _ => 0.0,
    });
    let decomposed = matrix.self_adjoint_eigen(Side::Lower).ok()?;
    let (values, vectors) = (decomposed.S().column_vector(), decomposed.U());
    if (0..size).any(|k| values[k].is_nan() || values[k] <= 0.0) {
        return None;
    }
    let element = |i: usize| (0..size).map(|k| vectors[(i, k)] * vectors[(0, k)] / values[k].sqrt()).sum();
    Some((0..size).map(element).collect())
}

impl PosteriorPrecision<'_> {
    /// Multiplies several vectors by K.
    fn products(&self, vectors: &[&[f64]]) -> Vec<Vec<f64>> {
        let upper: Vec<Vec<f64>> = vectors
            .iter()
            .map(|vector| {
                let mut vector = vector.to_vec();
                self.factors.solve_upper(&mut vector);
                vector
            })
            .collect();
        let upper_slices: Vec<&[f64]> = upper.iter().map(Vec::as_slice).collect();
        let mut products = (self.products)(&upper_slices);
        for (product, vector) in products.iter_mut().zip(&upper) {
            self.regularisation.add_product(vector, product);
            self.factors.solve_lower(product);
        }
        products
    }

    /// Draws one sample for each of `sample_ids`, which determines its random vector. Samples share matrix products, and the iteration stops
    /// when none changes by more than `tolerance`.
    pub(in crate::imaging) fn draw(
        &self,
        sample_ids: &[u64],
        tolerance: f64,
        task: &SolveTask<'_>,
    ) -> Vec<PosteriorSample> {
        let unknowns = self.unknowns;
        let normal_vector = |id: &u64| -> Vec<f64> {
            let mut stream = random_stream(SAMPLE_SEED, StreamKind::Probe, [unknowns as u64, *id]);
            (0..unknowns).map(|_| StandardNormal.sample(&mut stream)).collect()
        };
        let starts: Vec<Vec<f64>> = sample_ids.iter().map(normal_vector).collect();
        let mut samplers: Vec<LanczosSampler> =
            starts.iter().map(|start| LanczosSampler::new(start.clone(), tolerance)).collect();
        loop {
            let needs_step: Vec<bool> = samplers.iter().map(|sampler| sampler.is_running).collect();
            let change = samplers.iter().map(|sampler| sampler.change).fold(0.0, f64::max).min(1.0);
            let steps = samplers.iter().map(|sampler| sampler.alphas.len()).max().unwrap_or(0);
            let continues = task.report_each(&needs_step, steps, change);
            let mut running: Vec<&mut LanczosSampler> = samplers
                .iter_mut()
                .zip(continues)
                .filter_map(|(sampler, continues)| continues.then_some(sampler))
                .collect();
            if running.is_empty() {
                break;
            }
            let vectors: Vec<&[f64]> =
                running.iter().filter_map(|sampler| sampler.basis.last().map(Vec::as_slice)).collect();
            let products = self.products(&vectors);
            running.iter_mut().zip(products).for_each(|(sampler, product)| sampler.step(product));
        }
        let finished = samplers.iter().zip(starts);
        finished
            .map(|(sampler, mut start)| {
                let mut exact = sampler.sample();
                self.factors.solve_upper(&mut exact);
                self.factors.solve_upper_of_blocks(&mut start);
                PosteriorSample { exact, of_blocks: start }
            })
            .collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_sample_without_a_step_is_that_of_the_preconditioner() {
        let sample = LanczosSampler::new(vec![3.0, -4.0], SAMPLE_TOLERANCE).sample();
        // But for the rounding of a normalised vector.
        assert!(
            sample.iter().zip([3.0, -4.0]).all(|(found, start)| (found - start).abs() < 1e-14),
            "{sample:?}"
        );
    }
}
