//! Maps of pixels whose matrix is not held: against the matrix itself and values of other code, and whatever the threads and the order.

use crate::common;

use lunarray::frames::{AntennaResponse, PlacedVisibilities};
use lunarray::imaging::anywhere::{RefinedSetup, VisibilityArchive};
use lunarray::imaging::{
    EngineKind, MapConfig, MatrixFreeSums, MatrixFreeVisibilities, MatrixKind, NormalEngine, NormalSums,
    PixelEngine, PixelSetup, PixelSums, RefineConfig,
};
use lunarray::imaging::{
    PixelSolution, SolveError, SolveWatch, StoppingRule, solve_matrix_free, solve_pixels,
};
use lunarray::pipeline::Config;
use lunarray::response::harmonic::GeometryLimits;
use lunarray::response::pixel::PixelMethod;
use lunarray::runtime::Cancel;
use lunarray::sky::generated::{GeneratedSky, generate};
use lunarray::sky::{Frame, SkyMap};
use lunarray::units::ChannelId;
use lunarray::units::constants::MOON_RADIUS_M;
use num_complex::Complex64;
use serde_json::Value;

use super::engines::observe;
use super::tikhonov;

const NSIDE: usize = 8;
const FREQUENCY_HZ: f64 = 3e6;
const BASELINE_M_MAX: f64 = 1_500.0;

/// Products are made of f32 rows, whose sums have errors of some 1e-7: residuals hardly below that are reached.
const RULE: StoppingRule = StoppingRule { residual_max: 1e-6, iterations_max: 2_000 };

/// Visibilities of a sky with small scales; with noise of their weight, if asked for.
fn data(noisy: bool) -> Vec<PlacedVisibilities> {
    let sky = generate(&GeneratedSky::default(), FREQUENCY_HZ, 32, 5).unwrap();
    let mut blocks =
        observe(&SkyMap::new(Frame::Ecliptic, sky).unwrap(), FREQUENCY_HZ, BASELINE_M_MAX, 2_000);
    for (k, block) in blocks.iter_mut().enumerate() {
        block.weight[0] = 1e-8 * (1.0 + (k % 3) as f64);
        if noisy {
            // Of unit size and any phase: what kind of noise it is does not matter.
            block.value_k_sr[0] += Complex64::from_polar(block.weight[0].powf(-0.5), 2.4 * k as f64);
        }
    }
    blocks
}

fn archive_of(frequency_hz: f64, moon_radius_m: f64, weight_max: f64) -> VisibilityArchive {
    VisibilityArchive::new(RefinedSetup {
        channel: ChannelId(0),
        l_max: 0,
        frequency_hz,
        baseline_m_max: BASELINE_M_MAX,
        moon_radius_m,
        response: AntennaResponse::Isotropic,
        companion_seed: 1,
        weight_max,
        limits: GeometryLimits::default(),
        visibilities_max: 1 << 20,
    })
    .unwrap()
}

fn archive(blocks: &[PlacedVisibilities]) -> VisibilityArchive {
    let mut archive = archive_of(FREQUENCY_HZ, MOON_RADIUS_M, 1e-6);
    for block in blocks {
        assert_eq!(archive.add(block).unwrap().visibilities, block.len() as u64);
    }
    archive
}

fn matrix_free(archive: VisibilityArchive, method: PixelMethod) -> MatrixFreeSums {
    MatrixFreeVisibilities { nside: NSIDE, method, archive }.into_sums().unwrap()
}

fn held(blocks: &[PlacedVisibilities], method: PixelMethod) -> PixelSums {
    let mut engine = PixelEngine::new(PixelSetup {
        nside: NSIDE,
        frequency_hz: FREQUENCY_HZ,
        method,
        moon_radius_m: MOON_RADIUS_M,
        response: AntennaResponse::Isotropic,
        companion_seed: 1,
        weight_max: 1e-6,
    })
    .unwrap();
    for block in blocks {
        assert_eq!(engine.add(block).unwrap().visibilities, block.len() as u64);
    }
    engine.into_sums()
}

fn solve(sums: &MatrixFreeSums, epsilon: f64, prior_k: Option<&[f64]>) -> PixelSolution {
    solve_matrix_free(sums, epsilon, prior_k, None, RULE, SolveWatch::default().named("test")).unwrap().0
}

/// Euclidean, relative.
fn difference(found: &[f64], expected: &[f64]) -> f64 {
    assert_eq!(found.len(), expected.len());
    let square = |values: &mut dyn Iterator<Item = f64>| values.map(|v| v * v).sum::<f64>().sqrt();
    square(&mut found.iter().zip(expected).map(|(a, b)| a - b)) / square(&mut expected.iter().copied())
}

