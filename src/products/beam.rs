//! The effective beam of a map, from what it keeps of each degree, and noise in janskys a beam.

use std::f64::consts::{LN_2, TAU};

use serde::Serialize;

use crate::sky::Comparison;
use crate::units::constants::{BOLTZMANN_J_K, SPEED_OF_LIGHT_M_S};

/// One jansky, W m^-2 Hz^-1.
const JANSKY: f64 = 1e-26;
/// Degrees below which the shortest baselines, not the beam, decide what a map keeps.
const L_MIN: usize = 20;
/// Least share of a degree that counts in the fit.
const KEPT_MIN: f64 = 0.1;
/// Degrees over which the share is averaged to tell where it ends.
const RUN: usize = 9;

/// What a map keeps of each degree of the sky, and the Gaussian beam that keeps as much.
#[derive(Clone, Debug, Serialize, bincode::Encode, bincode::Decode)]
pub struct EffectiveBeam {
    /// `w_l = C_l^X / C_l^in` of the map and the input, from l = 0; with the Gaussian beam of post-processing, which the
    /// comparison's input has too. NaN (null) where the input has no power.
    pub w: Vec<f64>,
    /// FWHM of the Gaussian beam `exp(-l (l + 1) sigma^2 / 2)` that fits w_l best from l = 20 to where it falls below 0.1,
    /// degrees; absent if w_l does not fall.
    pub fwhm_deg: Option<f64>,
    /// Its solid angle, sr.
    pub area_sr: Option<f64>,
    /// RMS of the noise-only map, K, as compared.
    pub noise_rms_k: f64,
    /// The same in that beam: `S = 2 k T nu^2 / c^2` times the solid angle, Jy.
    pub noise_rms_jy: Option<f64>,
}

impl EffectiveBeam {
    /// Of a comparison at `frequency_hz`, whose map and input `smoothing` (by degree) has smoothed; `noise` is the noise-only
    /// map, K.
    #[must_use]
    pub(super) fn new(comparison: &Comparison, smoothing: &[f64], noise: &[f64], frequency_hz: f64) -> Self {
        let share = comparison.cl_cross.iter().zip(&comparison.cl_truth).map(|(cross, input)| cross / input);
        let w: Vec<f64> =
            share.enumerate().map(|(l, w)| w * smoothing.get(l).copied().unwrap_or(1.0)).collect();
        let variance = gaussian_variance(&w);
        let area_sr = variance.map(|variance| TAU * variance);
        let noise_rms_k = (noise.iter().map(|x| x * x).sum::<f64>() / noise.len().max(1) as f64).sqrt();
        Self {
            w,
            fwhm_deg: variance.map(|variance| (8.0 * LN_2 * variance).sqrt().to_degrees()),
            area_sr,
            noise_rms_k,
            noise_rms_jy: area_sr.map(|area_sr| flux_jy(noise_rms_k, frequency_hz, area_sr)),
        }
    }
}

/// Flux density of a temperature over a solid angle, Jy: `S = 2 k T nu^2 / c^2` times it.
fn flux_jy(temperature_k: f64, frequency_hz: f64, area_sr: f64) -> f64 {
    let per_m = frequency_hz / SPEED_OF_LIGHT_M_S;
    2.0 * BOLTZMANN_J_K * temperature_k * per_m * per_m * area_sr / JANSKY
}

/// sigma^2 of the Gaussian beam that fits `ln w_l = -l (l + 1) sigma^2 / 2` best, rad^2.
fn gaussian_variance(w: &[f64]) -> Option<f64> {
    let mean = |l: usize| w.get(l..l + RUN).map(|run| run.iter().sum::<f64>() / RUN as f64);
    let end = (L_MIN..).find(|&l| mean(l).is_none_or(|mean| mean.is_nan() || mean < KEPT_MIN))?;
    let (mut product, mut square) = (0.0, 0.0);
    for (l, &share) in w.iter().enumerate().take(end).skip(L_MIN).filter(|(_, share)| **share > 0.0) {
        let degree = (l * (l + 1)) as f64;
        product -= 2.0 * degree * share.ln();
        square += degree * degree;
    }
    let variance = product / square;
    (variance.is_finite() && variance > 0.0).then_some(variance)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::sky::spectra::gaussian_beam;

    #[test]
    fn janskys_are_those_of_the_rayleigh_jeans_law() {
        // By hand: 1e4 K at 10 MHz are 3.0724e4 Jy/sr, and a beam of 1 degree FWHM 1.1331 (pi/180)^2 sr.
        let area_sr = 1.1331 * 1_f64.to_radians().powi(2);
        assert!((flux_jy(1e4, 1e7, area_sr) / 10.605 - 1.0).abs() < 1e-4);
    }

    #[test]
    fn a_gaussian_beam_is_found_again() {
        for fwhm_deg in [0.7_f64, 1.3, 5.0] {
            let mut w = gaussian_beam(fwhm_deg.to_radians(), 400);
            // Below l = 20 the array sees little, and the end is noise.
            w[..18].fill(0.3);
            let fwhm = (8.0 * LN_2 * gaussian_variance(&w).unwrap()).sqrt().to_degrees();
            assert!((fwhm / fwhm_deg - 1.0).abs() < 1e-9, "{fwhm} {fwhm_deg}");
        }
        for hopeless in [vec![1.0; 100], vec![f64::NAN; 100], vec![0.0; 100], vec![0.5; 10]] {
            assert_eq!(gaussian_variance(&hopeless), None);
        }
    }
}
