//! The two engines, pixels and harmonics, on the same data; and what is estimated without a matrix against what a
//! matrix gives.

use crate::spectrum::Spectrum;
use lunarray::array::{Array, ArrayConfig, ObservingWindows};
use lunarray::frames::{AntennaResponse, PlacedVisibilities};
use lunarray::imaging::Samples;
use lunarray::imaging::circle::{HarmonicEngine, HarmonicSetup, HarmonicSums, nominal_orbit};
use lunarray::imaging::{
    HarmonicRequest, HarmonicSolution, NamedWatch, Regulariser, SolveError, SolveWatch, StoppingRule,
    W_MAX_EXACT, largest_eigenvalue, probed_traces, solve_pixels, solve_regularised, traces,
};
use lunarray::imaging::{NormalEngine, NormalSums, PixelEngine, PixelSetup};
use lunarray::response::harmonic::GeometryLimits;
use lunarray::response::pixel::{Directions, PairGeometry, PixelMethod, sky_sums};
use lunarray::runtime::Cancel;
use lunarray::sky::generated::{GeneratedSky, generate};
use lunarray::sky::healpix::pixel_area_sr;
use lunarray::sky::{Frame, SkyMap, compare};
use lunarray::units::all_pairs;
use lunarray::units::constants::YEAR_S;
use lunarray::units::vector::{norm, sub};

/// About `count` visibilities of the sky below `baseline_m_max`, over a whole precession; every orbit that is used
/// gives a few of each pair.
pub fn observe(
    sky: &SkyMap,
    frequency_hz: f64,
    baseline_m_max: f64,
    count: usize,
) -> Vec<PlacedVisibilities> {
    let array = Array::new(&ArrayConfig::default()).unwrap();
    let directions = Directions::from(sky.directions_ecliptic().as_slice());
    let values: Vec<f32> = sky.values().iter().map(|&t| t as f32).collect();
    let mut blocks = Vec::new();
    let windows: Vec<_> = ObservingWindows::new(&array, 0.0, 1.3 * YEAR_S).step_by(5).collect();
    let each = (count / windows.len()).max(1);
    for (number, window) in windows.iter().enumerate() {
        let (start, end) = (window.start.seconds(), window.end.seconds());
        let pairs: Vec<_> = all_pairs(8)
            .into_iter()
            .filter(|pair| {
                let at = |n: u8| array.position_m(usize::from(n), 0.5 * (start + end));
                norm(sub(at(pair.i), at(pair.j))) < 0.98 * baseline_m_max
            })
            .collect();
        for k in (0..each).filter(|_| !pairs.is_empty()) {
            // Another pair and another part of the window each time, without a common rhythm.
            let pair = pairs[(number * 7 + k) % pairs.len()];
            let fraction = (0.5 + 0.618_034 * (number * each + k) as f64).fract();
            let time_s = start + (0.01 + 0.98 * fraction) * (end - start);
            let [r_i_m, r_j_m] = [pair.i, pair.j].map(|n| array.position_m(usize::from(n), time_s));
            let geometry = PairGeometry {
                r_i_m,
                r_j_m,
                frequency_hz,
                moon_radius_m: array.moon_radius_m(),
                response: AntennaResponse::Isotropic,
            };
            let sum = sky_sums(&[geometry], &directions, &values, pixel_area_sr(sky.nside())).unwrap()[0];
            blocks.push(PlacedVisibilities {
                frequency_hz,
                pair,
                time_s: vec![time_s],
                r_i_m: vec![r_i_m],
                r_j_m: vec![r_j_m],
                value_k_sr: vec![sum.visibility_k_sr],
                weight: vec![1e-8],
                ..PlacedVisibilities::default()
            });
        }
    }
    blocks
}

fn add_all<E: NormalEngine>(mut engine: E, blocks: &[PlacedVisibilities]) -> E::Equations {
    for block in blocks {
        let added = engine.add(block).unwrap();
        assert!(added.visibilities == 1 && added.refused.is_empty());
    }
    engine.into_sums()
}

