//! The effective beam of a map, from the response at each degree, and the noise in Jy per beam.

use std::f64::consts::{FRAC_PI_2, TAU};

use serde::Serialize;

use crate::sky::Comparison;
use crate::units::constants::{BOLTZMANN_J_K, SPEED_OF_LIGHT_M_S};

const JANSKY: f64 = 1e-26;
/// Step in angle times the number of degrees, rad, a tenth of the half width of the narrowest beam.
const STEP: f64 = 0.2;
/// Number of bisections of a step, which reaches rounding.
const BISECTIONS: usize = 50;

/// The effective beam of a map, from its response to each degree of the sky.
#[derive(Clone, Debug, Serialize, bincode::Encode, bincode::Decode)]
pub struct EffectiveBeam {
    /// Response `w_l = C_l^X / C_l^in` of the map, from l = 0, including the Gaussian beam of post-processing. NaN (null) where
    /// the input has no power.
    pub w: Vec<f64>,
    /// FWHM of the effective beam `sum_l (2 l + 1) w_l P_l(cos theta) / 4 pi`, degrees; absent without a peak. For `w_l = 1` up to
    /// l_max it is 4.430 / (l_max + 1) rad.
    pub fwhm_deg: Option<f64>,
    /// Solid angle, `4 pi / sum (2 l + 1) w_l`, sr. It converts the peak of a source in K to its flux density, also where the map
    /// loses its mean (w_0 below 1).
    pub area_sr: Option<f64>,
    /// RMS of the noise-only map as compared, K.
    pub noise_rms_k: f64,
    /// RMS of the noise per beam, `2 k T nu^2 / c^2` times the solid angle, Jy.
    pub noise_rms_jy: Option<f64>,
}

impl EffectiveBeam {
    /// The beam from a comparison at `frequency_hz`. `smoothing`, by degree, was applied to map and input; `noise` is the
    /// noise-only map, K.
    #[must_use]
    pub(super) fn new(comparison: &Comparison, smoothing: &[f64], noise: &[f64], frequency_hz: f64) -> Self {
        let response =
            comparison.cl_cross.iter().zip(&comparison.cl_truth).map(|(cross, input)| cross / input);
        let w: Vec<f64> =
            response.enumerate().map(|(l, w)| w * smoothing.get(l).copied().unwrap_or(1.0)).collect();
        let fwhm_rad = fwhm_rad(&w);
        let area_sr = area_sr(&w);
        let noise_rms_k = (noise.iter().map(|x| x * x).sum::<f64>() / noise.len().max(1) as f64).sqrt();
        Self {
            w,
            fwhm_deg: fwhm_rad.map(f64::to_degrees),
            area_sr,
            noise_rms_k,
            noise_rms_jy: area_sr.map(|area_sr| flux_jy(noise_rms_k, frequency_hz, area_sr)),
        }
    }
}

fn flux_jy(temperature_k: f64, frequency_hz: f64, area_sr: f64) -> f64 {
    let per_m = frequency_hz / SPEED_OF_LIGHT_M_S;
    2.0 * BOLTZMANN_J_K * temperature_k * per_m * per_m * area_sr / JANSKY
}

/// 1 over the value at 0 of the beam `sum_l (2 l + 1) w_l P_l / 4 pi`, sr. Unknown w_l count as 0. `None` without a peak.
fn area_sr(w: &[f64]) -> Option<f64> {
    let finite = |w: &f64| if w.is_finite() { *w } else { 0.0 };
    let peak: f64 = (0..).zip(w).map(|(l, w)| f64::from(2 * l + 1) * finite(w)).sum();
    (peak > 0.0).then_some(2.0 * TAU / peak)
}

/// Full width at half maximum of `sum_l (2 l + 1) w_l P_l(cos theta)`, rad. Unknown w_l count as 0. `None` without a peak at
/// 0, or if the beam does not fall to half of it within 90 degrees.
fn fwhm_rad(w: &[f64]) -> Option<f64> {
    let weights: Vec<f64> =
        (0..).zip(w).map(|(l, w)| f64::from(2 * l + 1) * if w.is_finite() { *w } else { 0.0 }).collect();
    let peak: f64 = weights.iter().sum();
    if peak <= 0.0 {
        return None;
    }
    let excess = |theta: f64| legendre_series(&weights, theta.cos()) - 0.5 * peak;
    let step = STEP / weights.len() as f64;
    let steps = (FRAC_PI_2 / step) as u32;
    let first = (1..=steps).map(|k| f64::from(k) * step).find(|&theta| excess(theta) <= 0.0)?;
    let (mut inside, mut outside) = (first - step, first);
    for _ in 0..BISECTIONS {
        let middle = 0.5 * (inside + outside);
        if excess(middle) > 0.0 { inside = middle } else { outside = middle }
    }
    Some(2.0 * inside)
}

