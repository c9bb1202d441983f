//! Analysis of a map: its harmonic coefficients.
//!
//! HEALPix pixels are not an exact quadrature: the sum over pixels of map conj(Y_lm) has an error of 15 % for white
//! coefficients up to l = 3 nside - 1, and healpy's three iterations leave 14 % at nside 128. The least-squares
//! coefficients, whose synthesis is nearest to the map, are exact for a band-limited map; conjugate gradients on
//! the normal equations find them. White coefficients with a relative error of 1e-6 take 5 iterations for l_max up to
//! 2.25 nside, and 8 up to 2.5 nside, at any nside from 16 to 256 (measured). At l_max = 3 nside - 1 they take 33 at
//! nside 16, and 170 at nside 32 (where the map is accurate to 1e-6, but the coefficients only to 2e-5). Beyond that no
//! method works: near the poles and along the faces' meridians the pixel lattice is too coarse in one direction for
//! l > 2.5 nside or so, and some harmonics differ in every pixel only by factors that fall exponentially with nside.

use num_complex::Complex64;

use super::{Alm, HarmonicsError, Transform};

/// Method of the analysis.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Method {
    /// Least squares by conjugate gradients, down to a residual.
    LeastSquares {
        /// Norm of the residual of the normal equations relative to their right-hand side; the relative error
        /// of the coefficients is up to a few times this value.
        tolerance: f64,
        /// Maximum number of iterations.
        iterations_max: usize,
    },
    /// Quadrature, corrected repeatedly by the quadrature of the residual (healpy's `iter`).
    Jacobi {
        /// Number of corrections.
        iterations: usize,
    },
}

impl Method {
    /// Least squares to 3e-7 in at most 200 iterations, with a relative error of some 1e-7 for l_max up to 2.5 nside.
    pub const ACCURATE: Self = Self::LeastSquares { tolerance: 3e-7, iterations_max: 200 };
}

/// Three corrections: the default of healpy, and so of spectra in the literature.
impl Default for Method {
    fn default() -> Self {
        Self::Jacobi { iterations: 3 }
    }
}

/// Options of an analysis.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct AnalysisOptions {
    /// Method.
    pub method: Method,
}

/// Result of an analysis: coefficients, and the convergence of the iteration.
#[derive(Clone, Debug, PartialEq)]
pub struct Analysis {
    /// The coefficients.
    pub alm: Alm,
    /// Number of iterations done.
    pub iterations: usize,
    /// Relative norm of the residual of the normal equations; for [`Method::Jacobi`] before the last correction.
    pub residual: f64,
}

/// Synthesises the map of `alm` at the pixel centres of `nside`, in RING order.
///
/// # Errors
/// [`HarmonicsError`] for an nside or degree out of bounds.
pub fn synthesis(alm: &Alm, nside: usize) -> Result<Vec<f64>, HarmonicsError> {
    Transform::new(nside, alm.l_max())?.synthesis(alm)
}

/// Computes the coefficients of a map in RING order up to `l_max`.
///
/// # Errors
/// As [`Transform::analysis`], and [`HarmonicsError::Pixels`] for a number of pixels that no nside has.
pub fn analysis(map: &[f64], l_max: usize, options: &AnalysisOptions) -> Result<Analysis, HarmonicsError> {
    let nside = crate::sky::healpix::nside_of(map.len());
    let nside = nside.ok_or(HarmonicsError::Pixels { found: map.len(), nside: 0 })?;
    Transform::new(nside, l_max)?.analysis(map, options)
}

impl Transform {
    /// Computes the coefficients of a map in RING order.
    ///
    /// # Errors
    /// [`HarmonicsError::Pixels`] unless the map has the transform's nside, [`HarmonicsError::Degree`] unless
    /// `l_max <= 3 nside - 1`, [`HarmonicsError::NotFinite`] for NaN and infinities,
    /// [`HarmonicsError::NotConverged`].
    pub fn analysis(&self, map: &[f64], options: &AnalysisOptions) -> Result<Analysis, HarmonicsError> {
        let most = 3 * self.nside() - 1;
        if self.l_max() > most {
            return Err(HarmonicsError::Degree { l_max: self.l_max(), most });
        }
        if let Some(pixel) = map.iter().position(|value| !value.is_finite()) {
            return Err(HarmonicsError::NotFinite { pixel, value: map[pixel] });
        }
        match options.method {
            Method::Jacobi { iterations } => self.jacobi(map, iterations),
            Method::LeastSquares { tolerance, iterations_max } => {
                self.least_squares(map, tolerance, iterations_max)
            }
        }
    }

    fn jacobi(&self, map: &[f64], iterations: usize) -> Result<Analysis, HarmonicsError> {
        let mut alm = self.adjoint(map)?;
        let scale = squared_norm(&alm).sqrt();
        let mut residual = 0.0;
        for _ in 0..iterations {
            let mut residual_map = self.synthesis(&alm)?;
            for (residual_map, value) in residual_map.iter_mut().zip(map) {
                *residual_map = value - *residual_map;
            }
            let correction = self.adjoint(&residual_map)?;
            add_scaled(&mut alm, 1.0, &correction);
            residual = squared_norm(&correction).sqrt() / scale.max(f64::MIN_POSITIVE);
        }
        Ok(Analysis { alm, iterations, residual })
    }

    /// Solves A^T A a = A^T map, with A the synthesis, by conjugate gradients (Hestenes & Stiefel 1952, in the form that keeps
    /// the residual of the map).
    fn least_squares(
        &self,
        map: &[f64],
        tolerance: f64,
        iterations_max: usize,
    ) -> Result<Analysis, HarmonicsError> {
        let pixel_area = crate::sky::healpix::pixel_area_sr(self.nside());
        let mut residual_map = map.to_vec();
        let mut gradient = self.adjoint(&residual_map)?;
        let mut direction = gradient.clone();
        let mut alm = Alm::zeros(self.l_max());
        let first = squared_norm(&gradient);
        let mut power = first;
        let mut iterations = 0;
        while power > tolerance * tolerance * first {
            if iterations == iterations_max {
                let residual = (power / first).sqrt();
                return Err(HarmonicsError::NotConverged { iterations, residual, tolerance });
            }
            let image = self.synthesis(&direction)?;
            let length: f64 = image.iter().map(|value| value * value).sum::<f64>() * pixel_area;
            let step = power / length;
            add_scaled(&mut alm, step, &direction);
            for (residual_map, image) in residual_map.iter_mut().zip(&image) {
                *residual_map -= step * image;
            }
            gradient = self.adjoint(&residual_map)?;
            let next = squared_norm(&gradient);
            let ratio = next / power;
            for (direction, gradient) in direction.values_mut().iter_mut().zip(gradient.values()) {
                *direction = gradient + *direction * ratio;
            }
            power = next;
            iterations += 1;
        }
        let residual = if first > 0.0 { (power / first).sqrt() } else { 0.0 };
        Ok(Analysis { alm, iterations, residual })
    }
}

/// Squared norm over all orders including m < 0, which is 4 pi times the field's mean square.
fn squared_norm(alm: &Alm) -> f64 {
    let sum = |values: &[Complex64]| values.iter().map(Complex64::norm_sqr).sum::<f64>();
    let (zeroth, others) = alm.values().split_at(alm.l_max() + 1);
    sum(zeroth) + 2.0 * sum(others)
}

fn add_scaled(alm: &mut Alm, factor: f64, other: &Alm) {
    for (value, other) in alm.values_mut().iter_mut().zip(other.values()) {
        *value += other * factor;
    }
}
