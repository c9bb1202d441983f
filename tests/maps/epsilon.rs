//! What epsilon is chosen by, and an R that depends on the degree, against dense matrices of other code.

use crate::common;
use crate::engines::{harmonic_sums, observe, solve_harmonics};
use crate::spectrum::Spectrum;

use std::io::Write;
use std::process::{Command, Stdio};

use lunarray::array::ArrayConfig;
use lunarray::frames::{AntennaResponse, PlacedVisibilities};
use lunarray::imaging::Samples;
use lunarray::imaging::circle::{coefficients, unknowns};
use lunarray::imaging::{
    Fit, HarmonicRequest, PixelExtras, Regulariser, SolveWatch, StoppingRule, Traces, W_MAX_EXACT,
    harmonic_beams, largest_eigenvalue, solve_pixels_with, solve_regularised,
};
use lunarray::imaging::{NormalEngine, NormalSums, PixelEngine, PixelSetup, PixelSums};
use lunarray::response::pixel::PixelMethod;
use lunarray::sky::harmonics::Transform;
use lunarray::sky::healpix::pixel_area_sr;
use lunarray::sky::{Frame, SkyMap};
use lunarray::units::{StreamKind, random_stream};
use num_complex::Complex64;
use rand_distr::{Distribution, StandardNormal};
use serde_json::{Value, json};

const EXTRAS: PixelExtras<'static> = PixelExtras { probes: 1, beams: &[] };
/// Decades, of which the last measure little of the sky.
const EPSILONS: [f64; 5] = [1e-4, 1e-3, 1e-2, 1e-1, 1.0];

/// Visibilities of a sky with structure, with thermal noise of their weights, `signal` times as bright.
fn noisy(frequency_hz: f64, baseline_m_max: f64, count: usize, signal_k: f64) -> Vec<PlacedVisibilities> {
    let mut stream = random_stream(7, StreamKind::Probe, [1, 2]);
    let mut normal = || -> f64 { StandardNormal.sample(&mut stream) };
    let values = (0..12 * 8 * 8).map(|_| signal_k * (1.0 + 0.3 * normal())).collect();
    let sky = SkyMap::new(Frame::Ecliptic, values).unwrap();
    let mut blocks = observe(&sky, frequency_hz, baseline_m_max, count);
    for block in &mut blocks {
        let sigma = block.weight[0].sqrt().recip();
        block.value_k_sr[0] += Complex64::new(normal(), normal()) * sigma;
    }
    blocks
}

fn asked_of(blocks: &[PlacedVisibilities]) -> Value {
    let visibilities: Vec<Value> = blocks
        .iter()
        .map(|block| {
            let (pair, value) = (block.pair, block.value_k_sr[0]);
            json!([pair.i, pair.j, block.time_s[0], block.weight[0], value.re, value.im])
        })
        .collect();
    json!({ "frequency_hz": blocks[0].frequency_hz, "epsilons": EPSILONS, "visibilities": visibilities })
}

fn answer(python: &std::path::Path, asked: &Value) -> Value {
    let script = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/python/epsilon.py");
    let (input, output) = (Stdio::piped(), Stdio::piped());
    let mut child = Command::new(python).arg(script).stdin(input).stdout(output).spawn().unwrap();
    child.stdin.take().unwrap().write_all(asked.to_string().as_bytes()).unwrap();
    serde_json::from_slice(&child.wait_with_output().unwrap().stdout).unwrap()
}

/// Whether fit and trace are the reference's but for their stated errors, and for `rounding` of the residual.
fn check(fit: &Fit, traces: &Traces, expected: &Value, rounding: f64) {
    let number = |key: &str| expected[key].as_f64().unwrap();
    let (residual, measured) = (fit.residual, traces.measured);
    println!(
        "residual {:.6e} +- {:.1e}, expected {:.6e}; Tr H {:.4} +- {:.1e}, expected {:.4}",
        residual.value,
        residual.error,
        number("residual"),
        measured.value,
        measured.error,
        number("measured")
    );
    let error = residual.error + rounding;
    assert!((residual.value - number("residual")).abs() <= error, "{residual:?} {expected}");
    // Sums of some hundred terms of order one in f64.
    let trace_error = measured.error + 1e-10;
    assert!((measured.value - number("measured")).abs() <= trace_error, "{measured:?} {expected}");
    let risk = residual.value + 2.0 * measured.value - fit.numbers as f64;
    assert!((risk - number("risk")).abs() <= error + 2.0 * trace_error, "{risk} {expected}");
    let left = fit.numbers as f64 - measured.value;
    let score = fit.numbers as f64 * residual.value / (left * left);
    let relative = error / residual.value + 2.0 * trace_error / left;
    assert!((score / number("cross_validation") - 1.0).abs() <= 1.1 * relative, "{score} {expected}");
}

