//! What visibilities tell of each degree of the sky before there are any: noise and measured modes, from positions and weights alone.

use faer::linalg::matmul::matmul;
use faer::prelude::Solve;
use faer::{Accum, Mat, MatRef, Side, get_global_parallelism};
use serde::Serialize;

use super::SolveError;
use super::circle::{coefficients, degrees};
use crate::frames::{AntennaResponse, PlacedVisibilities};
use crate::response::pixel::{PairGeometry, PixelMethod, RowMaker};
use crate::sky::harmonics::Transform;
use crate::sky::healpix::pixel_area_sr;

/// What an array tells of one degree, if `R_l = 1 / C_l` of the sky.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct DegreeSensitivity {
    /// Degree l.
    pub l: usize,
    /// Measured modes: the part of Tr A (A + R)^-1 of this degree, of 2 l + 1.
    pub measured: f64,
    /// Mean noise power C_l of the map, K^2.
    pub noise_k2: f64,
    /// Power C_l of the sky, K^2.
    pub sky_k2: f64,
}

impl DegreeSensitivity {
    /// What the map keeps of the sky: the mean of the diagonal of A (A + R)^-1.
    #[must_use]
    pub fn response(&self) -> f64 {
        self.measured / (2 * self.l + 1) as f64
    }

    /// Expected correlation of map and sky. With this R the mean power of the map, noise included, is that of its product with the sky.
    #[must_use]
    pub fn rho(&self) -> f64 {
        self.response().max(0.0).sqrt()
    }

    /// Whether anything is measured beyond the rounding of single precision.
    #[must_use]
    pub fn is_measured(&self) -> bool {
        self.response() >= RESPONSE_MIN
    }

    /// The noise relative to the sky after correction for the response: 1 / SNR_l. Infinite if nothing is measured.
    #[must_use]
    pub fn relative_noise(&self) -> f64 {
        let kept = self.response() * self.sky_k2.sqrt();
        if self.is_measured() { self.noise_k2.sqrt() / kept } else { f64::INFINITY }
    }
}

/// Least response that is told from rounding.
const RESPONSE_MIN: f64 = 1e-6;

/// Rows of B that are added together.
const ROWS_AT_ONCE: usize = 256;

/// The normal matrix A of visibilities over harmonics.
#[derive(Debug)]
pub struct SensitivitySums {
    rows: RowMaker,
    /// Harmonics at pixels, a column each, times the area of a pixel and over its window.
    harmonics: Mat<f64>,
    matrix: Mat<f64>,
    /// Rows of B over pixels, a column each.
    block: Vec<f64>,
    pending: usize,
    l_max: usize,
}

impl SensitivitySums {
    /// Empty sums over degrees up to `l_max`, whose integrals over the sphere are sums over pixels of `nside`.
    ///
    /// # Errors
    /// An invalid `nside`, or degrees beyond its pixels'.
    pub fn new(nside: usize, l_max: usize) -> Result<Self, SolveError> {
        let transform = Transform::new(nside, l_max)?;
        // Means over pixels see the limb where it is.
        let rows = RowMaker::new(nside, PixelMethod::Average)
            .map_err(|error| SolveError::Sums(error.to_string()))?;
        let (degrees, area_sr) = (degrees(l_max).collect::<Vec<_>>(), pixel_area_sr(nside));
        let mut harmonics = Mat::zeros(rows.pixels(), degrees.len());
        let mut unit = vec![0.0; degrees.len()];
        for (column, &l) in degrees.iter().enumerate() {
            // They weaken a degree by the window of a pixel, nearly that of a Gaussian of its variance.
            unit[column] = area_sr * ((l * (l + 1)) as f64 * area_sr / 24.0).exp();
            for (pixel, value) in transform.synthesis(&coefficients(&unit, l_max))?.into_iter().enumerate() {
                harmonics[(pixel, column)] = value;
            }
            unit[column] = 0.0;
        }
        let count = degrees.len();
        let block = vec![0.0; rows.pixels() * ROWS_AT_ONCE];
        Ok(Self { rows, harmonics, matrix: Mat::zeros(count, count), block, pending: 0, l_max })
    }

    /// Removes all visibilities.
    pub fn clear(&mut self) {
        self.matrix.fill(0.0);
        self.pending = 0;
    }

    /// Adds visibilities of a pair, whose values are not used, with `factor` times their weights, (K sr)^-2. `sees` are the radius of the
    /// body that hides the sky, m, and the antennas.
    pub fn add(&mut self, placed: &PlacedVisibilities, sees: (f64, AntennaResponse), factor: f64) {
        let pixels = self.rows.pixels();
        let positions_m = placed.r_i_m.iter().zip(&placed.r_j_m);
        for ((r_i_m, r_j_m), weight) in positions_m.zip(&placed.weight) {
            let pair = PairGeometry {
                r_i_m: *r_i_m,
                r_j_m: *r_j_m,
                frequency_hz: placed.frequency_hz,
                moon_radius_m: sees.0,
                response: sees.1,
            };
            let block = &mut self.block[self.pending * pixels..(self.pending + 2) * pixels];
            let (re, im) = block.split_at_mut(pixels);
            self.rows.fill(&pair, (factor * weight).sqrt(), re, im);
            self.pending += 2;
            if self.pending == ROWS_AT_ONCE {
                self.flush();
            }
        }
    }

