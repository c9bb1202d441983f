//! R that a refined map finds from its data.

use std::f64::consts::{PI, TAU};

use lunarray::imaging::anywhere::{RefineRule, RefineSteps, RefinedSums, Refinement, solve_refined};
use lunarray::imaging::circle::{coefficients, degrees};
use lunarray::imaging::{HarmonicRequest, HarmonicSolution, Regulariser, Samples, SolveWatch};
use lunarray::response::general::TimedPair;
use num_complex::Complex64;
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng;
use rand_distr::{Distribution, StandardNormal};

use super::{
    BASELINES_M, L_MAX, MONTH_RAD, NSIDE, WAVELENGTH_M, blocks, dense_solution, difference, geometry_over,
    request, rows, sums, weight,
};

/// Coefficients of a sky of a known power, and their data with noise.
fn noisy_sky(at: &[TimedPair]) -> (Vec<f64>, RefinedSums) {
    let mut stream = ChaCha8Rng::seed_from_u64(11);
    let mut normal = || -> f64 { StandardNormal.sample(&mut stream) };
    let x: Vec<f64> = degrees(L_MAX).map(|l| sky_power(l).sqrt() * normal()).collect();
    let truth = coefficients(&x, L_MAX);
    let rows = rows(WAVELENGTH_M, L_MAX);
    let mut values = rows.forward(&rows.plan(at).unwrap(), &[truth]).remove(0);
    for (value, at) in values.iter_mut().zip(at) {
        *value += Complex64::new(normal(), normal()) / weight(at).sqrt();
    }
    (x, sums(L_MAX, &blocks(at, &values, 1000)))
}

fn sky_power(l: usize) -> f64 {
    1e12 * (l as f64 + 1.0).powf(-2.7)
}

fn solve_with_power(sums: &RefinedSums, passes_max: usize) -> (HarmonicSolution, Refinement) {
    let rule = RefineRule { passes_max, residual_max: 1e-5 };
    let steps = RefineSteps { start: None, save: &mut |_| {} };
    let watch = SolveWatch::default();
    let samples = Samples { count: if passes_max < 30 { 0 } else { 40 }, gibbs: false };
    let request = HarmonicRequest { samples, ..request(NSIDE) };
    solve_refined(sums, request, (rule, &Regulariser::Data), None, steps, watch.named("test")).unwrap()
}

/// The first R is that of the circle. A map that says it has converged has another, however few passes it may take.
#[test]
fn few_passes_leave_no_r_of_the_circle() {
    let at = geometry_over(60e3, 0.2, 150.0, 9, &BASELINES_M, MONTH_RAD);
    let (_, sums) = noisy_sky(&at);
    let (few, refinement) = solve_with_power(&sums, 3);
    eprintln!("{refinement}");
    // Equations of so few unknowns are solved directly in each of two rounds, which counts as a pass: after two of the three, and after the last.
    assert!(refinement.direct && refinement.convergence.iterations == 5, "{refinement}");
    if refinement.convergence.converged {
        let [few, many] =
            [few, solve_with_power(&sums, 29).0].map(|found| found.uncertainty.unwrap().power.power_k2);
        let off = (2..=L_MAX).map(|l| (few[l] / many[l]).ln().abs()).fold(0.0, f64::max);
        // Rounds end where ln C_l changes by less than a tenth: each of the two by as much.
        assert!(off < 0.2, "{off}");
    }
}

/// R from the data: the map is the dense solution with the R that was found, and its C_l that of the sky. Its errors hold where the node turns all
/// round; in a month of orbits far off the circle they do not.
#[test]
fn r_from_the_data_is_found_with_true_rows() {
    for (altitude_m, cross, turn_rad) in [(1e3, 0.02, TAU), (60e3, 0.2, TAU), (60e3, 0.2, MONTH_RAD)] {
        let at = geometry_over(altitude_m, cross, 75.0, 9, &BASELINES_M, turn_rad);
        let (x, sums) = noisy_sky(&at);
        let (found, refinement) = solve_with_power(&sums, 30);
        let errors = found.uncertainty.unwrap();
        let factor = errors.power.noise_factor;
        let r = |l: usize| factor * factor / errors.power.power_k2[l];
        let (dense, inverse) = dense_solution(&sums, L_MAX, &r);
        let off = difference(&found.unknowns[0][1..], &dense[1..]);
        let ln: Vec<f64> = (2..=L_MAX)
            .map(|l| (errors.power.power_k2[l] / sky_power(l)).ln() / errors.power.sigma_ln[l].max(0.2))
            .collect();
        let count = found.map_k.len() as f64;
        let traced: f64 =
            (0..dense.len()).map(|k| inverse[(k, k)]).sum::<f64>() * factor * factor / (4.0 * PI);
        let stated = errors.sigma_k.iter().map(|s| s * s).sum::<f64>() / count;
        let drawn = errors.samples.iter().flat_map(|sample| sample.map_k.iter().zip(&found.map_k));
        let drawn = drawn.map(|(a, b)| (a - b).powi(2)).sum::<f64>() / (40.0 * count);
        let error: f64 =
            found.unknowns[0].iter().zip(&x).map(|(a, b)| (a - b).powi(2)).sum::<f64>() / (4.0 * PI);
        let mean_sigma_k = factor * (inverse[(0, 0)] / (4.0 * PI)).sqrt();
        eprintln!(
            "+-{} km, {cross}, {turn_rad:.1}: off {off:.1e}, noise {factor:.3}, ln C_l {ln:.1?}, variance {traced:.2e}: stated {:.2}, drawn \
             {:.2}, error {:.2}; mean {:.2}; {refinement}",
            altitude_m / 1e3,
            stated / traced,
            drawn / traced,
            error / traced,
            errors.mean_sigma_k / mean_sigma_k,
        );
        assert!(refinement.convergence.converged, "{refinement}");
        // A residual of 1e-5 in the norm of the inverse, which modes that R alone decides multiply.
        assert!(off < 2e-3, "{off}");
        // The power that the sky was drawn from: within four of its errors, or within 0.8 where they are below 0.2, as those of C_l between knots are of
        // a straight line, which this one is not quite, in ln (l + 1).
        assert!(ln.iter().all(|off| off.abs() < 4.0), "{ln:?}");
        if turn_rad == TAU {
            // Of the circle's matrix where it measures what the true one does: a fifth. Samples are of the true matrix: 40 of 169 coefficients.
            assert!(
                (stated / traced - 1.0).abs() < 0.25 && (drawn / traced - 1.0).abs() < 0.1,
                "{stated} {drawn} {traced}"
            );
            assert!((errors.mean_sigma_k / mean_sigma_k - 1.0).abs() < 0.25);
            // Of one sky, which scatters by its few modes that are measured worst.
            assert!((0.5..2.0).contains(&(error / traced)), "{error} {traced}");
        } else {
            // The circle's matrix measures other modes: sigma is three times too small. Samples are solved to a tolerance that its blocks set.
            assert!((0.1..0.2).contains(&(stated / traced)), "{stated} {traced}");
            assert!((0.5..0.75).contains(&(drawn / traced)), "{drawn} {traced}");
        }
    }
}