fn pixel_sums(blocks: &[PlacedVisibilities], nside: usize) -> PixelSums {
    let setup = PixelSetup {
        nside,
        frequency_hz: blocks[0].frequency_hz,
        method: PixelMethod::Centre,
        moon_radius_m: ArrayConfig::default().moon_radius_m,
        response: AntennaResponse::Isotropic,
        companion_seed: 1,
        weight_max: 1e-7,
    };
    let mut engine = PixelEngine::new(setup).unwrap();
    for block in blocks {
        assert_eq!(engine.add(block).unwrap().visibilities, 1);
    }
    engine.into_sums()
}

#[test]
#[ignore = "needs LUNARRAY_PYTHON"]
fn the_fit_of_pixels_is_that_of_dense_rows() {
    let python = common::python();
    // Fainter than the noise, and a hundred times as bright.
    for signal_k in [2e3, 2e6] {
        let blocks = noisy(3e6, 1_500.0, 1_200, signal_k);
        let mut asked = asked_of(&blocks);
        asked["nside"] = json!(4);
        let expected = answer(&python, &asked);
        let sums = pixel_sums(&blocks, 4);
        let power = expected["data_power"].as_f64().unwrap();
        // Each square is rounded to 2^-48.
        assert!((sums.counts().power / power - 1.0).abs() < 1e-12, "{} {power}", sums.counts().power);
        for (epsilon, expected) in EPSILONS.iter().zip(expected["epsilons"].as_array().unwrap()) {
            let watch = SolveWatch::default();
            let solved =
                solve_pixels_with(sums.clone(), *epsilon, None, EXTRAS, watch.named("test")).unwrap();
            let (fit, traces) = (solved.diagnostics.fit.unwrap(), solved.diagnostics.traces.unwrap());
            // Elements of rows are rounded to 2^-28, and what that adds to the predictions meets the residual: below 1e-7 of both.
            check(&fit, &traces, expected, 1e-7 * (fit.residual.value * power).sqrt());
            let square = expected["solution_k2"].as_f64().unwrap();
            assert!((fit.solution_k2 / square - 1.0).abs() < 1e-5, "{} {square}", fit.solution_k2);
        }
        // With a prior the residual is that of the whole map: of the solution itself it is the same map again.
        let watch = SolveWatch::default();
        let first = solve_pixels_with(sums.clone(), 1e-4, None, EXTRAS, watch.named("test")).unwrap();
        let again =
            solve_pixels_with(sums.clone(), 1e9, Some(&first.map_k), EXTRAS, watch.named("test")).unwrap();
        let residuals = [&first, &again].map(|solved| solved.diagnostics.fit.unwrap().residual.value);
        // An epsilon of 1e9 leaves the prior as it is to 1e-9.
        assert!((residuals[0] - residuals[1]).abs() < 1e-6 * power, "{residuals:?}");
    }
}

