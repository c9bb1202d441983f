//! Skies with a given correlation to another sky, as imperfect priors (the paper, Fig. 12).

use num_complex::Complex64;
use rand::RngExt;
use rand_distr::StandardNormal;

use super::error::MapError;
use super::harmonics::{Alm, AnalysisOptions, Transform};
use super::map::SkyMap;
use super::spectra::{auto_cl, cross_cl};
use crate::units::{StreamKind, random_stream};

/// First word of the random stream's identity, which keeps it apart from the streams of other skies.
const STREAM: u64 = 0xC0;

impl SkyMap {
    /// Returns a map with the mean and the power spectrum of this one up to l = 2 nside, and with the correlation
    /// `rho_l = correlation` from l = 1: `a_lm -> rho a_lm + sqrt(1 - rho^2) r_lm`, where random r_lm of the same power
    /// are orthogonal to a_lm at each degree. Equal seeds give equal maps.
    ///
    /// # Errors
    /// [`MapError::BadPixels`] for a map with invalid pixels.
    #[doc(hidden)]
    pub fn correlated(&self, correlation: f64, seed: u64) -> Result<Self, MapError> {
        let l_max = 2 * self.nside();
        let own = self.harmonics(l_max, &AnalysisOptions::default())?;
        let mut alm = white_noise(l_max, seed);
        let (own_cl, cross) = (auto_cl(&own), cross_cl(&own, &alm));
        add_degrees(&mut alm, &own, |l| -cross[l] / own_cl[l]);
        let random_cl = auto_cl(&alm);
        let rest = (1.0 - correlation * correlation).max(0.0).sqrt();
        let scale = |l: usize| rest * (own_cl[l] / random_cl[l]).sqrt();
        for m in 0..=l_max {
            for (value, l) in alm.order_mut(m).iter_mut().zip(m..) {
                // The mean does not change, and a degree without power stays zero.
                *value *= if l == 0 || !scale(l).is_finite() { 0.0 } else { scale(l) };
            }
        }
        add_degrees(&mut alm, &own, |l| if l == 0 { 1.0 } else { correlation });
        Ok(self.with_values(self.frame(), Transform::new(self.nside(), l_max)?.synthesis(&alm)?))
    }
}

/// Adds the coefficients of `other`, each times the factor of its degree.
fn add_degrees(alm: &mut Alm, other: &Alm, factor: impl Fn(usize) -> f64) {
    for m in 0..=alm.l_max() {
        for ((value, other), l) in alm.order_mut(m).iter_mut().zip(other.order(m)).zip(m..) {
            let factor = factor(l);
            if factor.is_finite() {
                *value += other * factor;
            }
        }
    }
}

/// Draws white noise: real and imaginary parts of m > 0 have half the variance of m = 0, which is real.
fn white_noise(l_max: usize, seed: u64) -> Alm {
    let mut stream = random_stream(seed, StreamKind::SkyFluctuations, [STREAM, l_max as u64]);
    let mut alm = Alm::zeros(l_max);
    for m in 0..=l_max {
        for value in alm.order_mut(m) {
            let (re, im): (f64, f64) = (stream.sample(StandardNormal), stream.sample(StandardNormal));
            let half = std::f64::consts::FRAC_1_SQRT_2;
            *value = if m == 0 { Complex64::new(re, 0.0) } else { Complex64::new(half * re, half * im) };
        }
    }
    alm
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::sky::Frame;
    use crate::sky::healpix::pixel_directions;
    use crate::sky::spectra::rho;

    #[test]
    fn every_degree_has_the_correlation_and_the_power_asked_for() {
        // Coefficients that fall as 0.82^l, so that every degree has power.
        let peak = |x: f64| 1.0 / (1.02 - x);
        let value = |n: &[f64; 3]| peak(0.6 * n[0] + 0.8 * n[2]) + peak(0.28 * n[0] - 0.96 * n[1]);
        let map = SkyMap::new(Frame::Galactic, pixel_directions(16).iter().map(value).collect()).unwrap();
        let coefficients = |map: &SkyMap| map.harmonics(32, &AnalysisOptions::default()).unwrap();
        let own = coefficients(&map);
        for correlation in [0.8, 0.0, 1.0] {
            let other = map.correlated(correlation, 3).unwrap();
            let found = coefficients(&other);
            let (power, expected) = (auto_cl(&found), auto_cl(&own));
            for l in 1..=24 {
                // Quadrature over pixels of nside 16 is accurate to 1e-3 of a degree's power below 1.5 nside.
                let rho = rho(&own, &found)[l];
                assert!((rho - correlation).abs() < 5e-3, "l = {l}: {rho} of {correlation}");
                assert!((power[l] / expected[l] - 1.0).abs() < 1e-2, "l = {l}");
            }
            let mean = |map: &SkyMap| map.values().iter().sum::<f64>() / map.values().len() as f64;
            assert!((mean(&other) / mean(&map) - 1.0).abs() < 1e-3);
            assert_eq!(other, map.correlated(correlation, 3).unwrap());
        }
        assert_ne!(map.correlated(0.8, 3).unwrap(), map.correlated(0.8, 4).unwrap());
    }
}