pub fn harmonic_sums(blocks: &[PlacedVisibilities], l_max: usize, baseline_m_max: f64) -> HarmonicSums {
    let setup = HarmonicSetup {
        l_max,
        frequency_hz: blocks[0].frequency_hz,
        baseline_m_max,
        moon_radius_m: ArrayConfig::default().moon_radius_m,
        response: AntennaResponse::Isotropic,
        orbit: nominal_orbit(&blocks[0], GeometryLimits::default()).unwrap(),
        companion_seed: 1,
        weight_max: 1e-5,
    };
    add_all(HarmonicEngine::new(setup).unwrap(), blocks)
}

fn pixel_sums(blocks: &[PlacedVisibilities], nside: usize) -> lunarray::imaging::PixelSums {
    let setup = PixelSetup {
        nside,
        frequency_hz: blocks[0].frequency_hz,
        method: PixelMethod::Average,
        moon_radius_m: ArrayConfig::default().moon_radius_m,
        response: AntennaResponse::Isotropic,
        companion_seed: 1,
        weight_max: 1e-5,
    };
    add_all(PixelEngine::new(setup).unwrap(), blocks)
}

const RULE: StoppingRule = StoppingRule { residual_max: 1e-5, iterations_max: 500 };

/// The same visibilities of a sky with small scales through both engines.
#[test]
fn both_engines_make_the_same_map() {
    const NSIDE: usize = 16;
    // 3 MHz: l = 5 .. 32 are well measured at this epsilon (closed loop on published skies).
    let (frequency_hz, epsilon, baseline_m_max) = (3e6, 1e-4, 3_000.0);
    let sky = generate(&GeneratedSky::default(), frequency_hz, 64, 5).unwrap();
    let sky = SkyMap::new(Frame::Ecliptic, sky).unwrap();
    let blocks = observe(&sky, frequency_hz, baseline_m_max, 12_000);
    let by_pixel = pixel_sums(&blocks, NSIDE);
    let by_harmonic = harmonic_sums(&blocks, 40, baseline_m_max);
    assert_eq!(by_pixel.counts().visibilities, by_harmonic.counts().visibilities);
    let pixel = solve_pixels(by_pixel, epsilon, None).unwrap();
    let request =
        HarmonicRequest { epsilon, nside: NSIDE, rule: RULE, samples: Samples::default(), probes: 0 };
    let watch = SolveWatch::default();
    let harmonic = solve_harmonics(&by_harmonic, request, None, None, watch.named("test")).unwrap();
    assert!(harmonic.diagnostics.convergence.unwrap().converged);
    // The largest eigenvalue belongs to the smoothest functions, which averages over pixels hardly change:
    // by the square of the pixel window at l < 6, 1 - l (l + 1) / (12 nside^2) and more.
    let ratio = harmonic.diagnostics.w_max.unwrap() / pixel.diagnostics.w_max.unwrap();
    assert!((ratio - 1.0).abs() < 0.02, "{ratio}");
    let map = |values: &[f64]| SkyMap::new(Frame::Ecliptic, values.to_vec()).unwrap();
    let both = compare(&map(&harmonic.map_k), &map(&pixel.map_k), None, None).unwrap();
    let noises = compare(&map(&harmonic.noise_k), &map(&pixel.noise_k), None, None).unwrap();
    for l in 5..=28 {
        assert!(both.rho[l] >= 0.99, "maps, l = {l}: {}", both.rho[l]);
        // The same noise was drawn for both, but spreads over 1681 unknowns in one and 3072 in the other.
        assert!(noises.rho[l] >= 0.9, "noise maps, l = {l}: {}", noises.rho[l]);
    }
    let truth = compare(&map(&harmonic.map_k), &sky.resized(NSIDE).unwrap(), None, None).unwrap();
    for l in 5..=28 {
        assert!(truth.rho[l] >= 0.98, "sky, l = {l}: {}", truth.rho[l]);
    }
}

/// Solves with R = epsilon W_max I.
pub fn solve_harmonics(
    sums: &HarmonicSums,
    request: HarmonicRequest,
    prior_k: Option<&[f64]>,
    start: Option<&[Vec<f64>; 2]>,
    watch: NamedWatch<'_>,
) -> Result<HarmonicSolution, SolveError> {
    solve_regularised(sums, request, &Regulariser::default(), prior_k, start, watch)
}