/// Their residual is known to the accuracy of the engine's matrix, and says so; an R of the degree gives the map of least squares.
#[test]
#[ignore = "needs LUNARRAY_PYTHON"]
fn fit_and_regulariser_of_harmonics_are_those_of_dense_rows() {
    let python = common::python();
    const L_MAX: usize = 12;
    let blocks = noisy(3e6, 300.0, 900, 2e4);
    let sums = harmonic_sums(&blocks, L_MAX, 300.0);
    let rule = StoppingRule { residual_max: 1e-7, iterations_max: 500 };
    let request = |epsilon: f64, probes: usize| HarmonicRequest {
        epsilon,
        nside: 8,
        rule,
        samples: Samples::default(),
        probes,
    };
    let watch = SolveWatch::default();
    let plain = solve_harmonics(&sums, request(1e-3, 0), None, None, watch.named("test")).unwrap();
    let level = 1e-3 * plain.diagnostics.w_max.unwrap() / pixel_area_sr(8);
    let r_of_degree: Vec<f64> = (0..=L_MAX).map(|l| level * ((l + 1) as f64).powf(2.5)).collect();
    let power_k2: Vec<f64> = r_of_degree.iter().map(|r| 1e-3 / r).collect();
    let mut asked = asked_of(&blocks);
    (asked["l_max"], asked["map_nside"], asked["r_of_degree"]) = (json!(L_MAX), json!(8), json!(r_of_degree));
    let answer = answer(&python, &asked);
    for (epsilon, expected) in EPSILONS.into_iter().zip(answer["epsilons"].as_array().unwrap()) {
        let solved = solve_harmonics(&sums, request(epsilon, 1), None, None, watch.named("test")).unwrap();
        let (fit, traces) = (solved.diagnostics.fit.unwrap(), solved.diagnostics.traces.unwrap());
        check(&fit, &traces, expected, 0.0);
        // Known well enough to tell something: the error is a small part of the residual here.
        assert!(fit.residual.error < 0.02 * fit.residual.value, "{fit:?}");
    }
    let unknowns = answer["unknowns"].as_array().unwrap();
    let expected: Vec<f64> = unknowns.iter().map(|x| x.as_f64().unwrap()).collect();
    for regulariser in [Regulariser::Power(2.5), Regulariser::Wiener(power_k2)] {
        let solved =
            solve_regularised(&sums, request(1e-3, 0), &regulariser, None, None, watch.named("test"))
                .unwrap();
        let apart = apart(&solved.unknowns[0], &expected);
        println!("apart by {apart:e}");
        // The accuracy of the engine's eigenvalues, 2e-3, of a map that is measured well.
        assert!(apart < 2e-3, "{apart:e}");
        assert!(solved.diagnostics.convergence.unwrap().converged);
    }
    // Another R gives another map.
    assert!(apart(&plain.unknowns[0], &expected) > 2e-2);
}

/// Beams solved for are columns of what a dense decomposition gives.
#[test]
fn beams_of_points_are_columns_of_the_effective_beam() {
    let blocks = noisy(3e6, 1_500.0, 900, 2e4);
    let (pixel, epsilon) = (77, 1e-2);
    let sums = pixel_sums(&blocks, 4);
    let spectrum = Spectrum::new(&sums);
    let eps = epsilon * spectrum.w_max();
    let mut point = vec![0.0; 192];
    point[pixel] = 1.0;
    let expected = spectrum.apply(|w| w / (w + eps), &point);
    let watch = SolveWatch::default();
    let extras = PixelExtras { probes: 0, beams: &[pixel] };
    let solved = solve_pixels_with(sums.clone(), epsilon, None, extras, watch.named("test")).unwrap();
    // A condition of 1e2 in f64, and W_max to 1e-10.
    assert!(apart(&solved.beams[0].map_k, &expected) < 1e-8);
    let none = PixelExtras { probes: 0, beams: &[192] };
    assert!(solve_pixels_with(sums, epsilon, None, none, watch.named("test")).is_err());
    // Harmonics: of a point up to the map's degree.
    let sums = harmonic_sums(&blocks, 12, 1_500.0);
    let rule = StoppingRule { residual_max: 1e-7, iterations_max: 500 };
    let request = HarmonicRequest { epsilon, nside: 8, rule, samples: Samples::default(), probes: 0 };
    let w_max = largest_eigenvalue(&sums, W_MAX_EXACT, &mut |_, _| true).value;
    let with = (&Regulariser::default(), w_max);
    let found = harmonic_beams(&sums, request, with, &[300], watch.named("test")).unwrap();
    let transform = Transform::new(8, 12).unwrap();
    let mut point = vec![0.0; 768];
    point[300] = 1.0;
    let point = unknowns(&transform.adjoint(&point).unwrap());
    let beam = Spectrum::new(&sums).apply(|w| w / (w + epsilon * w_max), &point);
    let expected = transform.synthesis(&coefficients(&beam, 12)).unwrap();
    // Products are in f32.
    assert!(apart(&found[0].map_k, &expected) < 1e-3, "{}", apart(&found[0].map_k, &expected));
}

fn apart(found: &[f64], expected: &[f64]) -> f64 {
    let square: f64 = found.iter().zip(expected).map(|(a, b)| (a - b).powi(2)).sum();
    (square / expected.iter().map(|b| b * b).sum::<f64>()).sqrt()
}
