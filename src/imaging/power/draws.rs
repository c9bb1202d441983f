//! Draws from the Gaussian of covariance `(A + R)^-1`: what a map may be off by, and how traces are found.
//!
//! With L the Cholesky factor of the blocks plus R, `K = L^-1 (A + R) L^-t` is near the identity, so that a few Lanczos steps from unit
//! normal numbers w give `K^(-1/2) w`, and `d = L^-t K^(-1/2) w` has the covariance `(A + R)^-1`. Sums alone are needed, no visibility.
//! `L^-t w` is a draw for the blocks alone, of the same w: the squares of both differ by little more than the traces do.

use faer::{Mat, Side};
use rand_distr::{Distribution, StandardNormal};

use super::blocks::Factors;
use crate::imaging::regulariser::Diagonal;
use crate::imaging::solver::SolveTask;
use crate::imaging::solver::{dot, normalised, subtract};
use crate::units::{StreamKind, random_stream};

/// Change of a sample from step to step, relative, at which it is done: far below what samples scatter by.
pub(in crate::imaging) const SAMPLE_SETTLED: f64 = 1e-3;
/// The same of a draw from which traces are taken: what is left is the error of a mean over many degrees.
pub(super) const TRACE_SETTLED: f64 = 1e-2;
/// Most steps.
const STEPS_MAX: usize = 100;

/// A draw for the true normal matrix, and that of the same numbers for its blocks.
pub(in crate::imaging) struct Drawn {
    pub(in crate::imaging) whole: Vec<f64>,
    pub(in crate::imaging) of_blocks: Vec<f64>,
}

/// The matrix whose inverse is the covariance of draws.
#[derive(Clone, Copy)]
pub(in crate::imaging) struct Covariance<'a> {
    /// Products with the normal matrix.
    pub(in crate::imaging) products: &'a dyn Fn(&[&[f64]]) -> Vec<Vec<f64>>,
    pub(in crate::imaging) unknowns: usize,
    pub(in crate::imaging) regularisation: &'a Diagonal,
    pub(in crate::imaging) factors: &'a Factors<'a>,
}

/// A draw on its way.
struct Path {
    basis: Vec<Vec<f64>>,
    alphas: Vec<f64>,
    betas: Vec<f64>,
    length: f64,
    /// `T^(-1/2) e1` of the last step.
    coefficients: Vec<f64>,
    change: f64,
    settled: f64,
    is_open: bool,
}

impl Path {
    fn new(start: Vec<f64>, settled: f64) -> Self {
        let length = dot(&start, &start).sqrt();
        Self {
            basis: vec![normalised(start)],
            alphas: Vec::new(),
            betas: Vec::new(),
            length,
            coefficients: Vec::new(),
            change: f64::INFINITY,
            settled,
            is_open: length > 0.0,
        }
    }

    fn step(&mut self, mut next: Vec<f64>) {
        let Some(last) = self.basis.last() else { return };
        self.alphas.push(dot(last, &next));
        for _ in 0..2 {
            for vector in &self.basis {
                let part = dot(vector, &next);
                subtract(&mut next, part, vector);
            }
        }
        let Some(coefficients) = inverse_root(&self.alphas, &self.betas) else {
            self.is_open = false;
            return;
        };
        let padded = self.coefficients.iter().copied().chain(std::iter::repeat(0.0));
        let square: f64 = coefficients.iter().zip(padded).map(|(a, b)| (a - b).powi(2)).sum();
        self.change = (square / dot(&coefficients, &coefficients)).sqrt();
        self.coefficients = coefficients;
        let beta = dot(&next, &next).sqrt();
        let is_closed = beta.is_nan() || beta <= 1e-12 * self.alphas[0].abs();
        self.is_open = !is_closed && self.change > self.settled && self.alphas.len() < STEPS_MAX;
        if self.is_open {
            self.betas.push(beta);
            self.basis.push(normalised(next));
        }
    }

    /// `K^(-1/2)` times the start.
    fn end(&self) -> Vec<f64> {
        let mut sum = vec![0.0; self.basis[0].len()];
        for (vector, factor) in self.basis.iter().zip(&self.coefficients) {
            subtract(&mut sum, -self.length * factor, vector);
        }
        sum
    }
}

/// `T^(-1/2) e1` of a tridiagonal matrix; `None` unless it is positive definite.
fn inverse_root(alphas: &[f64], betas: &[f64]) -> Option<Vec<f64>> {
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

impl Covariance<'_> {
    /// Products with K of several vectors.
    fn products(&self, vectors: &[&[f64]]) -> Vec<Vec<f64>> {
        let upper: Vec<Vec<f64>> = vectors
            .iter()
            .map(|vector| {
                let mut vector = vector.to_vec();
                self.factors.solve_upper(&mut vector);
                vector
            })
            .collect();
        let of: Vec<&[f64]> = upper.iter().map(Vec::as_slice).collect();
        let mut products = (self.products)(&of);
        for (product, vector) in products.iter_mut().zip(&upper) {
            self.regularisation.add_product(vector, product);
            self.factors.solve_lower(product);
        }
        products
    }

    /// Draws, one for each number of `which`, from numbers that depend on it alone, until none changes by more than `settled`. They share
    /// products.
    pub(in crate::imaging) fn draw(&self, which: &[u64], settled: f64, task: &SolveTask<'_>) -> Vec<Drawn> {
        let unknowns = self.unknowns;
        let normal = |which: &u64| -> Vec<f64> {
            let mut stream = random_stream(3, StreamKind::Probe, [unknowns as u64, *which]);
            (0..unknowns).map(|_| StandardNormal.sample(&mut stream)).collect()
        };
        let starts: Vec<Vec<f64>> = which.iter().map(normal).collect();
        let mut paths: Vec<Path> = starts.iter().map(|start| Path::new(start.clone(), settled)).collect();
        loop {
            let wants: Vec<bool> = paths.iter().map(|path| path.is_open).collect();
            let change = paths.iter().map(|path| path.change).fold(0.0, f64::max).min(1.0);
            let steps = paths.iter().map(|path| path.alphas.len()).max().unwrap_or(0);
            let goes_on = task.report_each(&wants, steps, change);
            let mut open: Vec<&mut Path> =
                paths.iter_mut().zip(goes_on).filter_map(|(path, on)| on.then_some(path)).collect();
            if open.is_empty() {
                break;
            }
            let vectors: Vec<&[f64]> =
                open.iter().filter_map(|path| path.basis.last().map(Vec::as_slice)).collect();
            let products = self.products(&vectors);
            open.iter_mut().zip(products).for_each(|(path, product)| path.step(product));
        }
        let upper = |mut vector: Vec<f64>| {
            self.factors.solve_upper(&mut vector);
            vector
        };
        let ended = paths.iter().zip(starts);
        ended.map(|(path, start)| Drawn { whole: upper(path.end()), of_blocks: upper(start) }).collect()
    }
}
