//! Functions of BtN^-1B without the matrix, from the Krylov spaces of random probes.
//!
//! k Lanczos steps from a vector v give a tridiagonal T with `v.f(A)v = |v|^2 e1.f(T)e1` for all polynomials f up to degree 2 k - 1, and
//! `f(A)v ~ |v| Q f(T) e1` (Golub & Meurant 2010).

use faer::Mat;
use rand_distr::{Distribution, StandardNormal};

use super::error::SolveError;
use super::lanczos::{Krylov, W_MAX_EXACT, largest_eigenvalue, tridiagonal_eigen};
use super::vectors::norm;
use super::watch::{NamedWatch, SolveTask};
use crate::imaging::NormalSums;
use crate::imaging::circle::{HarmonicSums, coefficients, unknowns};
use crate::sky::harmonics::Transform;
use crate::units::{StreamKind, random_stream};

/// Maximum number of steps per probe.
const STEPS_MAX: usize = 120;
/// Steps between tests of convergence.
const STEPS_BETWEEN: usize = 5;
/// Relative change at which a function has converged: a hundredth of the spread of a few random probes.
const TOLERANCE: f64 = 1e-4;

/// Estimates the thermal noise variance of every pixel of an `nside` map, K^2, from `probes` noise maps.
///
/// Each noise map is `(A + eps)^-1 A^(1/2) g` with a standard normal vector g, which has exactly the covariance
/// `W / (W + eps)^2`. The relative error of a pixel's variance is `sqrt(2 / probes)`.
///
/// # Errors
/// There is no transform for this nside or degree.
pub fn noise_variance(
    sums: &HarmonicSums,
    regularisation: f64,
    nside: usize,
    probes: usize,
    watch: NamedWatch<'_>,
) -> Result<Vec<f64>, SolveError> {
    let eps = regularisation;
    let transform = Transform::new(nside, sums.setup().l_max)?;
    let mut variance = vec![0.0; crate::sky::healpix::pixel_count(nside)];
    for probe in 0..probes {
        let task = watch.start(&format!("noise map {} of {probes}", probe + 1), TOLERANCE);
        let mut stream = random_stream(1, StreamKind::Probe, [sums.unknowns() as u64, probe as u64]);
        let start: Vec<f64> = (0..sums.unknowns()).map(|_| StandardNormal.sample(&mut stream)).collect();
        let start_norm = norm(&start);
        let noise = |w: f64| w.max(0.0).sqrt() / (w + eps);
        let space = converged_space(sums, start, &task, &|w| noise(w).powi(2));
        let map =
            transform.synthesis(&coefficients(&space.function(start_norm, noise), sums.setup().l_max))?;
        variance.iter_mut().zip(map).for_each(|(sum, x)| *sum += x * x / probes as f64);
    }
    Ok(variance)
}

/// The effective beam at one pixel of an `nside` map: a column of `B_eff = (A + eps)^-1 A`, the map of a sky that is
/// 1 K in that pixel only, up to the map's degree.
///
/// # Errors
/// There is no transform for this nside or degree, or the map does not have this pixel.
pub fn effective_beam(
    sums: &HarmonicSums,
    regularisation: f64,
    nside: usize,
    pixel: usize,
    watch: NamedWatch<'_>,
) -> Result<Vec<f64>, SolveError> {
    let l_max = sums.setup().l_max;
    let transform = Transform::new(nside, l_max)?;
    let mut map = vec![0.0; crate::sky::healpix::pixel_count(nside)];
    let pixels = map.len();
    *map.get_mut(pixel).ok_or(SolveError::NoPixel { pixel, pixels })? = 1.0;
    let start = unknowns(&transform.adjoint(&map)?);
    let start_norm = norm(&start);
    let task = watch.start(&format!("beam at pixel {pixel}"), TOLERANCE);
    let beam = |w: f64| w / (w + regularisation);
    let space = converged_space(sums, start, &task, &beam);
    Ok(transform.synthesis(&coefficients(&space.function(start_norm, beam), l_max))?)
}

/// The diagonal element of `R = epsilon W_max I` for some sums.
#[must_use]
pub fn regularisation(sums: &dyn NormalSums, epsilon: f64) -> f64 {
    epsilon * largest_eigenvalue(sums, W_MAX_EXACT, &mut |_, _| true).value
}

/// A Krylov space, and the eigenvalues and eigenvectors of its tridiagonal matrix.
struct ProbedSpace {
    krylov: Krylov,
    eigenvalues: Vec<f64>,
    vectors: Mat<f64>,
}

/// Builds a Krylov space large enough for `e1.f(T)e1` to converge.
fn converged_space(
    sums: &dyn NormalSums,
    start: Vec<f64>,
    task: &SolveTask<'_>,
    f: &dyn Fn(f64) -> f64,
) -> ProbedSpace {
    let mut krylov = Krylov::new(start);
    let mut last = f64::NAN;
    for step in 1..=STEPS_MAX.min(sums.unknowns()) {
        let can_grow = krylov.step(sums);
        if !can_grow || step % STEPS_BETWEEN == 0 {
            let value = tridiagonal_eigen(&krylov.alphas, &krylov.betas).map_or(
                f64::NAN,
                |(eigenvalues, vectors)| {
                    eigenvalues.iter().enumerate().map(|(k, w)| f(*w) * vectors[(0, k)].powi(2)).sum::<f64>()
                },
            );
            let change = ((value - last) / value).abs();
            last = value;
            if !can_grow || change < TOLERANCE || !task.report(step, change) {
                break;
            }
        }
    }
    let (eigenvalues, vectors) =
        tridiagonal_eigen(&krylov.alphas, &krylov.betas).unwrap_or_else(|| (Vec::new(), Mat::new()));
    ProbedSpace { krylov, eigenvalues, vectors }
}

impl ProbedSpace {
    /// The vector `f(A)v`, where v is the start vector of norm `start_norm`.
    fn function(&self, start_norm: f64, f: impl Fn(f64) -> f64) -> Vec<f64> {
        let mut result = vec![0.0; self.krylov.basis.first().map_or(0, Vec::len)];
        for (row, vector) in self.krylov.basis.iter().enumerate().take(self.eigenvalues.len()) {
            let terms = self.eigenvalues.iter().enumerate();
            let factor: f64 =
                terms.map(|(k, w)| f(*w) * self.vectors[(0, k)] * self.vectors[(row, k)]).sum::<f64>()
                    * start_norm;
            result.iter_mut().zip(vector).for_each(|(sum, x)| *sum += factor * x);
        }
        result
    }
}