/// `sum_l weights[l] P_l(x)` by the recurrence of P_l.
fn legendre_series(weights: &[f64], x: f64) -> f64 {
    let (mut previous, mut current, mut sum) = (0.0, 1.0, 0.0);
    for (l, weight) in (0..).zip(weights) {
        sum += weight * current;
        let l = f64::from(l);
        (previous, current) = (current, ((2.0 * l + 1.0) * x * current - l * previous) / (l + 1.0));
    }
    sum
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::sky::spectra::gaussian_beam;

    #[test]
    fn janskys_are_those_of_the_rayleigh_jeans_law() {
        // By hand: 1e4 K at 10 MHz are 3.0724e4 Jy/sr, and a beam of 1 degree FWHM has 1.1331 (pi/180)^2 sr.
        let area_sr = 1.1331 * 1_f64.to_radians().powi(2);
        assert!((flux_jy(1e4, 1e7, area_sr) / 10.605 - 1.0).abs() < 1e-4);
    }

    #[test]
    fn the_area_makes_flux_densities_of_peaks() {
        // Equal w_l up to l_max: sum (2 l + 1) = (l_max + 1)^2, so 4 pi / 161^2 = 4.848e-4 sr. A Gaussian of that width has 8.58e-4.
        let sharp = area_sr(&[1.0; 161]).unwrap();
        assert!((sharp / 4.848e-4 - 1.0).abs() < 1e-4, "{sharp}");
        // A map that keeps 0.7 of all degrees makes peaks 0.7 times as high; one that loses its mean only lowers them by 1 / 161^2.
        assert!((area_sr(&[0.7; 161]).unwrap() * 0.7 / sharp - 1.0).abs() < 1e-12);
        let without_mean: Vec<f64> = (0..161).map(|l| if l == 0 { 0.0 } else { 1.0 }).collect();
        assert!((area_sr(&without_mean).unwrap() / sharp - 1.0).abs() < 1e-4);
        // A well-sampled Gaussian has 2 pi sigma^2, up to relative terms of sigma^2.
        let fwhm_rad = 2.0_f64.to_radians();
        let smooth = area_sr(&gaussian_beam(fwhm_rad, 600)).unwrap();
        let expected = TAU * fwhm_rad.powi(2) / (8.0 * std::f64::consts::LN_2);
        assert!((smooth / expected - 1.0).abs() < fwhm_rad.powi(2), "{smooth} {expected}");
        for hopeless in [vec![], vec![f64::NAN; 10], vec![0.0; 10], vec![-1.0; 10]] {
            assert_eq!(area_sr(&hopeless), None, "{hopeless:?}");
        }
    }

    #[test]
    fn the_width_is_that_of_the_profile() {
        // A Gaussian on the sphere differs from one on the plane by the square of its width.
        for fwhm_deg in [0.7_f64, 1.3, 5.0] {
            let fwhm = fwhm_rad(&gaussian_beam(fwhm_deg.to_radians(), 1500)).unwrap().to_degrees();
            assert!((fwhm / fwhm_deg - 1.0).abs() < fwhm_deg.to_radians().powi(2), "{fwhm} {fwhm_deg}");
        }
        // Equal w_l up to l_max: 2 J_1(x) / x with x = (l_max + 1) theta at small angles, which is half at x = 2.21509 (tables).
        for l_max in [48_usize, 160] {
            let fwhm = fwhm_rad(&vec![1.0; l_max + 1]).unwrap();
            let expected = 2.0 * 2.21509 / (l_max + 1) as f64;
            assert!((fwhm / expected - 1.0).abs() < expected * expected, "{fwhm} {expected}");
        }
        // Unknown large scales have little effect.
        let mut w = gaussian_beam(0.02, 400);
        let whole = fwhm_rad(&w).unwrap();
        w[..18].fill(f64::NAN);
        assert!((fwhm_rad(&w).unwrap() / whole - 1.0).abs() < 0.03);
        for hopeless in [vec![], vec![f64::NAN; 100], vec![0.0; 100], vec![-1.0; 10], vec![1.0]] {
            assert_eq!(fwhm_rad(&hopeless), None, "{hopeless:?}");
        }
    }
}
