//! The forward operator against sums over directions that share none of its code.

use std::f64::consts::{PI, TAU};

use lunarray::array::hidden_by_moon;
use lunarray::frames::AntennaResponse;
use lunarray::response::harmonic::{HarmonicModel, ModelSettings, PairState, PatternGeometry};
use lunarray::sky::harmonics::Alm;
use lunarray::units::constants::MOON_RADIUS_M;
use lunarray::units::vector::{Vec3, add, cross, dot, scale};
use num_complex::Complex64;

const ORBIT_RADIUS_M: f64 = MOON_RADIUS_M + 300e3;
const WAVELENGTH_M: f64 = 30.0;
const INCLINATION_RAD: f64 = PI / 6.0;

/// A sky with a monopole and falling random structure.
fn sky(l_max: usize, seed: u64) -> Alm {
    let mut alm = Alm::zeros(l_max);
    let mut word = seed;
    let mut random = || {
        word = word.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
        (word >> 33) as f64 / (1_u64 << 31) as f64 - 0.5
    };
    for m in 0..=l_max {
        for l in m..=l_max {
            let size = 1e5 / (l as f64 + 1.0).powf(1.3);
            let im = if m == 0 { 0.0 } else { random() };
            *alm.get_mut(l, m) = Complex64::new(random() * size, im * size);
        }
    }
    *alm.get_mut(0, 0) = Complex64::new(1e6, 0.0);
    alm
}

/// The sky in a direction, by the textbook recurrence.
fn temperature(alm: &Alm, n: Vec3) -> f64 {
    let (sin, z) = (n[0].hypot(n[1]), n[2]);
    let turn = Complex64::new(n[0], n[1]) / sin;
    let (mut first, mut phase, mut total) = ((1.0 / (4.0 * PI)).sqrt(), Complex64::ONE, 0.0);
    for m in 0..=alm.l_max() {
        if m > 0 {
            first *= -sin * ((2 * m + 1) as f64 / (2 * m) as f64).sqrt();
            phase *= turn;
        }
        let (mut before, mut value) = (0.0, first);
        for l in m..=alm.l_max() {
            if l > m {
                let (l, m) = (l as f64, m as f64);
                let a = ((4.0 * l * l - 1.0) / (l * l - m * m)).sqrt();
                let b = (((l - 1.0).powi(2) - m * m) / (4.0 * (l - 1.0).powi(2) - 1.0).abs()).max(0.0).sqrt();
                (before, value) = (value, a * (z * value - b * before));
            }
            let term = (alm.get(l, m) * phase).re * value;
            total += if m == 0 { term } else { 2.0 * term };
        }
    }
    total
}

/// Abscissae and weights on [0, 1].
fn gauss_legendre(n: usize) -> Vec<(f64, f64)> {
    (0..n)
        .map(|k| {
            let mut x = (PI * (k as f64 + 0.75) / (n as f64 + 0.5)).cos();
            let mut slope = 0.0;
            for _ in 0..50 {
                let (mut a, mut b) = (1.0, x);
                for j in 2..=n {
                    let j = j as f64;
                    (a, b) = (b, ((2.0 * j - 1.0) * x * b - (j - 1.0) * a) / j);
                }
                slope = n as f64 * (a - x * b) / (1.0 - x * x);
                x -= b / slope;
            }
            (0.5 * (1.0 + x), 1.0 / ((1.0 - x * x) * slope * slope))
        })
        .collect()
}