#[test]
fn maps_are_those_of_the_held_matrix() {
    let epsilon = 1e-2;
    // An error of the product and a residual of 1e-6 are at most 1e-6 W_max / R in the map, each.
    let tolerance = 2.0 * 1e-6 / epsilon;
    for noisy in [false, true] {
        let blocks = data(noisy);
        for method in [PixelMethod::Centre, PixelMethod::Average] {
            let (held, matrix_free) = (held(&blocks, method), matrix_free(archive(&blocks), method));
            assert_eq!(matrix_free.counts().visibilities, held.counts().visibilities);
            // The sums of the power are of the same exact integers.
            assert_eq!(matrix_free.counts(), held.counts());
            let prior: Vec<f64> =
                (0..matrix_free.unknowns()).map(|p| 2e6 + 1e6 * (0.1 * p as f64).sin()).collect();
            for prior in [None, Some(prior.as_slice())] {
                let what = format!("{method:?}, noise {noisy}, prior {}", prior.is_some());
                let expected = solve_pixels(held.clone(), epsilon, prior).unwrap();
                let found = solve(&matrix_free, epsilon, prior);
                let of_w_max = found.diagnostics.w_max.unwrap() / expected.diagnostics.w_max.unwrap() - 1.0;
                // Lanczos ends when a product changes it by less than 1e-6.
                assert!(of_w_max.abs() < 1e-5, "{what}: {of_w_max:e}");
                assert!(found.diagnostics.convergence.unwrap().converged, "{what}");
                let errors = [
                    difference(&found.map_k, &expected.map_k),
                    difference(&found.noise_k, &expected.noise_k),
                ];
                assert!(errors.iter().all(|error| *error < tolerance), "{what}: {errors:?}");
            }
        }
    }
}

#[test]
fn products_are_those_of_the_held_matrix() {
    let blocks = data(true);
    for method in [PixelMethod::Centre, PixelMethod::Average] {
        let (held, matrix_free) = (held(&blocks, method), matrix_free(archive(&blocks), method));
        let pixels = held.unknowns();
        for x in [
            (0..pixels).map(|p| (1.7 * p as f64).sin()).collect::<Vec<f64>>(),
            (0..pixels).map(|p| 4e6 + 1e5 * (0.3 * p as f64).cos()).collect(),
        ] {
            let mut product = [vec![0.0; pixels], vec![0.0; pixels]];
            held.apply(&x, &mut product[0]);
            matrix_free.apply(&x, &mut product[1]);
            // The rows are the same numbers; their sums in f32 are good to some 1e-7 of the greatest eigenvalue.
            assert!(difference(&product[1], &product[0]) < 1e-6, "{method:?}");
        }
        for (found, expected) in [
            (matrix_free.right_hand_side(), held.right_hand_side()),
            (matrix_free.noise_right_hand_side(), held.noise_right_hand_side()),
        ] {
            assert!(difference(found, expected) < 1e-6, "{method:?}");
        }
    }
}

/// The reference's rows are made by other code.
#[test]
#[ignore = "needs LUNARRAY_SHARED"]
fn products_agree_with_other_code() {
    let path = common::shared("reference/tikhonov_nside4.json");
    let reference: Value = serde_json::from_str(&std::fs::read_to_string(path).unwrap()).unwrap();
    let numbers = |value: &Value| -> Vec<f64> {
        value.as_array().unwrap().iter().map(|value| value.as_f64().unwrap()).collect()
    };
    let (blocks, setup) = tikhonov::data(&reference);
    let mut archive = archive_of(setup.frequency_hz, setup.moon_radius_m, setup.weight_max);
    for block in &blocks {
        assert_eq!(archive.add(block).unwrap().visibilities, 1);
    }
    let sums =
        MatrixFreeVisibilities { nside: setup.nside, method: setup.method, archive }.into_sums().unwrap();
    // Rows in f32.
    assert!(difference(sums.right_hand_side(), &numbers(&reference["dirty_map"])) < 1e-6);
    let expected = numbers(&reference["solutions"]["0.01"]["map_k"]);
    // The product with a map that solves the equations is their right side.
    let regularisation = 1e-2 * reference["w_max"].as_f64().unwrap();
    let mut product = vec![0.0; expected.len()];
    sums.apply(&expected, &mut product);
    let left: Vec<f64> = product.iter().zip(&expected).map(|(y, x)| y + regularisation * x).collect();
    // Likewise: the greatest part of the map is what is measured best.
    assert!(difference(&left, &numbers(&reference["dirty_map"])) < 1e-5);
}

