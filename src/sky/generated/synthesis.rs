//! Plain spherical-harmonic synthesis, until the crate's own one serves.

use num_complex::Complex64;
use rayon::prelude::*;

use crate::sky::harmonics::Alm;
use crate::sky::healpix::{pixel_count, ring};

/// The field of `alm` in RING order.
pub(super) fn synthesise(alm: &Alm, nside: usize) -> Vec<f64> {
    let rings: Vec<Vec<f64>> = (1..4 * nside).into_par_iter().map(|k| ring_values(alm, nside, k)).collect();
    let mut map = Vec::with_capacity(pixel_count(nside));
    rings.into_iter().for_each(|values| map.extend(values));
    map
}

fn ring_values(alm: &Alm, nside: usize, k: usize) -> Vec<f64> {
    let ring = ring(nside, k);
    let l_max = alm.l_max();
    let mut spectrum = vec![Complex64::ZERO; ring.len];
    let mut sectoral = (0.25 / std::f64::consts::PI).sqrt();
    for m in 0..=l_max {
        if m > 0 {
            sectoral *= -(1.0 + 0.5 / m as f64).sqrt() * ring.sin_theta;
        }
        let (mut before, mut now) = (0.0, sectoral);
        let mut sum = Complex64::ZERO;
        let mut a_before = 0.0;
        for (k, &coefficient) in alm.order(m).iter().enumerate() {
            sum += coefficient * now;
            let l = (m + k + 1) as f64;
            let m = m as f64;
            let a = ((4.0 * l * l - 1.0) / (l * l - m * m)).sqrt();
            let next = if k == 0 { a * ring.z * now } else { a * (ring.z * now - before / a_before) };
            (before, now, a_before) = (now, next, a);
        }
        let phase = Complex64::from_polar(if m == 0 { 1.0 } else { 2.0 }, m as f64 * ring.phi0_rad);
        spectrum[m % ring.len] += sum * phase;
    }
    rustfft::FftPlanner::new().plan_fft_inverse(ring.len).process(&mut spectrum);
    spectrum.into_iter().map(|value| value.re).collect()
}
