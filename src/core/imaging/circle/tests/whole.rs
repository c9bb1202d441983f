//! Tests the whole matrix of orbits whose node has turned little.

use faer::linalg::solvers::DenseSolveCore;
use faer::{Mat, Side};

use super::super::whole::{PowerEquations, WholeSums};
use super::*;
use crate::imaging::solver::dot;
use crate::sky::harmonics::Transform;

const NSIDE: usize = 8;

/// The matrix by products with unit vectors.
fn matrix_of(sums: &HarmonicSums) -> Mat<f64> {
    let count = sums.unknowns();
    let mut matrix = Mat::zeros(count, count);
    for column in 0..count {
        let mut unit = vec![0.0; count];
        unit[column] = 1.0;
        let mut product = vec![0.0; count];
        sums.apply(&unit, &mut product);
        for (row, value) in product.into_iter().enumerate() {
            matrix[(row, column)] += 0.5 * value;
            matrix[(column, row)] += 0.5 * value;
        }
    }
    matrix
}

/// Of 15 orbits within 72 days errors of pixels depend on the longitude, and are those of the dense inverse with the R that was found.
#[test]
fn errors_of_a_short_mission_are_those_of_the_dense_inverse() {
    let sums = engine(&blocks(0, 15)).into_sums();
    assert!(sums.covered_share() < EVEN_SHARE);
    let rule = StoppingRule { residual_max: 1e-6, iterations_max: 300 };
    let request =
        HarmonicRequest { epsilon: 1.0, nside: NSIDE, rule, samples: Samples::default(), probes: 0 };
    let watch = SolveWatch::default();
    let found =
        solve_regularised(&sums, request, &Regulariser::Data, None, None, watch.named("test")).unwrap();
    assert!(!found.diagnostics.errors_may_mislead);
    let errors = found.uncertainty.unwrap();
    let mut matrix = matrix_of(&sums);
    let power_k2 = errors.power.over_noise_k2();
    for (k, l) in degrees(L_MAX).enumerate() {
        matrix[(k, k)] += power_k2[l].recip();
    }
    let covariance = matrix.llt(Side::Lower).unwrap().inverse();
    let transform = Transform::new(NSIDE, L_MAX).unwrap();
    // A ring near the equator.
    let ring: Vec<f64> = (0..4 * NSIDE)
        .map(|k| {
            let pixel = 6 * NSIDE * NSIDE + k;
            let mut point = vec![0.0; 12 * NSIDE * NSIDE];
            // The adjoint includes the area of a pixel.
            point[pixel] = (12 * NSIDE * NSIDE) as f64 / (4.0 * std::f64::consts::PI);
            let at = unknowns(&transform.adjoint(&point).unwrap());
            let column = Mat::from_fn(at.len(), 1, |k, _| at[k]);
            let product = &covariance * &column;
            let product: Vec<f64> = (0..at.len()).map(|k| product[(k, 0)]).collect();
            let expected = errors.power.noise_factor * dot(&at, &product).sqrt();
            // What counts errors of the matrix as noise changes the weakest modes, which R bounds.
            let ratio = errors.sigma_k[pixel] / expected;
            assert!((0.97..1.03).contains(&ratio), "{pixel}: {ratio}");
            expected
        })
        .collect();
    let (least, most) = ring.iter().fold((f64::INFINITY, 0.0_f64), |(a, b), s| (a.min(*s), b.max(*s)));
    // Blocks have one value a ring.
    assert!(most > 1.2 * least, "{least} {most}");
}

