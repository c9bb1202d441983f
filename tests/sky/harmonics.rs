//! Properties of the spherical harmonic transforms.

use std::f64::consts::PI;

use lunarray::sky::harmonics::{
    Alm, AnalysisOptions, HarmonicsError, L_MAX, Method, Transform, analysis, synthesis,
};
use lunarray::sky::healpix::{pixel_area_sr, pixel_directions};
use num_complex::Complex64;

/// Coefficients of size one, in no order.
fn white(l_max: usize) -> Alm {
    let mut alm = Alm::zeros(l_max);
    let mut state = 1_u64;
    let mut uniform = || {
        state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (state >> 11) as f64 / (1_u64 << 52) as f64 - 1.0
    };
    for (k, value) in alm.values_mut().iter_mut().enumerate() {
        *value = Complex64::new(uniform(), if k <= l_max { 0.0 } else { uniform() });
    }
    alm
}

/// Over all m, negative ones included.
fn product(a: &Alm, b: &Alm) -> f64 {
    let l_max = a.l_max();
    let terms = a.values().iter().zip(b.values()).enumerate();
    terms.map(|(k, (a, b))| (a * b.conj()).re * if k <= l_max { 1.0 } else { 2.0 }).sum()
}

fn relative_error(found: &Alm, expected: &Alm) -> f64 {
    let wrong: f64 = found.values().iter().zip(expected.values()).map(|(a, b)| (a - b).norm_sqr()).sum();
    (wrong / expected.values().iter().map(Complex64::norm_sqr).sum::<f64>()).sqrt()
}

#[test]
fn low_degrees_are_the_textbook_harmonics() {
    let nside = 8;
    // Condon-Shortley Y_00, Y_10, Y_11, Y_20, Y_21, Y_22 and what 2 Re(a Y) is for m > 0.
    let directions = pixel_directions(nside);
    type Harmonic = fn([f64; 3]) -> Complex64;
    let cases: [(usize, usize, Harmonic); 6] = [
        (0, 0, |_| Complex64::from((0.25 / PI).sqrt())),
        (1, 0, |[_, _, z]| Complex64::from((0.75 / PI).sqrt() * z)),
        (1, 1, |[x, y, _]| -(0.375 / PI).sqrt() * Complex64::new(x, y)),
        (2, 0, |[_, _, z]| Complex64::from((0.3125 / PI).sqrt() * (3.0 * z * z - 1.0))),
        (2, 1, |[x, y, z]| -(1.875 / PI).sqrt() * z * Complex64::new(x, y)),
        (2, 2, |[x, y, _]| (0.46875 / PI).sqrt() * Complex64::new(x, y).powi(2)),
    ];
    for (l, m, harmonic) in cases {
        let coefficient = if m == 0 { Complex64::from(1.3) } else { Complex64::new(0.7, -0.4) };
        let mut alm = Alm::zeros(2);
        *alm.get_mut(l, m) = coefficient;
        let map = synthesis(&alm, nside).unwrap();
        for (value, &direction) in map.iter().zip(&directions) {
            let expected = (coefficient * harmonic(direction)).re * if m == 0 { 1.0 } else { 2.0 };
            // A few roundings of numbers of order one.
            assert!((value - expected).abs() < 1e-14, "l {l} m {m}");
        }
    }
}

#[test]
fn adjoint_is_the_transpose() {
    for (nside, l_max) in [(1, 5), (4, 11), (16, 100), (32, 95)] {
        let transform = Transform::new(nside, l_max).unwrap();
        let alm = white(l_max);
        let map: Vec<f64> = (0..12 * nside * nside).map(|k| (k as f64 * 0.37).sin()).collect();
        let image = transform.synthesis(&alm).unwrap();
        let left: f64 = image.iter().zip(&map).map(|(a, b)| a * b).sum::<f64>() * pixel_area_sr(nside);
        let right = product(&alm, &transform.adjoint(&map).unwrap());
        let scale = product(&alm, &alm).sqrt();
        // Thousands of terms of mixed sign, each good to 1e-14 or so.
        assert!((left - right).abs() < 1e-12 * scale, "nside {nside}, l_max {l_max}: {left} and {right}");
    }
}

#[test]
fn least_squares_finds_band_limited_maps_again() {
    for (nside, l_max, most) in [(1, 2, 10), (16, 40, 10), (64, 160, 10), (16, 47, 60)] {
        let alm = white(l_max);
        let map = synthesis(&alm, nside).unwrap();
        let found = analysis(&map, l_max, &AnalysisOptions { method: Method::ACCURATE }).unwrap();
        let error = relative_error(&found.alm, &alm);
        assert!(error < 1e-6, "nside {nside}, l_max {l_max}: {error:e}");
        assert!(found.iterations <= most, "nside {nside}, l_max {l_max}: {} iterations", found.iterations);
    }
}

