//! Normal equations over pixels whose matrix is not held: the visibilities are, and each product makes the rows of B again.
//!
//! A product costs a visit of each pixel for each visibility, where the held matrix costs one of each pair of pixels: visibilities are
//! summed in no time, and solutions take long. The sums are those of sorted visibilities: they depend on which are held and on nothing
//! else.

use num_complex::Complex64;

use crate::imaging::anywhere::VisibilityArchive;
use crate::imaging::{AccumulationError, Accuracy, NormalSums, SumCounts};
use crate::response::general::TimedPair;
use crate::response::pixel::{PairGeometry, PixelMethod, RowProducts};

/// Rows are those of the stored matrix, good to 1e-6; their sums in f32 are good to 1e-7 of the greatest.
const ACCURACY: Accuracy = Accuracy { relative: 1e-6, absolute: 1e-7 };

/// Visibilities for a map of pixels.
#[derive(Debug)]
pub struct MatrixFreeVisibilities {
    /// HEALPix nside of the map.
    pub nside: usize,
    /// How rows of B are made.
    pub method: PixelMethod,
    /// The visibilities.
    pub archive: VisibilityArchive,
}

/// Normal equations whose matrix is made again, row by row, for each product.
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
    /// Number and weight of the visibilities.
    #[must_use]
    pub fn counts(&self) -> SumCounts {
        self.archive.counts()
    }

    /// Sorts the visibilities, and makes the right-hand sides in one pass over their rows.
    ///
    /// # Errors
    /// An nside that rows cannot have.
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
        let mut sides = products.adjoint(&pairs, &[&weighted, &noise]).into_iter();
        let mut side = || sides.next().unwrap_or_default();
        let (right, noise) = (side(), side());
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