/// Beams and noise maps of such a mission are of the equations of its map.
#[test]
fn beams_and_noise_maps_of_a_short_mission_are_of_its_matrix() {
    let mut sums = engine(&blocks(0, 15)).into_sums();
    let rule = StoppingRule { residual_max: 1e-8, iterations_max: 300 };
    let request =
        HarmonicRequest { epsilon: 1.0, nside: NSIDE, rule, samples: Samples::default(), probes: 0 };
    let watch = SolveWatch::default();
    let watch = watch.named("test");
    let found = solve_regularised(&sums, request, &Regulariser::Data, None, None, watch).unwrap();
    let r: Vec<f64> = found.uncertainty.unwrap().power.over_noise_k2().iter().map(|c| c.recip()).collect();
    let rms = |map: &[f64]| (dot(map, map) / map.len() as f64).sqrt();
    let differ = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(a, b)| a - b).collect::<Vec<f64>>();

    sums.noise_realisations = vec![sums.noise_right_hand_side().to_vec()];
    let noises = solve_noises(&sums, request, &Regulariser::Data, watch).unwrap();
    // The power is found anew from the same data, to the tolerance of its rounds at the worst.
    assert!(rms(&differ(&noises[0], &found.noise_k)) < 0.02 * rms(&found.noise_k));

    let equations = PowerEquations::new(&sums, sums.right_hand_side(), None, watch);
    let PowerEquations::Whole(whole) = &equations else { panic!("blocks") };
    let mut regularised = whole.matrix().clone();
    for (k, l) in degrees(L_MAX).enumerate() {
        regularised[(k, k)] += r[l];
    }
    let transform = Transform::new(NSIDE, L_MAX).unwrap();
    let mut point = vec![0.0; 12 * NSIDE * NSIDE];
    point[300] = 1.0;
    let sky = unknowns(&transform.adjoint(&point).unwrap());
    let mut right = vec![0.0; sky.len()];
    whole.apply(&sky, &mut right);
    let column = Mat::from_fn(sky.len(), 1, |k, _| right[k]);
    let solved = regularised.llt(Side::Lower).unwrap().inverse() * column;
    let solved: Vec<f64> = (0..sky.len()).map(|k| solved[(k, 0)]).collect();
    let expected = transform.synthesis(&coefficients(&solved, L_MAX)).unwrap();
    let beams = beams_with_power(&sums, request, r, &[300], watch).unwrap();
    // By iterations to 1e-8 of the residual, and an inverse in f64 with condition numbers below 1e9.
    assert!(rms(&differ(&beams[0].map_k, &expected)) < 1e-5 * rms(&expected));
}

/// Where the node has turned evenly blocks do, and where the map has no time left they have to.
#[test]
fn blocks_serve_an_even_turn_and_maps_without_time() {
    let right = |sums: &HarmonicSums| sums.right_hand_side().to_vec();
    let even = engine(&blocks(0, 100)).into_sums();
    assert!(even.covered_share() > EVEN_SHARE);
    let watch = SolveWatch::default();
    let equations = PowerEquations::new(&even, &right(&even), None, watch.named("test"));
    assert!(matches!(equations, PowerEquations::ByOrder { .. }) && !equations.may_mislead());
    let short = engine(&blocks(0, 15)).into_sums();
    let cancel = Cancel::new();
    cancel.cancel();
    let hurried = SolveWatch::new(cancel).with_grace(Duration::ZERO);
    let equations = PowerEquations::new(&short, &right(&short), None, hurried.named("test"));
    assert!(matches!(equations, PowerEquations::ByOrder { .. }) && equations.may_mislead());
}

/// Errors of the matrix count as noise: nothing negative is left, and what is far above them stays.
#[test]
fn errors_of_the_matrix_count_as_noise() {
    let sums = engine(&blocks(0, 15)).into_sums();
    let mut matrix = matrix_of(&sums);
    let count = matrix.nrows();
    let w_max = matrix.self_adjoint_eigenvalues(Side::Lower).unwrap()[count - 1];
    for k in 0..count {
        matrix[(k, k)] -= 1e-3 * w_max;
    }
    let decomposed = matrix.self_adjoint_eigen(Side::Lower).unwrap();
    let last: Vec<f64> = (0..count).map(|k| decomposed.U()[(k, count - 1)]).collect();
    // A sky of 30 deviations in each unknown, by the variance 1 / w_max.
    let sky: Vec<f64> = last.iter().map(|x| x * 30.0 * (count as f64 / w_max).sqrt()).collect();
    let mut right = vec![0.0; count];
    sums.apply(&sky, &mut right);
    let found = WholeSums::with_matrix(&sums, matrix, &right, None);
    let (a, b) = (found.matrix(), found.right_hand_side());
    let values = a.self_adjoint_eigenvalues(Side::Lower).unwrap();
    assert!(values[0] > -1e-12 * w_max, "{}", values[0] / w_max);
    // eta^2 is at least (1e-3 w_max)^2 30^2 / w_max = 9e-4 w_max: what it leaves of the largest.
    let product = a * Mat::from_fn(count, 1, |k, _| last[k]);
    let largest: f64 = (0..count).map(|k| last[k] * product[(k, 0)]).sum();
    assert!((largest / (w_max * (1.0 - 1e-3) / (1.0 + 9e-4)) - 1.0).abs() < 1e-3, "{}", largest / w_max);
    // The sky is what it was: what was taken of the matrix is 1e-3 of this unknown.
    assert!((dot(&last, b) / largest / dot(&last, &sky) - 1.0).abs() < 2e-3);
}