#[test]
fn the_number_of_threads_changes_no_bit() {
    // More ring pairs than are held at once would take nside 512; groups and orders are shared out here.
    let (nside, l_max) = (64, 191);
    let alm = white(l_max);
    let run = |threads| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| {
            let transform = Transform::new(nside, l_max).unwrap();
            let map = transform.synthesis(&alm).unwrap();
            let back = transform.analysis(&map, &AnalysisOptions::default()).unwrap();
            (map, back)
        })
    };
    let one = run(1);
    for threads in [2, 3, 7] {
        assert!(run(threads) == one, "{threads} threads");
    }
}

#[test]
fn several_chunks_of_rings_agree_with_one_harmonic() {
    // nside 512 has twice the ring pairs of a chunk. A zonal and a sectoral harmonic, summed directly.
    let (nside, l, m) = (512, 3, 2);
    let mut alm = Alm::zeros(1200);
    *alm.get_mut(l, m) = Complex64::new(1.0, 0.5);
    let map = synthesis(&alm, nside).unwrap();
    // Y_32 = sqrt(105 / 32 pi) z (x + i y)^2.
    let factor = 2.0 * (105.0 / (32.0 * PI)).sqrt();
    for (value, &[x, y, z]) in map.iter().zip(&pixel_directions(nside)) {
        let expected = factor * z * (Complex64::new(1.0, 0.5) * Complex64::new(x, y).powi(2)).re;
        assert!((value - expected).abs() < 1e-13);
    }
    let back = Transform::new(nside, 1200).unwrap().adjoint(&map).unwrap();
    let others: f64 = back.values().iter().map(Complex64::norm_sqr).sum::<f64>() - back.get(l, m).norm_sqr();
    // Quadrature at so low a degree errs by the order of (l / nside)^2 = 3e-5.
    assert!((back.get(l, m) - Complex64::new(1.0, 0.5)).norm() < 1e-4 && others < 1e-8);
}

#[test]
fn functions_far_below_the_least_number_come_back() {
    // At the pole's first ring of nside 256, sin theta = 0.0032: (sin theta)^700 is 1e-1746.
    let (nside, l_max, m) = (256, 767, 700);
    let mut alm = Alm::zeros(l_max);
    *alm.get_mut(l_max, m) = Complex64::ONE;
    let map = synthesis(&alm, nside).unwrap();
    assert!(map.iter().all(|value| value.is_finite()));
    let norm: f64 = map.iter().map(|value| value * value).sum::<f64>() * pixel_area_sr(nside);
    // The norm of 2 Re Y_lm is 2; quadrature errs by per cents at such degrees.
    assert!((norm - 2.0).abs() < 0.1, "{norm}");
    assert!(map[..1000].iter().all(|value| value.abs() < 1e-30));
}

#[test]
fn what_makes_no_sense_is_refused() {
    assert_eq!(Transform::new(3, 4).unwrap_err(), HarmonicsError::Nside { nside: 3 });
    let degree = HarmonicsError::Degree { l_max: L_MAX + 1, most: L_MAX };
    assert_eq!(Transform::new(4, L_MAX + 1).unwrap_err(), degree);
    let transform = Transform::new(4, 7).unwrap();
    assert!(matches!(transform.synthesis(&Alm::zeros(6)), Err(HarmonicsError::Coefficients { .. })));
    assert!(matches!(transform.adjoint(&[0.0; 12]), Err(HarmonicsError::Pixels { .. })));
    let options = AnalysisOptions::default();
    assert!(matches!(analysis(&[0.0; 192], 12, &options), Err(HarmonicsError::Degree { most: 11, .. })));
    assert!(matches!(analysis(&[0.0; 191], 5, &options), Err(HarmonicsError::Pixels { .. })));
    let mut map = [0.0; 192];
    assert_eq!(analysis(&map, 5, &options).unwrap().alm, Alm::zeros(5));
    assert_eq!(analysis(&map, 5, &AnalysisOptions { method: Method::ACCURATE }).unwrap().iterations, 0);
    map[3] = f64::NAN;
    assert!(matches!(analysis(&map, 5, &options), Err(HarmonicsError::NotFinite { pixel: 3, .. })));
    map[3] = 1.0;
    let method = Method::LeastSquares { tolerance: 1e-9, iterations_max: 2 };
    let refused = analysis(&map, 11, &AnalysisOptions { method });
    assert!(matches!(refused, Err(HarmonicsError::NotConverged { iterations: 2, .. })));
}