    fn flush(&mut self) {
        let threads = get_global_parallelism();
        let pixels = self.rows.pixels();
        let block =
            MatRef::from_column_major_slice(&self.block[..pixels * self.pending], pixels, self.pending);
        let mut rows = Mat::zeros(self.matrix.nrows(), self.pending);
        matmul(rows.as_mut(), Accum::Replace, self.harmonics.transpose(), block, 1.0, threads);
        matmul(self.matrix.as_mut(), Accum::Add, rows.as_ref(), rows.transpose(), 1.0, threads);
        self.pending = 0;
    }

    /// Noise and measured modes by degree from l = 0, with the inverse of `sky_k2`, the power C_l of the sky (K^2), as R; degrees that it does
    /// not have are left out of the equations.
    ///
    /// # Errors
    /// Weights, positions or powers that are not finite.
    pub fn solve(&mut self, sky_k2: &[f64]) -> Result<Vec<DegreeSensitivity>, SolveError> {
        self.flush();
        let degrees: Vec<usize> = degrees(self.l_max).collect();
        let root: Vec<f64> =
            degrees.iter().map(|l| sky_k2.get(*l).map_or(0.0, |power| power.sqrt())).collect();
        // X = (1 + S A S)^-1 with S = C^1/2: then (A + R)^-1 = S X S, A (A + R)^-1 = S^-1 (1 - X) S, and the noise is S (X - X^2) S.
        let count = degrees.len();
        let scaled = Mat::from_fn(count, count, |i, k| {
            root[i] * self.matrix[(i, k)] * root[k] + f64::from(u8::from(i == k))
        });
        let factor = scaled.llt(Side::Lower).map_err(|_| {
            SolveError::Sums(
                "the equations of an estimate have no factor; expected finite positions and weights"
                    .to_owned(),
            )
        })?;
        let inverse = factor.solve(Mat::<f64>::identity(count, count));
        let of_none = |(l, &sky_k2)| DegreeSensitivity { l, measured: 0.0, noise_k2: 0.0, sky_k2 };
        let mut found: Vec<_> = sky_k2.iter().enumerate().take(self.l_max + 1).map(of_none).collect();
        for (k, l) in degrees.into_iter().enumerate() {
            let Some(degree) = found.get_mut(l) else { continue };
            let open = inverse[(k, k)];
            degree.measured += 1.0 - open;
            let noise = (open - inverse.col(k).squared_norm_l2()).max(0.0);
            degree.noise_k2 += degree.sky_k2 * noise / (2 * l + 1) as f64;
        }
        Ok(found)
    }
}

#[cfg(test)]
mod tests {
    use std::f64::consts::PI;

    use super::*;

    fn placed(baseline_m: f64, weight: f64) -> PlacedVisibilities {
        PlacedVisibilities {
            frequency_hz: crate::units::constants::SPEED_OF_LIGHT_M_S,
            r_i_m: vec![[0.0, 0.0, 2.0e6 + baseline_m]],
            r_j_m: vec![[0.0, 0.0, 2.0e6]],
            weight: vec![weight],
            ..PlacedVisibilities::default()
        }
    }

    /// A pair at one place measures the mean alone: b_00 = sqrt(4 pi), so A = 4 pi w beside 1 / C_0.
    #[test]
    fn a_pair_at_one_place_measures_the_mean() {
        let mut sums = SensitivitySums::new(16, 1).unwrap();
        sums.add(&placed(0.0, 0.5), (0.0, AntennaResponse::Isotropic), 2.0);
        let found = sums.solve(&[3.0, 1.0]).unwrap();
        let a = 4.0 * PI;
        let kept = a / (a + 1.0 / 3.0);
        // Single precision of rows: 1e-6.
        assert!((found[0].measured - kept).abs() < 1e-6, "{found:?}");
        assert!((found[0].noise_k2 / (kept * kept / a) - 1.0).abs() < 1e-5, "{found:?}");
        // After correction for the response the noise is that of the datum: 1 / sqrt(A C_0).
        assert!((found[0].relative_noise() * (a * 3.0).sqrt() - 1.0).abs() < 1e-5, "{found:?}");
        assert!(found[1].measured.abs() < 1e-6 && !found[1].is_measured(), "{found:?}");
        assert!(found[1].relative_noise().is_infinite(), "{found:?}");
        sums.clear();
        assert!(sums.solve(&[3.0, 1.0]).unwrap()[0].relative_noise().is_infinite());
    }

    /// A plane wave of k b = x has sum_m |b_lm|^2 = 4 pi (2 l + 1) j_l(x)^2: without noise to speak of, R far above A gives measured modes C_l
    /// times that.
    #[test]
    fn a_baseline_measures_the_degrees_of_its_bessel_functions() {
        let wavelengths = 0.4;
        let x = 2.0 * PI * wavelengths;
        let mut sums = SensitivitySums::new(16, 2).unwrap();
        sums.add(&placed(wavelengths, 1.0), (0.0, AntennaResponse::Isotropic), 1.0);
        let found = sums.solve(&[1e-6; 3]).unwrap();
        let (sin, cos) = x.sin_cos();
        let j = [sin / x, sin / (x * x) - cos / x, (3.0 / (x * x) - 1.0) * sin / x - 3.0 * cos / (x * x)];
        for (l, j) in j.into_iter().enumerate() {
            let expected = 1e-6 * 4.0 * PI * (2 * l + 1) as f64 * j * j;
            // Rows averaged over pixels agree with their integrals to 1e-3 rms of the fringe, which is of order one as j is.
            assert!((found[l].measured / expected - 1.0).abs() < 0.01, "{l}: {found:?}, {expected}");
        }
    }
}
