//! Tests of the bodies that are solved for beside a map: against dense algebra with rows from the forward model, and against the truth.
#![allow(clippy::print_stdout)] // The tests print what they measured.

use faer::linalg::solvers::{DenseSolveCore, Solve};
use faer::{Mat, Side};

use super::gain_errors::{DEGREE, LOW_HZ, geometry, low_setup, normals, observed, sky};
use super::*;
use crate::array::{jupiter_hat_by_date, sun_hat_by_date};
use crate::imaging::SolveError;
use crate::sky::{Body, k_sr_per_jy};
use crate::units::vector::{Vec3, add, dot as product, scale};

const EPOCH_TAI_S: f64 = 2.2e9;
const NSIDE: usize = 8;
const NOISE_K_SR: f64 = 3e3;
/// Powers of the Sun and Jupiter, K sr: as much as a tenth of the sky's visibilities, and a third of that.
const POWERS_K_SR: [f64; 2] = [1e5, 3e4];
const BODIES: [Body; 2] = [Body::Sun, Body::Jupiter];

fn setup_of_noise() -> HarmonicSetup {
    // As by default, 1024 times the expected weights.
    HarmonicSetup { weight_max: 1024.0 * NOISE_K_SR.powi(-2), ..low_setup() }
}

/// Visibility of a body of 1 K sr, by its definition: the Moon hides it if the ray towards it passes within the Moon's radius of the centre.
fn seen(body: Body, block: &PlacedVisibilities, k: usize) -> Complex64 {
    let hat = match body {
        Body::Sun => sun_hat_by_date(EPOCH_TAI_S, block.time_s[k]),
        Body::Jupiter => jupiter_hat_by_date(EPOCH_TAI_S, block.time_s[k]),
    };
    let is_hidden = |r_m: Vec3| {
        let along_m = product(r_m, hat);
        along_m < 0.0 && norm(add(r_m, scale(-along_m, hat))) < MOON_RADIUS_M
    };
    if [block.r_i_m[k], block.r_j_m[k]].into_iter().any(is_hidden) {
        return Complex64::ZERO;
    }
    let turns = product(sub(block.r_i_m[k], block.r_j_m[k]), hat) * LOW_HZ / SPEED_OF_LIGHT_M_S;
    Complex64::cis(-std::f64::consts::TAU * turns)
}

fn month(time_s: f64) -> usize {
    (time_s / (30.0 * 86_400.0)) as usize
}

/// Columns of the bodies by month, the visibilities of one after another.
fn columns(blocks: &[PlacedVisibilities]) -> Vec<Vec<Complex64>> {
    let times: Vec<(&PlacedVisibilities, usize)> =
        blocks.iter().flat_map(|block| (0..block.len()).map(move |k| (block, k))).collect();
    let months = times.iter().map(|(block, k)| month(block.time_s[*k])).max().unwrap() + 1;
    let column = |number: usize| {
        let (of_month, body) = (number / 2, BODIES[number % 2]);
        let value = |(block, k): &(&PlacedVisibilities, usize)| match month(block.time_s[*k]) == of_month {
            true => seen(body, block, *k),
            false => Complex64::ZERO,
        };
        times.iter().map(value).collect()
    };
    (0..2 * months).map(column).collect()
}

/// Visibilities of a sky with the bodies and noise.
fn simulated(seed: u64, blocks: &[PlacedVisibilities], columns: &[Vec<Complex64>]) -> Vec<Complex64> {
    let mut values = observed(&sky(seed), blocks);
    let noise = normals(seed, 5, 2 * values.len());
    for (k, value) in values.iter_mut().enumerate() {
        *value += NOISE_K_SR * Complex64::new(noise[2 * k], noise[2 * k + 1]);
        *value +=
            columns.iter().enumerate().map(|(n, column)| POWERS_K_SR[n % 2] * column[k]).sum::<Complex64>();
    }
    values
}

fn with_values(blocks: &[PlacedVisibilities], values: &[Complex64]) -> Vec<PlacedVisibilities> {
    let (mut blocks, mut values) = (blocks.to_vec(), values.iter());
    for block in &mut blocks {
        block.value_k_sr.iter_mut().zip(&mut values).for_each(|(to, from)| *to = *from);
    }
    blocks
}

