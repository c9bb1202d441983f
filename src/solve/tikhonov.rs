//! The regularised solution over pixels.

use serde::Serialize;

use super::cholesky::{Cholesky, NotPositive};
use super::conjugate_gradients::Convergence;
use super::error::SolveError;
use super::lanczos::{LargestEigenvalue, W_MAX_EXACT, largest_eigenvalue};
use super::probing::Traces;
use crate::accumulation::{NormalSums, PixelSums};

/// How a map was found. Eigenvalues and traces are those of pixels, also for a map of harmonics.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Diagnostics {
    /// epsilon of `R = epsilon W_max I`.
    pub epsilon: f64,
    /// W_max, the largest eigenvalue of `BtN^-1B`, K^-2.
    pub w_max: f64,
    /// Lanczos iterations for it.
    pub w_max_iterations: usize,
    /// Greatest degree of a map of harmonics; absent for one of pixels.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub l_max: Option<usize>,
    /// How the iteration for the map ended; absent after a factorisation.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub convergence: Option<Convergence>,
    /// How the iteration for the noise-only map ended.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub noise_convergence: Option<Convergence>,
    /// Traces of the covariances, if they were asked for.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub traces: Option<Traces>,
}

/// A map and its noise-only companion.
#[derive(Clone, Debug, PartialEq)]
pub struct PixelSolution {
    /// Map, K, HEALPix RING.
    pub map_k: Vec<f64>,
    /// Map of noise alone, K.
    pub noise_k: Vec<f64>,
    /// How they were found.
    pub diagnostics: Diagnostics,
}

/// Solves by Cholesky factorisation, in the memory of the sums.
///
/// `T = (BtN^-1B + R)^-1 (BtN^-1V - BtN^-1B T_p) + T_p`; the noise-only map is the same inverse times
/// `BtN^-1n`, without a prior.
///
/// # Errors
/// No data, a prior of another size, or a matrix that is not positive definite.
pub fn solve_pixels(
    sums: PixelSums,
    epsilon: f64,
    prior_k: Option<&[f64]>,
) -> Result<PixelSolution, SolveError> {
    let pixels = sums.unknowns();
    if sums.counts.visibilities == 0 {
        return Err(SolveError::NoData);
    }
    if epsilon.is_nan() || epsilon <= 0.0 {
        return Err(SolveError::Epsilon(epsilon));
    }
    let LargestEigenvalue { value: w_max, iterations, .. } =
        largest_eigenvalue(&sums, W_MAX_EXACT, &mut |_, _| true);
    let mut map_k = sums.right.clone();
    if let Some(prior_k) = prior_k {
        if prior_k.len() != pixels {
            return Err(SolveError::PriorLength { found: prior_k.len(), expected: pixels });
        }
        let mut predicted = vec![0.0; pixels];
        sums.apply(prior_k, &mut predicted);
        map_k.iter_mut().zip(predicted).for_each(|(right, predicted)| *right -= predicted);
    }
    let PixelSums { mut normal, noise: mut noise_k, .. } = sums;
    normal.add_to_diagonal(epsilon * w_max);
    let factor =
        Cholesky::new(normal).map_err(|NotPositive(pixel)| SolveError::NotPositive { pixel, epsilon })?;
    rayon::join(|| factor.solve(&mut map_k), || factor.solve(&mut noise_k));
    if let Some(prior_k) = prior_k {
        map_k.iter_mut().zip(prior_k).for_each(|(map, prior)| *map += prior);
    }
    Ok(PixelSolution {
        map_k,
        noise_k,
        diagnostics: Diagnostics {
            epsilon,
            w_max,
            w_max_iterations: iterations,
            l_max: None,
            convergence: None,
            noise_convergence: None,
            traces: None,
        },
    })
}