/// The visibility as an integral over the directions that neither satellite's Moon hides: by colatitude
/// about the orbit normal and longitude up to the exact edge. Checks that edge with `hidden_by_moon`.
fn direct(alm: &Alm, state: &PairState) -> Complex64 {
    let (so, co) = state.node_rad.sin_cos();
    let (si, ci) = INCLINATION_RAD.sin_cos();
    let place = |phase: f64| -> Vec3 {
        let (s, c) = phase.sin_cos();
        [co * c - so * s * ci, so * c + co * s * ci, s * si]
    };
    let (x, y) = (place(state.phase_rad), place(state.phase_rad + 0.5 * PI));
    let z = cross(x, y);
    let half = (0.5 * state.baseline_wavelengths * WAVELENGTH_M / ORBIT_RADIUS_M).asin();
    let r_i = scale(ORBIT_RADIUS_M, place(state.phase_rad + half));
    let r_j = scale(ORBIT_RADIUS_M, place(state.phase_rad - half));
    let baseline = scale(1.0 / WAVELENGTH_M, add(r_i, scale(-1.0, r_j)));
    let sin_limb = MOON_RADIUS_M / ORBIT_RADIUS_M;
    let cos_limb = (1.0 - sin_limb * sin_limb).sqrt();
    let points = 60 + (2.5 * state.baseline_wavelengths + 0.8 * alm.l_max() as f64) as usize;
    let rule = gauss_legendre(points);
    let mut total = Complex64::ZERO;
    // Rings seen whole, and rings cut by the limb (equally spaced along it, where the edge is smooth).
    let mut rings = Vec::new();
    for (t, w) in &rule {
        let theta = cos_limb.asin() * t;
        rings.push((theta.cos(), theta.sin(), w * cos_limb.asin() * theta.sin(), PI));
        let (s, c) = (0.5 * PI * t).sin_cos();
        let edge = (sin_limb * c).atan2(-cos_limb) - half;
        let z = sin_limb * s;
        rings.push((z, (1.0 - z * z).sqrt(), w * 0.5 * PI * sin_limb * c, edge));
    }
    for (height, radius, weight, edge) in rings {
        for hemisphere in [1.0, -1.0] {
            let direction = |psi: f64| {
                let (s, c) = psi.sin_cos();
                add(add(scale(radius * c, x), scale(radius * s, y)), scale(hemisphere * height, z))
            };
            let hidden = |psi: f64| {
                let n = direction(psi);
                hidden_by_moon(r_i, n, MOON_RADIUS_M) || hidden_by_moon(r_j, n, MOON_RADIUS_M)
            };
            assert!(!hidden(edge - 1e-9) && !hidden(1e-9 - edge), "{edge}");
            if edge < PI - half - 1e-6 {
                assert!(hidden(edge + 1e-9) && hidden(-edge - 1e-9), "{edge}");
            }
            for (t, w) in &rule {
                for psi in [edge * t, -edge * t] {
                    let n = direction(psi);
                    let fringe = Complex64::cis(-TAU * dot(n, baseline));
                    total += weight * w * edge * temperature(alm, n) * fringe;
                }
            }
        }
    }
    total
}

fn model(sky: &Alm, u_max: f64) -> HarmonicModel {
    let geometry = PatternGeometry {
        orbit_radius_m: ORBIT_RADIUS_M,
        moon_radius_m: MOON_RADIUS_M,
        wavelength_m: WAVELENGTH_M,
        response: AntennaResponse::Isotropic,
    };
    HarmonicModel::new(sky.clone(), ModelSettings::new(geometry, INCLINATION_RAD, u_max))
        .expect("a good model")
}

/// Part of an observing window: the node turns, the baseline breathes.
fn window(count: usize, node: f64, phase: f64, u: f64, growth: f64) -> Vec<PairState> {
    (0..count)
        .map(|k| {
            let swept = 2.0 * k as f64 / count as f64;
            PairState {
                node_rad: node - 2e-4 * swept,
                phase_rad: phase + swept,
                baseline_wavelengths: u + growth * swept,
                span_rad: 0.0,
            }
        })
        .collect()
}

#[test]
fn visibilities_are_sums_over_directions() {
    let sky = sky(18, 7);
    let mut model = model(&sky, 40.0);
    for (u, growth) in [(0.0, 0.0), (3.3, 0.02), (12.0, -0.06), (39.0, 0.1)] {
        let mut states = window(200, 5.9, 2.3, u, growth);
        states.extend(window(200, 1.1, -0.4, u, growth));
        let mut values = vec![Complex64::ZERO; states.len()];
        model.visibilities(&states, &mut values).expect("states in range");
        let rms = (values.iter().map(Complex64::norm_sqr).sum::<f64>() / values.len() as f64).sqrt();
        let picked = [0, 77, 201];
        let mut square = 0.0;
        for k in picked {
            let expected = direct(&sky, &states[k]);
            println!("{u} {k} {} {expected} {:e}", values[k], (values[k] - expected).norm() / rms);
            square += (values[k] - expected).norm_sqr();
        }
        let error = (square / picked.len() as f64).sqrt() / rms;
        // The acceptance figure is 1e-4; kernels are made for 1e-5.
        assert!(error < 3e-5, "u {u}: {error:e}");
    }
}