fn summed(blocks: &[PlacedVisibilities], removed: &[PlacedVisibilities]) -> HarmonicSums {
    let mut engine = HarmonicEngine::new(setup_of_noise()).unwrap();
    let mut movers = MoverSums::new(&engine, &BODIES, EPOCH_TAI_S);
    for block in removed.iter().chain(blocks) {
        assert_eq!(engine.add(block).unwrap().visibilities, block.len() as u64);
        movers.add(&engine, block);
    }
    for block in removed {
        movers.remove(&engine, block);
        assert_eq!(engine.remove(block).unwrap().visibilities, block.len() as u64);
    }
    engine.into_sums().with_movers(movers)
}

fn solved(
    sums: &mut HarmonicSums,
    (epsilon, regulariser): (f64, &Regulariser),
    prior_k: Option<&[f64]>,
) -> Result<(MoverFluxes, HarmonicSolution), SolveError> {
    let rule = StoppingRule { residual_max: 1e-6, iterations_max: 2000 };
    let request = HarmonicRequest { epsilon, nside: NSIDE, rule, samples: Samples::default(), probes: 0 };
    let watch = SolveWatch::default();
    let watch = watch.named("test");
    let fluxes = sums.take_movers(request, regulariser, prior_k, watch)?.unwrap();
    Ok((fluxes, solve_regularised(sums, request, regulariser, prior_k, None, watch)?))
}

/// Fluxes, errors and unknowns by least squares for all at once, with the rows of the forward model.
struct Dense {
    powers: Vec<f64>,
    sigma: Vec<f64>,
    unknowns: Vec<f64>,
}

fn dense(
    blocks: &[PlacedVisibilities],
    values: &[Complex64],
    columns: &[Vec<Complex64>],
    epsilon: f64,
) -> Dense {
    let unknowns = (DEGREE + 1).pow(2);
    let row_of = |k: usize| {
        let mut one = vec![0.0; unknowns];
        one[k] = 1.0;
        observed(&one, blocks)
    };
    let sky_columns: Vec<Vec<Complex64>> = (0..unknowns).map(row_of).collect();
    let all: Vec<&Vec<Complex64>> = sky_columns.iter().chain(columns).collect();
    let form = |a: &[Complex64], b: &[Complex64]| {
        a.iter().zip(b).map(|(a, b)| (a.conj() * b).re).sum::<f64>() / NOISE_K_SR.powi(2)
    };
    let order = all.len();
    let mut matrix = Mat::from_fn(order, order, |a, b| form(all[a], all[b]));
    let sky_alone = matrix.submatrix(0, 0, unknowns, unknowns).to_owned();
    let w_max = *sky_alone.self_adjoint_eigenvalues(Side::Lower).unwrap().last().unwrap();
    (0..unknowns).for_each(|k| matrix[(k, k)] += epsilon * w_max);
    let right = Mat::from_fn(order, 1, |k, _| form(all[k], values));
    let factor = matrix.llt(Side::Lower).unwrap();
    let (found, inverse) = (factor.solve(&right), factor.inverse());
    let found: Vec<f64> = (0..order).map(|k| found[(k, 0)]).collect();
    // The covariance of the estimate for noise, and a sky of the power of the map: the block of the inverse is that for the power of R.
    let power = found[..unknowns].iter().map(|x| x * x).sum::<f64>() * epsilon * w_max / unknowns as f64;
    let sigma = |k: usize| {
        let by_sky: f64 = (0..unknowns).map(|l| inverse[(k, l)].powi(2)).sum::<f64>() * epsilon * w_max;
        (inverse[(k, k)] + (power.max(1.0) - 1.0) * by_sky).sqrt()
    };
    Dense {
        powers: found[unknowns..].to_vec(),
        sigma: (unknowns..order).map(sigma).collect(),
        unknowns: found[..unknowns].to_vec(),
    }
}