/// A small case whose matrix can be written down.
fn small() -> (HarmonicSums, Spectrum) {
    let sky = SkyMap::new(Frame::Ecliptic, vec![1e6; 12 * 8 * 8]).unwrap();
    let sums = harmonic_sums(&observe(&sky, 3e6, 1_000.0, 3_000), 16, 1_000.0);
    let spectrum = Spectrum::new(&sums);
    (sums, spectrum)
}

#[test]
fn estimates_without_a_matrix_agree_with_the_matrix() {
    let (sums, exact) = small();
    let w_max = exact.w_max();
    let epsilon = 1e-3;
    let eps = epsilon * largest_eigenvalue(&sums, W_MAX_EXACT, &mut |_, _| true).value;
    assert!((eps / (epsilon * w_max) - 1.0).abs() < 1e-5, "{eps}");
    let watch = SolveWatch::default();
    let found = probed_traces(&sums, epsilon, w_max, 24, watch.named("test")).unwrap().unwrap();
    let held = traces(&sums, epsilon, w_max, 24, watch.named("test")).unwrap().unwrap();
    let exact_n = exact.trace(|w| w / (w + eps).powi(2));
    let exact_s = exact.trace(|w| (eps / (w + eps)).powi(2));
    for (found, exact) in [(found.sigma_n_k2, exact_n), (found.sigma_s, exact_s)] {
        // Four standard errors, the probability of which is 1e-3 with 24 vectors; and the error bar means something.
        assert!((found.value - exact).abs() < 4.0 * found.error, "{found:?} {exact}");
        assert!(found.error < 0.3 * exact, "{found:?} {exact}");
    }
    // Held, it is the same matrix but for roundings in f64, and epsilon refers to the W_max that was given.
    let given = epsilon * w_max;
    let exact_n = exact.trace(|w| w / (w + given).powi(2));
    let exact_s = exact.trace(|w| (given / (w + given)).powi(2));
    assert!((held.sigma_n_k2.value / exact_n - 1.0).abs() < 1e-9, "{held:?} {exact_n}");
    assert!((held.sigma_s.value / exact_s - 1.0).abs() < 1e-9, "{held:?} {exact_s}");
    assert_eq!((held.probes, found.probes), (0, 24));
    // The solution against the matrix's.
    let right = sums.noise_right_hand_side();
    let request = HarmonicRequest {
        epsilon,
        nside: 8,
        rule: StoppingRule { residual_max: 1e-7, ..RULE },
        samples: Samples::default(),
        probes: 0,
    };
    let solved = solve_harmonics(&sums, request, None, None, watch.named("test")).unwrap();
    let exact = exact.apply(|w| 1.0 / (w + eps), right);
    let length = exact.iter().map(|x| x * x).sum::<f64>().sqrt();
    let error =
        exact.iter().zip(&solved.unknowns[1]).map(|(a, b)| (a - b).powi(2)).sum::<f64>().sqrt() / length;
    // Products in f32, whose rounding the least eigenvalues, 1e-3 of the greatest, magnify.
    assert!(error < 1e-3, "{error:e}");
}

/// The thermal trace of a map of harmonics against that of pixels.
#[test]
fn traces_agree_with_the_pixel_engine() {
    let (frequency_hz, baseline_m_max, nside) = (1e6, 750.0, 8);
    let sky = SkyMap::new(Frame::Ecliptic, vec![1e6; 12 * 8 * 8]).unwrap();
    let blocks = observe(&sky, frequency_hz, baseline_m_max, 3_000);
    let exact = Spectrum::new(&pixel_sums(&blocks, nside));
    let sums = harmonic_sums(&blocks, 22, baseline_m_max);
    for epsilon in [0.1, 1e-2] {
        let w_max = largest_eigenvalue(&sums, W_MAX_EXACT, &mut |_, _| true).value;
        let found = traces(&sums, epsilon, w_max, 24, SolveWatch::default().named("test")).unwrap().unwrap();
        let found = found.sigma_n_k2 / pixel_area_sr(nside);
        let eps = epsilon * exact.w_max();
        let exact = exact.trace(|w| w / (w + eps).powi(2));
        // Fringes of u < 2.5 end at l = 16; a pixel's window of nside 8 lowers their power there by 9 %, on average
        // over l by half of that. (At 1e-3 modes beyond the band's end count, 768 in one and 529 in the other.)
        assert!((found.value / exact - 1.0).abs() < 0.05 + 4.0 * found.error / exact, "{found:?} {exact}");
    }
}

