//! Exact diagnostics of small maps, from all eigenvalues and eigenvectors.

use faer::{Mat, Side};

use super::error::SolveError;
use crate::imaging::PixelSums;

/// Eigenvalues and eigenvectors of `BtN^-1B = Q W Qt`.
#[derive(Clone, Debug)]
pub struct Spectrum {
    /// Eigenvalues W, K^-2, in increasing order.
    pub eigenvalues: Vec<f64>,
    /// Eigenvectors Q, one per column.
    vectors: Mat<f64>,
}

/// Decomposes the normal matrix, with `10 N_pix^3` operations and the memory of three matrices: for nside up to 16.
///
/// # Errors
/// The matrix has elements that are not finite.
pub fn spectrum(sums: &PixelSums) -> Result<Spectrum, SolveError> {
    let order = sums.normal.order();
    let matrix = Mat::from_fn(order, order, |row, column| sums.normal.get(row, column));
    let decomposed = matrix.self_adjoint_eigen(Side::Lower).map_err(|_| SolveError::Eigenvalues)?;
    let eigenvalues = decomposed.S().column_vector().iter().copied().collect();
    Ok(Spectrum { eigenvalues, vectors: decomposed.U().to_owned() })
}

impl Spectrum {
    /// The regularisation eps = epsilon W_max, K^-2.
    #[must_use]
    pub fn regularisation(&self, epsilon: f64) -> f64 {
        epsilon * self.eigenvalues.last().copied().unwrap_or(0.0)
    }

    /// Trace of the thermal covariance, `sum W / (W + eps)^2`, K^2 (the paper, Sect. 5.1).
    #[must_use]
    pub fn trace_sigma_n(&self, epsilon: f64) -> f64 {
        let eps = self.regularisation(epsilon);
        self.eigenvalues.iter().map(|w| w / ((w + eps) * (w + eps))).sum()
    }

    /// Trace of the imperfection `(B_eff - I)(B_eff - I)t`, `sum (eps / (W + eps))^2`.
    #[must_use]
    pub fn trace_sigma_s(&self, epsilon: f64) -> f64 {
        let eps = self.regularisation(epsilon);
        self.eigenvalues.iter().map(|w| (eps / (w + eps)).powi(2)).sum()
    }

    /// Standard deviation of the thermal noise of every pixel, K: the square root of the diagonal of
    /// `Q W (W + eps)^-2 Qt`.
    #[must_use]
    pub fn pixel_noise_k(&self, epsilon: f64) -> Vec<f64> {
        let eps = self.regularisation(epsilon);
        let variance = |w: f64| w / ((w + eps) * (w + eps));
        self.weighted_diagonal(variance).into_iter().map(f64::sqrt).collect()
    }

    /// The effective beam of one pixel: a column of `B_eff = Q W (W + eps)^-1 Qt`, the map of a sky
    /// that is 1 K in that pixel only. Empty if there is no such pixel.
    #[must_use]
    pub fn effective_beam(&self, epsilon: f64, pixel: usize) -> Vec<f64> {
        let eps = self.regularisation(epsilon);
        let order = self.eigenvalues.len();
        if pixel >= order {
            return Vec::new();
        }
        let mut beam = vec![0.0; order];
        for (k, w) in self.eigenvalues.iter().enumerate() {
            let factor = self.vectors[(pixel, k)] * w / (w + eps);
            for (beam, &element) in beam.iter_mut().zip(self.vectors.col(k).iter()) {
                *beam += factor * element;
            }
        }
        beam
    }

    fn weighted_diagonal(&self, weight: impl Fn(f64) -> f64) -> Vec<f64> {
        let mut diagonal = vec![0.0; self.eigenvalues.len()];
        for (k, &w) in self.eigenvalues.iter().enumerate() {
            let factor = weight(w);
            for (sum, &element) in diagonal.iter_mut().zip(self.vectors.col(k).iter()) {
                *sum += factor * element * element;
            }
        }
        diagonal
    }
}