#[test]
fn fluxes_errors_and_map_are_those_of_dense_least_squares() {
    const EPSILON: f64 = 1e-4;
    let blocks = geometry();
    let columns = columns(&blocks);
    let values = simulated(3, &blocks, &columns);
    let expected = dense(&blocks, &values, &columns, EPSILON);
    let placed = with_values(&blocks, &values);
    let (found, map) = solved(&mut summed(&placed, &[]), (EPSILON, &Regulariser::default()), None).unwrap();
    assert_eq!(found.fluxes.len(), columns.len());
    let k_sr = k_sr_per_jy(LOW_HZ);
    for (k, flux) in found.fluxes.iter().enumerate() {
        assert_eq!((flux.mover, flux.month_start_s), (BODIES[k % 2], 2_592_000.0 * (k / 2) as f64));
        let [power, sigma] = [flux.flux_jy, flux.sigma_jy].map(|jy| k_sr * jy.unwrap());
        println!(
            "{:?} {power:.0} {:.0} +- {sigma:.0} {:.0}",
            flux.mover, expected.powers[k], expected.sigma[k]
        );
        // Rows by interpolation err by up to 4e-4 of the sky's visibilities, some 1e6 K sr, which are 400 K sr; and errors by twice that share.
        assert!((power - expected.powers[k]).abs() < 400.0, "{k}: {power} {}", expected.powers[k]);
        assert!((sigma / expected.sigma[k] - 1.0).abs() < 0.01, "{k}: {sigma} {}", expected.sigma[k]);
    }
    let difference = |x: &[f64]| {
        let squares = x.iter().zip(&expected.unknowns).map(|(a, b)| (a - b).powi(2));
        (squares.sum::<f64>() / dot(&expected.unknowns, &expected.unknowns)).sqrt()
    };
    let (mut without, rule) =
        (summed(&placed, &[]), StoppingRule { residual_max: 1e-6, iterations_max: 2000 });
    without.movers = None;
    let request =
        HarmonicRequest { epsilon: EPSILON, nside: NSIDE, rule, samples: Samples::default(), probes: 0 };
    let watch = SolveWatch::default();
    let left = solve_regularised(&without, request, &Regulariser::default(), None, None, watch.named("test"))
        .unwrap();
    let [solved, left] = [difference(&map.unknowns[0]), difference(&left.unknowns[0])];
    println!("map: {solved:.1e}, without the bodies in the equations {left:.1e}");
    assert!(solved < 2e-3 && left > 1e-2, "{solved} {left}");
}

/// With R from the data, fluxes are within their errors of the truth, and those of the noise-only map scatter by less.
#[test]
fn fluxes_are_within_their_errors_of_the_truth() {
    let blocks = geometry();
    let columns = columns(&blocks);
    let (mut squares, mut count) = (0.0, 0.0);
    for seed in 0..8 {
        let placed = with_values(&blocks, &simulated(seed, &blocks, &columns));
        let (found, _) = solved(&mut summed(&placed, &[]), (1.0, &Regulariser::Data), None).unwrap();
        for (k, flux) in found.fluxes.iter().enumerate() {
            let [power, sigma] = [flux.flux_jy, flux.sigma_jy].map(|jy| k_sr_per_jy(LOW_HZ) * jy.unwrap());
            squares += ((power - POWERS_K_SR[k % 2]) / sigma).powi(2);
            count += 1.0;
        }
    }
    println!("mean square of (flux - truth) / error: {:.2} of {count}", squares / count);
    // The mean of 80 squares is known to sqrt(2 / 80) = 0.16, if the months of a sky are independent: three of that.
    assert!((0.5..1.5).contains(&(squares / count)), "{}", squares / count);
}

/// A prior of the sky changes no more than R does.
#[test]
fn a_prior_is_no_flux() {
    let blocks = geometry();
    let columns = columns(&blocks);
    let placed = with_values(&blocks, &simulated(4, &blocks, &columns));
    let prior_k = vec![2.5e5; crate::sky::healpix::pixel_count(NSIDE)];
    let given = (1e-9, &Regulariser::default());
    let [plain, with_prior] = [None, Some(prior_k.as_slice())]
        .map(|prior_k| solved(&mut summed(&placed, &[]), given, prior_k).unwrap().0);
    for (plain, with_prior) in plain.fluxes.iter().zip(&with_prior.fluxes) {
        let [a, b] = [plain, with_prior].map(|flux| flux.flux_jy.unwrap());
        assert!((a - b).abs() < 0.05 * plain.sigma_jy.unwrap(), "{a} {b}");
    }
}

#[test]
fn what_is_removed_leaves_nothing_in_any_order() {
    let blocks = geometry();
    let columns = columns(&blocks);
    let placed = with_values(&blocks, &simulated(1, &blocks, &columns));
    let (gone, kept) = placed.split_at(placed.len() / 3);
    let movers = |blocks: &[PlacedVisibilities], removed: &[PlacedVisibilities]| {
        let sums = summed(blocks, removed).movers.unwrap();
        (sums.columns, sums.right, sums.products, sums.data, sums.noise)
    };
    let mut reversed = kept.to_vec();
    reversed.reverse();
    let alone = movers(kept, &[]);
    assert!(alone.0.len() > 4 && alone == movers(kept, gone) && alone == movers(&reversed, &[]));
}
