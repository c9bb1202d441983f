//! Angular power spectra and Gaussian smoothing.

use std::f64::consts::LN_2;

use super::error::MapError;
use super::frame::Frame;
use super::harmonics::{Alm, AnalysisOptions, Transform};
use super::map::SkyMap;

/// Cross-power spectrum C_l = sum over m of Re(a_lm conj(b_lm)) / (2 l + 1), from l = 0 to the smaller l_max.
#[must_use]
pub fn cross_cl(a: &Alm, b: &Alm) -> Vec<f64> {
    let l_max = a.l_max().min(b.l_max());
    let of_degree = |l: usize| {
        let term = |m: usize| (a.get(l, m) * b.get(l, m).conj()).re;
        let others: f64 = (1..=l).map(term).sum();
        (term(0) + 2.0 * others) / (2 * l + 1) as f64
    };
    (0..=l_max).map(of_degree).collect()
}

/// Power spectrum C_l of one set of coefficients.
#[must_use]
pub fn auto_cl(alm: &Alm) -> Vec<f64> {
    cross_cl(alm, alm)
}

/// Ratio of a cross-power spectrum to the geometric mean of two power spectra at each degree; NaN where a spectrum is zero.
///
/// With the spectra of both maps it is rho_l, with those of the input and of a noise map SNR_l (the paper, Sect. 5.2).
#[must_use]
#[doc(hidden)]
pub fn normalised(cross: &[f64], one: &[f64], other: &[f64]) -> Vec<f64> {
    cross
        .iter()
        .zip(one.iter().zip(other))
        .map(|(cross, (one, other))| cross / (one * other).sqrt())
        .collect()
}

/// Correlation rho_l = C_l^X / sqrt(C_l^a C_l^b) of two sets of coefficients.
#[must_use]
pub fn rho(a: &Alm, b: &Alm) -> Vec<f64> {
    normalised(&cross_cl(a, b), &auto_cl(a), &auto_cl(b))
}

/// Window function of a Gaussian beam with this FWHM (rad), l = 0 .. `l_max`:
/// exp(-l (l + 1) sigma^2 / 2), sigma = FWHM / sqrt(8 ln 2).
#[must_use]
#[doc(hidden)]
pub fn gaussian_beam(fwhm_rad: f64, l_max: usize) -> Vec<f64> {
    let variance = fwhm_rad * fwhm_rad / (8.0 * LN_2);
    (0..=l_max).map(|l| (-0.5 * variance * (l * (l + 1)) as f64).exp()).collect()
}

/// Multiplies a_lm by `factors[l]`; degrees without a factor become 0.
#[doc(hidden)]
pub fn multiply_degrees(alm: &mut Alm, factors: &[f64]) {
    for m in 0..=alm.l_max() {
        for (value, l) in alm.order_mut(m).iter_mut().zip(m..) {
            *value *= factors.get(l).copied().unwrap_or(0.0);
        }
    }
}

impl SkyMap {
    /// Computes coefficients up to `l_max` (healpy's `map2alm` with the default options).
    ///
    /// # Errors
    /// [`MapError::BadPixels`]; [`MapError::Harmonics`] for `l_max` above 3 nside - 1.
    #[doc(hidden)]
    pub fn harmonics(&self, l_max: usize, options: &AnalysisOptions) -> Result<Alm, MapError> {
        self.check_whole()?;
        Ok(Transform::new(self.nside(), l_max)?.analysis(self.values(), options)?.alm)
    }

    /// Removes the degrees beyond `l_max`, and samples the map at the pixel centres of `nside`, in ecliptic coordinates.
    ///
    /// Averages over pixels, as in [`SkyMap::resized`], would attenuate lower degrees and alias higher ones: with point
    /// sources a tenth of the power at l = 2 nside.
    ///
    /// # Errors
    /// [`MapError::BadPixels`]; [`MapError::Harmonics`] for an invalid nside.
    #[doc(hidden)]
    pub fn band_limited(&self, nside: usize, l_max: usize) -> Result<Self, MapError> {
        let l_max = l_max.min(3 * self.nside() - 1);
        let alm = self.harmonics(l_max, &AnalysisOptions::default())?;
        let alm = match self.frame() {
            Frame::Ecliptic => alm,
            frame => alm.rotated(&frame.to_ecliptic()),
        };
        Self::new(Frame::Ecliptic, Transform::new(nside, l_max)?.synthesis(&alm)?)
    }

    /// Convolves the map with a Gaussian beam of this FWHM (rad), by harmonics up to l = 3 nside - 1, as
    /// in healpy's `smoothing`.
    ///
    /// # Errors
    /// [`MapError::Width`] for a negative or infinite FWHM, [`MapError::BadPixels`].
    pub fn smoothed(&self, fwhm_rad: f64) -> Result<Self, MapError> {
        if !(fwhm_rad.is_finite() && fwhm_rad >= 0.0) {
            return Err(MapError::Width { fwhm_rad });
        }
        self.check_whole()?;
        let l_max = 3 * self.nside() - 1;
        let transform = Transform::new(self.nside(), l_max)?;
        let mut alm = transform.analysis(self.values(), &AnalysisOptions::default())?.alm;
        multiply_degrees(&mut alm, &gaussian_beam(fwhm_rad, l_max));
        Ok(self.with_values(self.frame(), transform.synthesis(&alm)?))
    }