/// A solution that starts from the last one, with a little more data, is found sooner; one that is interrupted
/// leaves what it has.
#[test]
fn solutions_start_warm_and_end_early() {
    let sky = generate(&GeneratedSky::default(), 3e6, 32, 5).unwrap();
    let sky = SkyMap::new(Frame::Ecliptic, sky).unwrap();
    let blocks = observe(&sky, 3e6, 1_500.0, 4_000);
    let most = blocks.len() * 19 / 20;
    let (early, late) = (harmonic_sums(&blocks[..most], 24, 1_500.0), harmonic_sums(&blocks, 24, 1_500.0));
    let request =
        HarmonicRequest { epsilon: 1e-4, nside: 8, rule: RULE, samples: Samples::default(), probes: 0 };
    let watch = SolveWatch::default();
    let first = solve_harmonics(&early, request, None, None, watch.named("test")).unwrap();
    let cold = solve_harmonics(&late, request, None, None, watch.named("test")).unwrap();
    let warm = solve_harmonics(&late, request, None, Some(&first.unknowns), watch.named("test")).unwrap();
    let steps =
        |solved: &lunarray::imaging::HarmonicSolution| solved.diagnostics.convergence.unwrap().iterations;
    assert!(steps(&warm) < steps(&cold), "{} {}", steps(&warm), steps(&cold));
    let distance = |a: &[f64], b: &[f64]| {
        let square: f64 = a.iter().zip(b).map(|(a, b)| (a - b).powi(2)).sum();
        (square / b.iter().map(|b| b * b).sum::<f64>()).sqrt()
    };
    // Both end at the same residual, 1e-5 of the right-hand side.
    assert!(distance(&warm.map_k, &cold.map_k) < 1e-2);

    let cancel = Cancel::new();
    cancel.cancel();
    let hurried = SolveWatch::new(cancel);
    let request = HarmonicRequest { rule: StoppingRule { residual_max: 1e-9, ..RULE }, ..request };
    let ended = solve_harmonics(&late, request, None, None, hurried.named("test")).unwrap();
    let convergence = ended.diagnostics.convergence.unwrap();
    assert!(!convergence.converged && convergence.iterations <= 12);
    assert!(distance(&ended.map_k, &cold.map_k) < 0.1, "{}", distance(&ended.map_k, &cold.map_k));
    assert!(hurried.progress().is_none());
}

/// With a prior the map goes to it where nothing was measured.
#[test]
fn a_prior_fills_what_is_not_measured() {
    let level_k = 5e5;
    // The sums over its pixels miss the Moon's limb by half a pixel: it has to be fine.
    let sky = SkyMap::new(Frame::Ecliptic, vec![level_k; 12 * 128 * 128]).unwrap();
    // Baselines of 10 wavelengths and more see little of a uniform sky.
    let blocks: Vec<_> = observe(&sky, 10e6, 3_000.0, 2_000);
    let sums = harmonic_sums(&blocks, 24, 3_000.0);
    let request =
        HarmonicRequest { epsilon: 1e-3, nside: 8, rule: RULE, samples: Samples::default(), probes: 0 };
    let prior = vec![level_k; 12 * 16 * 16];
    let watch = SolveWatch::default();
    let without = solve_harmonics(&sums, request, None, None, watch.named("test")).unwrap();
    let with = solve_harmonics(&sums, request, Some(&prior), None, watch.named("test")).unwrap();
    let mean = |map: &[f64]| map.iter().sum::<f64>() / map.len() as f64;
    assert!((mean(&with.map_k) / level_k - 1.0).abs() < 0.01, "{}", mean(&with.map_k));
    assert!(mean(&without.map_k) < 0.9 * level_k, "{}", mean(&without.map_k));
}
