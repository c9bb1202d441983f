//! Normal equations over pixels without a stored matrix: visibilities are stored, and each product computes the rows of B again.
//!
//! A product takes N_vis N_pix operations instead of N_pix^2, so adding visibilities is fast and solutions are slow. Visibilities are sorted,
//! so that the sums depend only on which are held.

use num_complex::Complex64;

use crate::imaging::anywhere::VisibilityArchive;
use crate::imaging::{AccumulationError, Accuracy, NormalSums, SumCounts};
use crate::response::general::TimedPair;
use crate::response::pixel::{PairGeometry, PixelMethod, RowProducts};

/// Rows have a relative error of 1e-6, as those of the stored matrix; sums in f32 have one of 1e-7 of the largest.
const ACCURACY: Accuracy = Accuracy { relative: 1e-6, absolute: 1e-7 };

/// Stored visibilities for a pixel map.
#[derive(Debug)]
pub struct MatrixFreeVisibilities {
    /// HEALPix nside of the map.
    pub nside: usize,
    /// Method by which rows of B are computed.
    pub method: PixelMethod,
    /// The stored visibilities.
    pub archive: VisibilityArchive,
}

/// Normal equations whose matrix is computed again, row by row, for each product.
#[derive(Debug)]
pub struct MatrixFreeSums {
    products: RowProducts,
    pairs: Vec<PairGeometry>,
    weights: Vec<f64>,
    right: Vec<f64>,
    noise: Vec<f64>,
    counts: SumCounts,
}

impl MatrixFreeVisibilities {
    /// Sorts the visibilities and computes the right-hand sides.
    ///
    /// # Errors
    /// The nside is not supported.
    pub fn into_sums(self) -> Result<MatrixFreeSums, AccumulationError> {
        let products = RowProducts::new(self.nside, self.method)?;
        let counts = self.archive.counts();
        let (setup, at, data) = self.archive.into_data();
        let pair = |TimedPair { r_i_m, r_j_m, .. }| PairGeometry {
            r_i_m,
            r_j_m,
            frequency_hz: setup.frequency_hz,
            moon_radius_m: setup.moon_radius_m,
            response: setup.response,
        };
        let pairs: Vec<PairGeometry> = at.into_iter().map(pair).collect();
        let weighted: Vec<Complex64> =
            data.value_k_sr.iter().zip(&data.weight).map(|(value, weight)| value * *weight).collect();
        let noise: Vec<Complex64> =
            data.noise.iter().zip(&data.weight).map(|(noise, weight)| noise * weight.sqrt()).collect();
        let mut right_hand_sides = products.adjoint(&pairs, &[&weighted, &noise]).into_iter();
        let mut next = || right_hand_sides.next().unwrap_or_default();
        let (right, noise) = (next(), next());
        Ok(MatrixFreeSums { products, pairs, weights: data.weight, right, noise, counts })
    }
}

impl NormalSums for MatrixFreeSums {
    fn unknowns(&self) -> usize {
        self.products.pixels()
    }

    fn apply(&self, x: &[f64], y: &mut [f64]) {
        for product in self.apply_all(&[x]) {
            y.copy_from_slice(&product);
        }
    }

    fn apply_all(&self, x: &[&[f64]]) -> Vec<Vec<f64>> {
        self.products.normal(&self.pairs, &self.weights, x)
    }

    fn right_hand_side(&self) -> &[f64] {
        &self.right
    }

    fn noise_right_hand_side(&self) -> &[f64] {
        &self.noise
    }

    fn counts(&self) -> SumCounts {
        self.counts
    }

    fn accuracy(&self) -> Accuracy {
        ACCURACY
    }
}
