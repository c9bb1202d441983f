//! The largest eigenvalue by Lanczos iteration.

use faer::{Mat, Side};
use rand_distr::{Distribution, StandardNormal};

use super::vectors::{dot, norm, orthogonalise};
use crate::imaging::NormalSums;
use crate::units::{StreamKind, random_stream};

/// Maximum number of iterations; 20 to 40 are usual.
const ITERATIONS_MAX: usize = 200;

/// The largest eigenvalue, with its convergence.
#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize)]
pub struct LargestEigenvalue {
    /// W_max, K^-2.
    pub value: f64,
    /// Number of products with the matrix.
    pub iterations: usize,
    /// Relative change in the last iteration.
    pub change: f64,
}

/// Relative change at which W_max is as accurate as sums in f64 allow.
pub const W_MAX_EXACT: f64 = 1e-10;

/// Computes W_max of `BtN^-1B` by Lanczos iteration from a fixed random vector, with full reorthogonalisation.
///
/// The Ritz value rises towards W_max. The iteration ends after two successive relative changes below `tolerance`; the
/// error is then of the same order, as it falls by a constant factor per iteration. `report` receives the number of
/// products and the last change, and ends the iteration early by returning `false`.
#[must_use]
pub fn largest_eigenvalue(
    sums: &dyn NormalSums,
    tolerance: f64,
    report: &mut dyn FnMut(usize, f64) -> bool,
) -> LargestEigenvalue {
    let start = random_vector(sums.unknowns());
    largest_eigenvalue_from(start, sums, tolerance, &mut |needs_step, step, change| {
        report(step, change) && needs_step
    })
}

/// A fixed vector of random direction.
pub(in crate::imaging) fn random_vector(order: usize) -> Vec<f64> {
    let mut stream = random_stream(0, StreamKind::Probe, [order as u64, 0]);
    (0..order).map(|_| StandardNormal.sample(&mut stream)).collect()
}

/// Computes W_max as [`largest_eigenvalue`], from a given start vector, which should overlap with all eigenvectors of large eigenvalues.
/// `report` also receives whether another step is needed, and decides.
pub(in crate::imaging) fn largest_eigenvalue_from(
    start: Vec<f64>,
    sums: &dyn NormalSums,
    tolerance: f64,
    report: &mut dyn FnMut(bool, usize, f64) -> bool,
) -> LargestEigenvalue {
    let order = sums.unknowns();
    let mut krylov = Krylov::new(start);
    let mut found = LargestEigenvalue { value: 0.0, iterations: 0, change: f64::INFINITY };
    let (mut small_changes, mut needs_step) = (0, order > 0);
    while needs_step {
        let can_grow = krylov.step(sums);
        let value = largest_of_tridiagonal(&krylov.alphas, &krylov.betas);
        found.iterations += 1;
        found.change = ((value - found.value) / value).abs();
        found.value = value;
        small_changes = if found.change < tolerance { small_changes + 1 } else { 0 };
        // In an invariant subspace the Ritz value is exact.
        needs_step = can_grow && small_changes < 2 && found.iterations < ITERATIONS_MAX.min(order);
        needs_step = report(needs_step, found.iterations, found.change);
    }
    found
}

/// An orthonormal basis of the Krylov space of `v, A v, A^2 v, ..`, in which A is tridiagonal.
pub(in crate::imaging) struct Krylov {
    pub(in crate::imaging) basis: Vec<Vec<f64>>,
    pub(in crate::imaging) alphas: Vec<f64>,
    pub(in crate::imaging) betas: Vec<f64>,
}

impl Krylov {
    pub(in crate::imaging) fn new(start: Vec<f64>) -> Self {
        Self { basis: vec![normalised(start)], alphas: Vec::new(), betas: Vec::new() }
    }

    /// Extends the space by one product with A, and returns whether it can grow further.
    pub(in crate::imaging) fn step(&mut self, sums: &dyn NormalSums) -> bool {
        let Some(last) = self.basis.last() else { return false };
        let mut next = vec![0.0; last.len()];
        sums.apply(last, &mut next);
        self.alphas.push(dot(last, &next));
        orthogonalise(&mut next, &self.basis);
        let beta = norm(&next);
        let largest = self.alphas.iter().fold(0.0_f64, |a, b| a.max(b.abs()));
        if beta.is_nan() || beta <= f64::EPSILON * largest {
            return false;
        }
        self.betas.push(beta);
        self.basis.push(normalised(next));
        true
    }
}

/// The vector scaled to unit norm.
pub(in crate::imaging) fn normalised(mut vector: Vec<f64>) -> Vec<f64> {
    let norm = norm(&vector);
    vector.iter_mut().for_each(|x| *x /= norm);
    vector
}

/// Eigenvalues and eigenvectors of a tridiagonal matrix.
pub(super) fn tridiagonal_eigen(diagonal: &[f64], off_diagonal: &[f64]) -> Option<(Vec<f64>, Mat<f64>)> {
    // The decomposition has absolute thresholds, so the matrix is scaled to order one.
    let scale = diagonal.iter().fold(f64::MIN_POSITIVE, |a, b| a.max(b.abs()));
    let matrix = Mat::from_fn(diagonal.len(), diagonal.len(), |i, j| match i.abs_diff(j) {
        0 => diagonal[i] / scale,
        1 => off_diagonal[i.min(j)] / scale,
        _ => 0.0,
    });
    let decomposed = matrix.self_adjoint_eigen(Side::Lower).ok()?;
    let eigenvalues = decomposed.S().column_vector().iter().map(|w| w * scale).collect();
    Some((eigenvalues, decomposed.U().to_owned()))
}

/// Largest eigenvalue of a symmetric tridiagonal matrix by bisection on Sturm counts.
fn largest_of_tridiagonal(diagonal: &[f64], off_diagonal: &[f64]) -> f64 {
    let radius = |k: usize| {
        let left = if k > 0 { off_diagonal[k - 1].abs() } else { 0.0 };
        let right = if k + 1 < diagonal.len() { off_diagonal[k].abs() } else { 0.0 };
        left + right
    };
    // Gershgorin's circles bound the eigenvalues.
    let mut high = (0..diagonal.len()).map(|k| diagonal[k] + radius(k)).fold(f64::MIN, f64::max);
    let mut low = diagonal.iter().copied().fold(f64::MIN, f64::max);
    let is_upper_bound = |x: f64| {
        let mut pivot = diagonal[0] - x;
        for k in 1..diagonal.len() {
            if pivot >= 0.0 {
                return false;
            }
            pivot = diagonal[k] - x - off_diagonal[k - 1] * off_diagonal[k - 1] / pivot;
        }
        pivot < 0.0
    };
    for _ in 0..200 {
        let middle = 0.5 * (low + high);
        if middle <= low || middle >= high {
            break;
        }
        if is_upper_bound(middle) { high = middle } else { low = middle }
    }
    high
}