#[test]
fn bits_are_those_of_the_visibilities_alone() {
    let blocks = data(true);
    let bits = |solution: &PixelSolution| -> Vec<u64> {
        solution.map_k.iter().chain(&solution.noise_k).map(|value| value.to_bits()).collect()
    };
    let rule = StoppingRule { residual_max: 1e-6, iterations_max: 10 };
    let map = |archive: VisibilityArchive, threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| {
            let sums = matrix_free(archive, PixelMethod::Average);
            bits(
                &solve_matrix_free(&sums, 1e-2, None, None, rule, SolveWatch::default().named("test"))
                    .unwrap()
                    .0,
            )
        })
    };
    let once = map(archive(&blocks), 1);
    assert!(map(archive(&blocks), 2) == once);
    let backwards: Vec<PlacedVisibilities> = blocks.iter().rev().cloned().collect();
    assert!(map(archive(&backwards), 2) == once);
    // Two archives together, and one from which what is too much was removed.
    let (first, second) = blocks.split_at(blocks.len() / 3);
    let mut merged = archive(second);
    merged.merge(archive(first)).unwrap();
    assert!(map(merged, 2) == once);
    let mut more = archive(&blocks);
    let other: Vec<PlacedVisibilities> = first
        .iter()
        .map(|block| PlacedVisibilities {
            time_s: block.time_s.iter().map(|time_s| time_s + 1.0).collect(),
            ..block.clone()
        })
        .collect();
    for block in &other {
        assert_eq!(more.add(block).unwrap().visibilities, 1);
    }
    for block in &other {
        assert_eq!(more.remove(block).unwrap().visibilities, 1);
    }
    assert!(map(more, 1) == once);
}

#[test]
fn an_iteration_says_how_it_ended() {
    let blocks = data(false);
    let sums = matrix_free(archive(&blocks), PixelMethod::Centre);
    let few = StoppingRule { residual_max: 1e-6, iterations_max: 3 };
    let solve = |prior: Option<&[f64]>, rule, watch: &SolveWatch| {
        solve_matrix_free(&sums, 1e-4, prior, None, rule, watch.named("test"))
    };
    let found = solve(None, few, &SolveWatch::default()).unwrap().0.diagnostics.convergence.unwrap();
    assert!(!found.converged && found.iterations == 3 && found.residual > 1e-6, "{found:?}");
    let found = solve(None, RULE, &SolveWatch::default()).unwrap().0.diagnostics.convergence.unwrap();
    assert!(found.converged && found.residual <= 1e-6, "{found:?}");
    let short = solve(Some(&[0.0; 12]), few, &SolveWatch::default()).unwrap_err();
    assert_eq!(short, SolveError::PriorLength { found: 12, expected: sums.unknowns() });
    let cancel = Cancel::new();
    cancel.cancel();
    let watch = SolveWatch::new(cancel).with_grace(std::time::Duration::ZERO);
    assert_eq!(solve(None, few, &watch).unwrap_err(), SolveError::Interrupted);
    let empty = matrix_free(archive(&[]), PixelMethod::Centre);
    let nothing = solve_matrix_free(&empty, 1e-4, None, None, few, SolveWatch::default().named("test"));
    assert_eq!(nothing.unwrap_err(), SolveError::NoData);
}

#[test]
fn the_key_is_refused_where_it_has_no_effect() {
    let pixels = MapConfig { engine: EngineKind::Pixel, ..MapConfig::default() };
    let matrix_free = MapConfig { matrix: MatrixKind::Free, ..pixels.clone() };
    let problems = |map: &MapConfig| -> Vec<String> {
        let config = Config { map: map.clone(), ..Config::default() };
        config.ground_problems().iter().map(ToString::to_string).collect()
    };
    assert_eq!(problems(&matrix_free), Vec::<String>::new());
    let refine = RefineConfig { visibilities_max: 5, ..RefineConfig::default() };
    let large =
        MapConfig { nside: 256, residual_max: 1e-3, iterations_max: 900, refine, ..matrix_free.clone() };
    assert_eq!(problems(&large), Vec::<String>::new());
    for (config, key) in [
        (MapConfig { engine: EngineKind::Harmonic, ..matrix_free.clone() }, "map.matrix"),
        (MapConfig { trace_probes: 3, ..matrix_free.clone() }, "map.trace_probes"),
        (MapConfig { beams_deg: vec![[0.0, 0.0]], ..matrix_free.clone() }, "map.beams_deg"),
        (MapConfig { nside: 512, ..matrix_free.clone() }, "map.nside"),
        (MapConfig { l_max: 5, ..matrix_free.clone() }, "map.l_max"),
        (
            MapConfig {
                refine: RefineConfig { passes_max: 2, ..RefineConfig::default() },
                ..matrix_free.clone()
            },
            "map.refine",
        ),
        // Without it what only an iteration has is refused, as before.
        (MapConfig { residual_max: 1e-3, ..pixels.clone() }, "map.residual_max"),
        (MapConfig { iterations_max: 9, ..pixels.clone() }, "map.iterations_max"),
        (MapConfig { refine, ..pixels.clone() }, "map.refine"),
        (MapConfig { nside: 128, ..pixels.clone() }, "map.nside"),
    ] {
        let found = problems(&config);
        assert!(found.len() == 1 && found[0].contains(key), "{key}: {found:?}");
    }
}