    /// Refines the map as in the paper: splits every pixel into `factor`^2 and smooths to this FWHM (rad).
    ///
    /// # Errors
    /// [`MapError::Nside`] unless `factor` is a power of two that leads to a valid nside; as
    /// [`SkyMap::smoothed`].
    #[doc(hidden)]
    pub fn refined(&self, factor: usize, fwhm_rad: f64) -> Result<Self, MapError> {
        self.upgrade(self.nside().saturating_mul(factor))?.smoothed(fwhm_rad)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::sky::Frame;
    use crate::sky::harmonics::Method;
    use crate::sky::healpix::pixel_count;
    use num_complex::Complex64;

    fn varied(l_max: usize, step: f64) -> Alm {
        let mut alm = Alm::zeros(l_max);
        for (k, value) in alm.values_mut().iter_mut().enumerate() {
            let phase = 1.0 + step * (k * k) as f64;
            *value = Complex64::new(phase.sin(), if k <= l_max { 0.0 } else { phase.cos() });
        }
        alm
    }

    #[test]
    fn spectra_sum_to_the_mean_square() {
        let (nside, l_max) = (16, 20);
        let alm = varied(l_max, 0.3);
        let map = crate::sky::harmonics::synthesis(&alm, nside).unwrap();
        let mean_square = map.iter().map(|v| v * v).sum::<f64>() / map.len() as f64;
        let cl = auto_cl(&alm);
        let sum: f64 = (0..).zip(&cl).map(|(l, cl)| f64::from(2 * l + 1) * cl).sum();
        // Parseval's theorem, up to the error of HEALPix quadrature at degree 2 l_max, about 1e-3.
        assert!((sum / (4.0 * std::f64::consts::PI) / mean_square - 1.0).abs() < 3e-3);
    }

    #[test]
    fn correlation_is_bounded_and_knows_sign_and_scale() {
        let (a, b) = (varied(30, 0.3), varied(30, 0.7));
        let mut minus = a.clone();
        multiply_degrees(&mut minus, &[-2.5; 31]);
        for l in 0..=30 {
            assert!((rho(&a, &a)[l] - 1.0).abs() < 1e-14);
            assert!((rho(&a, &minus)[l] + 1.0).abs() < 1e-14);
            assert!(rho(&a, &b)[l].abs() <= 1.0 + 1e-14);
        }
        assert!(rho(&a, &Alm::zeros(30))[3].is_nan());
    }

    #[test]
    fn smoothing_keeps_the_mean_and_widens_a_point_as_asked() {
        let nside = 64;
        let mut map = SkyMap::constant(nside, Frame::Ecliptic, 0.0).unwrap();
        let pixel = pixel_count(nside) / 2 + 17;
        map.values_mut()[pixel] = 1.0;
        let fwhm = 0.2;
        let smooth = map.smoothed(fwhm).unwrap();
        let total: f64 = smooth.values().iter().sum();
        // The mean is one coefficient, found by quadrature with three corrections.
        assert!((total - 1.0).abs() < 1e-3, "{total}");
        let centre = map.directions_ecliptic()[pixel];
        let peak = smooth.values()[pixel];
        for (value, direction) in smooth.values().iter().zip(map.directions_ecliptic()) {
            let angle = crate::units::vector::dot(centre, direction).clamp(-1.0, 1.0).acos();
            if angle < fwhm {
                // A plane Gaussian; the sphere and the pixel change it by about sigma^2 / 12.
                let expected = (-4.0 * LN_2 * (angle / fwhm).powi(2)).exp();
                assert!((value / peak - expected).abs() < 5e-3, "{angle}");
            }
        }
        assert_eq!(map.smoothed(-1.0), Err(MapError::Width { fwhm_rad: -1.0 }));
        assert!(matches!(map.smoothed(f64::NAN), Err(MapError::Width { .. })));
    }

    #[test]
    fn refinement_keeps_large_scales() {
        let (nside, l_max) = (8, 6);
        let alm = varied(l_max, 0.3);
        let map =
            SkyMap::new(Frame::Galactic, crate::sky::harmonics::synthesis(&alm, nside).unwrap()).unwrap();
        let refined = map.refined(4, 8_f64.to_radians()).unwrap();
        assert_eq!((refined.nside(), refined.frame()), (32, Frame::Galactic));
        let found = refined.harmonics(l_max, &AnalysisOptions { method: Method::ACCURATE }).unwrap();
        // 8 deg of smoothing and pixels of 7 deg reduce the amplitude at l = 6 by 8 %, but do not change phases.
        for (l, rho) in rho(&found, &alm).into_iter().enumerate() {
            assert!(rho > 0.999, "l {l}: {rho}");
        }
        assert!(matches!(map.refined(3, 0.1), Err(MapError::Nside { nside: 24 })));
    }
}
