//! Normal equations, solutions and traces against values computed by independent code.

use crate::common;
use crate::spectrum::Spectrum;

use lunarray::array::{Array, ArrayConfig};
use lunarray::frames::{AntennaResponse, PlacedVisibilities};
use lunarray::imaging::{NormalEngine, NormalSums, PixelEngine, PixelSetup, PixelSums};
use lunarray::imaging::{SolveWatch, W_MAX_EXACT, largest_eigenvalue, solve_pixels, traces};
use lunarray::response::pixel::PixelMethod;
use lunarray::units::Pair;
use num_complex::Complex64;
use serde_json::Value;

/// Required agreement: both sides sum 800 products of exact rows in f64, and solve systems whose
/// condition number is at most 1e6.
const TOLERANCE: f64 = 1e-8;

fn number(value: &Value) -> f64 {
    value.as_f64().unwrap()
}

fn numbers(value: &Value) -> Vec<f64> {
    value.as_array().unwrap().iter().map(number).collect()
}

/// Greatest difference over greatest value.
fn difference(found: &[f64], expected: &[f64]) -> f64 {
    assert_eq!(found.len(), expected.len());
    let scale = expected.iter().fold(0.0_f64, |max, x| max.max(x.abs()));
    found.iter().zip(expected).fold(0.0_f64, |max, (x, y)| max.max((x - y).abs())) / scale
}

/// The reference's visibilities, one a block, and the setup of their sums.
pub fn data(reference: &Value) -> (Vec<PlacedVisibilities>, PixelSetup) {
    let array = Array::new(&ArrayConfig::default()).unwrap();
    let frequency_hz = number(&reference["nu_hz"]);
    let setup = PixelSetup {
        nside: 4,
        frequency_hz,
        method: PixelMethod::AverageExact,
        moon_radius_m: array.moon_radius_m(),
        response: AntennaResponse::Isotropic,
        companion_seed: 1,
        // A little above the data's. The automatic one resolves sums to 1e-11 here, the solution at 1e-4 to 2e-8.
        weight_max: 3e-9,
    };
    let block = |data: &Value| {
        let time_s = number(&data["t_s"]);
        let index = |key: &str| data[key].as_u64().unwrap() as usize;
        let pair = Pair::from_one_based(index("i"), index("j")).unwrap();
        let sigma = number(&data["sigma_k_sr"]);
        PlacedVisibilities {
            frequency_hz,
            pair,
            time_s: vec![time_s],
            r_i_m: vec![array.position_m(pair.i.into(), time_s)],
            r_j_m: vec![array.position_m(pair.j.into(), time_s)],
            value_k_sr: vec![Complex64::new(number(&data["re"]), number(&data["im"]))],
            weight: vec![sigma.powi(-2)],
            ..PlacedVisibilities::default()
        }
    };
    (reference["data"].as_array().unwrap().iter().map(block).collect(), setup)
}

pub fn sums(reference: &Value) -> PixelSums {
    let (blocks, setup) = data(reference);
    let mut engine = PixelEngine::new(setup).unwrap();
    for block in &blocks {
        assert_eq!(engine.add(block).unwrap().visibilities, 1);
    }
    engine.into_sums()
}

#[test]
#[ignore = "needs LUNARRAY_SHARED"]
fn sums_solutions_and_traces_agree() {
    let path = common::shared("reference/tikhonov_nside4.json");
    let reference: Value = serde_json::from_str(&std::fs::read_to_string(path).unwrap()).unwrap();
    let sums = sums(&reference);
    assert!(difference(&sums.normal.diagonal(), &numbers(&reference["normal_diagonal"])) < TOLERANCE);
    assert!(difference(sums.right_hand_side(), &numbers(&reference["dirty_map"])) < TOLERANCE);
    let w_max = number(&reference["w_max"]);
    assert!((largest_eigenvalue(&sums, W_MAX_EXACT, &mut |_, _| true).value / w_max - 1.0).abs() < TOLERANCE);
    let spectrum = Spectrum::new(&sums);
    assert!(difference(&spectrum.eigenvalues, &numbers(&reference["eigenvalues"])) < TOLERANCE);
    let solutions = reference["solutions"].as_object().unwrap();
    assert_eq!(solutions.len(), 3);
    for (epsilon, expected) in solutions {
        let epsilon: f64 = epsilon.parse().unwrap();
        let map = solve_pixels(sums.clone(), epsilon, None).unwrap().map_k;
        assert!(difference(&map, &numbers(&expected["map_k"])) < TOLERANCE, "epsilon {epsilon}");
        let prior = vec![3e5; 192];
        let map = solve_pixels(sums.clone(), epsilon, Some(&prior)).unwrap().map_k;
        let with_prior = numbers(&expected["map_flat_prior_3e5_k"]);
        assert!(difference(&map, &with_prior) < TOLERANCE, "epsilon {epsilon}, prior");
        let found = traces(&sums, epsilon, w_max, 1, SolveWatch::default().named("test")).unwrap().unwrap();
        let traces = [
            (found.sigma_n_k2.value, number(&expected["trace_sigma_n"])),
            (found.sigma_s.value, number(&expected["trace_sigma_s"])),
        ];
        for (found, expected) in traces {
            assert!((found / expected - 1.0).abs() < TOLERANCE, "epsilon {epsilon}: {found} {expected}");
        }
    }
}
