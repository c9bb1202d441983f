//! Tests of the errors by gains: against dense algebra with rows from the forward model, and against the truth of simulated errors.
#![allow(clippy::print_stdout)] // The tests print what they measured.

use faer::linalg::solvers::Solve;
use faer::{Mat, Side};
use rand_distr::{Distribution, StandardNormal};

use super::*;
use crate::calibration::{AntennaGains, Calibration, ChannelGains};
use crate::calibration::{GainErrors, GainSolution, GainsFile, Interpolation};
use crate::ranks::on_threads;
use crate::units::{StreamKind, random_stream};

const SATELLITES: usize = 8;
/// Baselines up to 1.1 wavelengths, which see up to l = 7.
pub(super) const LOW_HZ: f64 = 0.25e6;
pub(super) const DEGREE: usize = 8;
const PASSES: usize = 30;
const TIMES: usize = 14;
const NSIDE: usize = 8;
/// Far below the errors of 8 % that gains make: V is some 1e6 K sr.
const NOISE_K_SR: f64 = 3e3;
/// Standard deviations of ln amplitude and phase, rad. The second order is below a tenth of the first.
const SIGMA: [f64; 2] = [0.04, 0.07];

pub(super) fn low_setup() -> HarmonicSetup {
    HarmonicSetup { l_max: DEGREE, frequency_hz: LOW_HZ, baseline_m_max: 1_300.0, weight_max: 1.0, ..setup() }
}

fn start_s(pass: usize) -> f64 {
    409_193.7 * pass as f64
}

/// Positions of all pairs with short baselines in all passes; no data yet.
pub(super) fn geometry() -> Vec<PlacedVisibilities> {
    let array = Array::new(&ArrayConfig::default()).unwrap();
    let mut blocks = Vec::new();
    for pass in 0..PASSES {
        for pair in all_pairs(SATELLITES) {
            let mut placed =
                PlacedVisibilities { frequency_hz: LOW_HZ, pair, ..PlacedVisibilities::default() };
            for n in 0..TIMES {
                let time_s = start_s(pass) + 260.0 * n as f64;
                let [r_i_m, r_j_m] = [pair.i, pair.j].map(|n| array.position_m(usize::from(n), time_s));
                if norm(sub(r_i_m, r_j_m)) < 1_300.0 {
                    placed.time_s.push(time_s);
                    placed.r_i_m.push(r_i_m);
                    placed.r_j_m.push(r_j_m);
                    placed.value_k_sr.push(Complex64::ZERO);
                    placed.weight.push(NOISE_K_SR.powi(-2));
                }
            }
            if !placed.is_empty() {
                blocks.push(placed);
            }
        }
    }
    blocks
}

/// Visibilities of a sky by the forward model, which has rows of its own.
pub(super) fn observed(unknowns: &[f64], blocks: &[PlacedVisibilities]) -> Vec<Complex64> {
    let setup = low_setup();
    let wavelength_m = setup.wavelength_m();
    let geometry = PatternGeometry {
        orbit_radius_m: setup.orbit.radius_m,
        moon_radius_m: setup.moon_radius_m,
        wavelength_m,
        response: setup.response,
    };
    let settings = ModelSettings::new(geometry, setup.orbit.inclination_rad, 1.2);
    let mut model = HarmonicModel::new(coefficients(unknowns, DEGREE), settings).unwrap();
    let states: Vec<PairState> = blocks
        .iter()
        .flat_map(|block| block.r_i_m.iter().zip(&block.r_j_m))
        .map(|(&r_i, &r_j)| {
            setup.orbit.pair(&PairOrientation::of_pair(r_i, r_j).unwrap(), wavelength_m).unwrap().state
        })
        .collect();
    let mut values = vec![Complex64::ZERO; states.len()];
    model.visibilities(&states, &mut values).unwrap();
    values
}

pub(super) fn normals(seed: u64, which: u64, count: usize) -> Vec<f64> {
    let mut stream = random_stream(seed, StreamKind::Instrument, [which, 43]);
    (0..count).map(|_| StandardNormal.sample(&mut stream)).collect()
}

/// A sky of 3e5 K with structure that falls with the degree.
pub(super) fn sky(seed: u64) -> Vec<f64> {
    let mut sky = normals(seed, 0, (DEGREE + 1).pow(2));
    sky.iter_mut().zip(degrees(DEGREE)).for_each(|(x, l)| *x *= 1e5 * ((l + 1) as f64).powf(-1.3));
    sky[0] = 1e6;
    sky
}

/// Gains of one in every pass, with stated errors.
fn gains(draws: usize, seed: u64) -> AntennaGains {
    let entry = |pass: usize, time_s: f64| GainSolution {
        time_s,
        gains: vec![[1.0, 0.0]; SATELLITES],
        errors: Some(GainErrors {
            solution_s: start_s(pass),
            sigma: vec![SIGMA; SATELLITES],
            correlations: Vec::new(),
        }),
    };
    let solutions =
        (0..PASSES).flat_map(|pass| [0.0, 1e4].map(|after_s| entry(pass, start_s(pass) + after_s)));
    let file = GainsFile {
        interpolation: Interpolation::LogLinear,
        frequency_tolerance_hz: 1.0,
        channels: vec![ChannelGains { frequency_hz: LOW_HZ, solutions: solutions.collect() }],
        positions: Vec::new(),
    };
    AntennaGains::new(&file).unwrap().with_error_draws(&file, draws, seed)
}

/// The blocks with these values, calibrated.
fn calibrated(
    blocks: &[PlacedVisibilities],
    values: &[Complex64],
    gains: &AntennaGains,
) -> Vec<PlacedVisibilities> {
    let (mut blocks, mut values, mut gains) = (blocks.to_vec(), values.iter(), gains.clone());
    for block in &mut blocks {
        block.value_k_sr.iter_mut().zip(&mut values).for_each(|(to, from)| *to = *from);
        assert_eq!(gains.apply(block).unwrap().unusable_gain, 0);
    }
    blocks
}

fn low_engine(blocks: &[PlacedVisibilities]) -> HarmonicEngine {
    let mut engine = HarmonicEngine::new(low_setup()).unwrap();
    for block in blocks {
        assert_eq!(engine.add(block).unwrap().visibilities, block.len() as u64);
    }
    engine
}

fn solved(sums: &HarmonicSums, samples: Samples) -> HarmonicSolution {
    let rule = StoppingRule { residual_max: 1e-4, iterations_max: 300 };
    let request = HarmonicRequest { epsilon: 1.0, nside: NSIDE, rule, samples, probes: 0 };
    solve_regularised(sums, request, &Regulariser::Data, None, None, SolveWatch::default().named("test"))
        .unwrap()
}

/// Values with errors of gains, another for each pass and satellite, and noise.
fn with_errors(seed: u64, blocks: &[PlacedVisibilities], values: &[Complex64]) -> Vec<Complex64> {
    let errors = normals(seed, 1, 2 * SATELLITES * PASSES);
    let gain = |pass: usize, n: u8| {
        let at = 2 * (SATELLITES * pass + usize::from(n));
        Complex64::new(SIGMA[0] * errors[at], SIGMA[1] * errors[at + 1]).exp()
    };
    let noise = normals(seed, 2, 2 * values.len());
    let mut places = blocks.iter().flat_map(|block| block.time_s.iter().map(|time_s| (block.pair, *time_s)));
    let of = |(k, value): (usize, &Complex64)| {
        let (pair, time_s) = places.next().unwrap();
        let pass = (time_s / start_s(1)) as usize;
        gain(pass, pair.i) * gain(pass, pair.j).conj() * value
            + NOISE_K_SR * Complex64::new(noise[2 * k], noise[2 * k + 1])
    };
    values.iter().enumerate().map(of).collect()
}

/// Rows of B by the forward model, real and imaginary part of each visibility after another, times the square root of the weight.
fn dense_rows(blocks: &[PlacedVisibilities]) -> Mat<f64> {
    let count = (DEGREE + 1).pow(2);
    let columns: Vec<Vec<Complex64>> = (0..count)
        .map(|k| {
            let mut unit = vec![0.0; count];
            unit[k] = 1.0;
            observed(&unit, blocks)
        })
        .collect();
    Mat::from_fn(2 * columns[0].len(), count, |row, column| {
        let value = columns[column][row / 2];
        (if row % 2 == 0 { value.re } else { value.im }) / NOISE_K_SR
    })
}

/// Errors of the data by one standard deviation of each gain of each pass: amplitude and phase of each satellite, in units of the noise.
fn rank_one_terms(blocks: &[PlacedVisibilities], values: &[Complex64]) -> Mat<f64> {
    let mut terms = Mat::zeros(2 * values.len(), 2 * SATELLITES * PASSES);
    let places = blocks.iter().flat_map(|block| block.time_s.iter().map(|time_s| (block.pair, *time_s)));
    for (k, ((pair, time_s), value)) in places.zip(values).enumerate() {
        let pass = (time_s / start_s(1)) as usize;
        for (n, sign) in [(pair.i, 1.0), (pair.j, -1.0)] {
            let column = 2 * (SATELLITES * pass + usize::from(n));
            let amplitude = SIGMA[0] / NOISE_K_SR * value;
            let phase = Complex64::new(0.0, sign * SIGMA[1] / NOISE_K_SR) * value;
            for (column, term) in [(column, amplitude), (column + 1, phase)] {
                (terms[(2 * k, column)], terms[(2 * k + 1, column)]) = (term.re, term.im);
            }
        }
    }
    terms
}

/// The variances that draws state are those of dense algebra: the sum over passes and satellites of rank-one terms, which have no draws.
#[test]
fn draws_have_the_covariance_of_all_gains() {
    const DRAWS: usize = 64;
    let blocks = geometry();
    let values = observed(&sky(5), &blocks);
    let sums = low_engine(&calibrated(&blocks, &values, &gains(DRAWS, 1))).into_sums();
    let errors = solved(&sums, Samples::default()).uncertainty.unwrap();
    let stated = errors.gains.unwrap();
    let rows = dense_rows(&blocks);
    let power_k2 = errors.power.over_noise_k2();
    let mut matrix = rows.transpose() * &rows;
    degrees(DEGREE).enumerate().for_each(|(k, l)| matrix[(k, k)] += power_k2[l].recip());
    let right = rows.transpose() * rank_one_terms(&blocks, &values);
    let maps = matrix.llt(Side::Lower).unwrap().solve(&right);
    let covariance = &(&maps * maps.transpose());
    // Sums of squares of Gaussian numbers of this covariance scatter by twice the sum of its squares.
    let compare = |name: &str, found: f64, places: &[usize]| {
        let expected: f64 = places.iter().map(|&k| covariance[(k, k)]).sum();
        let squares: f64 =
            places.iter().flat_map(|&j| places.iter().map(move |&k| covariance[(j, k)].powi(2))).sum();
        let scatter = (2.0 * squares / DRAWS as f64).sqrt() / expected;
        println!("{name}: {:.3} of the dense variance, scatter {scatter:.3}", found / expected);
        // Two thousandths for the gridded rows.
        assert!(
            (found / expected - 1.0).abs() < 4.0 * scatter + 2e-3,
            "{name}: {found} {expected} {scatter}"
        );
        assert!(scatter < 0.2, "{name} tells little: {scatter}");
    };
    let of_degree = |l: usize| degrees(DEGREE).enumerate().filter(move |(_, of)| *of == l).map(|(k, _)| k);
    for l in 0..=DEGREE {
        let places: Vec<usize> = of_degree(l).collect();
        compare(&format!("l = {l}"), stated.power_k2[l] * (2 * l + 1) as f64, &places);
    }
    let all: Vec<usize> = (0..(DEGREE + 1).pow(2)).collect();
    compare("all", stated.sigma_rms_k.powi(2) * 4.0 * std::f64::consts::PI, &all);
    compare("mean", stated.mean_sigma_k.powi(2) * 4.0 * std::f64::consts::PI, &[0]);
}

/// Where gains err by far more than the noise, the truth of many realisations of all errors is within the stated errors as often as of Gaussian
/// ones; without draws it is not, and of the mean by far. The maps of realisations are those of dense algebra with the R of the stated map.
#[test]
fn stated_errors_hold_the_truth() {
    const COUNT: usize = 400;
    const DRAWS: usize = 64;
    const SAMPLES: usize = 48;
    let (blocks, truth) = (geometry(), sky(5));
    let values = observed(&truth, &blocks);
    let first = with_errors(0, &blocks, &values);
    let [known, unknown] = [DRAWS, 0].map(|draws| {
        let sums = low_engine(&calibrated(&blocks, &first, &gains(draws, 1))).into_sums();
        solved(&sums, Samples { count: if draws > 0 { SAMPLES } else { 0 }, gibbs: true })
    });
    let map_k = known.map_k.clone();
    let [known, unknown] = [known, unknown].map(|solution| solution.uncertainty.unwrap());
    assert_eq!(known.power.power_k2, unknown.power.power_k2);
    let (rows, power_k2) = (dense_rows(&blocks), known.power.over_noise_k2());
    let mut matrix = rows.transpose() * &rows;
    degrees(DEGREE).enumerate().for_each(|(k, l)| matrix[(k, k)] += power_k2[l].recip());
    let data: Vec<Vec<Complex64>> =
        (1..=COUNT as u64).map(|seed| with_errors(seed, &blocks, &values)).collect();
    let data = Mat::from_fn(rows.nrows(), COUNT, |row, column| {
        let value = data[column][row / 2];
        (if row % 2 == 0 { value.re } else { value.im }) / NOISE_K_SR
    });
    let solved = matrix.llt(Side::Lower).unwrap().solve(rows.transpose() * data);
    let away: Vec<Vec<f64>> = (0..COUNT)
        .map(|column| {
            let away: Vec<f64> = truth.iter().enumerate().map(|(k, x)| solved[(k, column)] - x).collect();
            crate::sky::harmonics::synthesis(&coefficients(&away, DEGREE), NSIDE).unwrap()
        })
        .collect();
    let within = |errors: &Uncertainty, limit: f64| {
        let pixels = away.iter().flat_map(|map| map.iter().zip(&errors.sigma_k));
        pixels.filter(|(away, sigma)| away.abs() < limit * **sigma).count() as f64
            / (COUNT * errors.sigma_k.len()) as f64
    };
    let mean_square = |errors: &Uncertainty| {
        let mean_k = |map: &Vec<f64>| map.iter().sum::<f64>() / map.len() as f64;
        away.iter().map(|map| (mean_k(map) / errors.mean_sigma_k).powi(2)).sum::<f64>() / COUNT as f64
    };
    for (name, errors) in [("with draws", &known), ("without", &unknown)] {
        let shares = [1.0, 1.96].map(|limit| within(errors, limit));
        println!(
            "{name}: {shares:.3?} within 1 and 1.96, mean square of the mean's error {:.2}",
            mean_square(errors)
        );
    }
    let mean_of_squares = |maps: &mut dyn Iterator<Item = f64>| {
        let (sum, count) = maps.fold((0.0, 0.0), |(sum, count), x| (sum + x * x, count + 1.0));
        sum / count
    };
    let of_truth = mean_of_squares(&mut away.iter().flatten().copied());
    let sampled = known.samples.iter().flat_map(|sample| sample.map_k.iter().zip(&map_k).map(|(a, b)| a - b));
    let of_samples = mean_of_squares(&mut sampled.into_iter());
    println!("squares of Gibbs samples over those of the truth: {:.3}", of_samples / of_truth);
    // Those of 64 draws and of 48 samples scatter by 0.09 and some 0.1: twice that. With errors by gains also in the noise it is above 1.3.
    assert!((of_samples / of_truth - 1.0).abs() < 0.27, "{of_samples} {of_truth}");
    // Variances from 64 draws scatter by 0.09 (of all pixels together; see above) and that of the mean by 0.18: four times that.
    assert!((within(&known, 1.0) - 0.683).abs() < 0.08 && (within(&known, 1.96) - 0.95).abs() < 0.04);
    assert!((0.5..1.9).contains(&mean_square(&known)), "{}", mean_square(&known));
    assert!(within(&unknown, 1.0) < 0.55 && within(&unknown, 1.96) < 0.85 && mean_square(&unknown) > 5.0);
}

/// The bits of all right-hand sides of draws, and of their power.
fn error_bits(sums: &HarmonicSums) -> Vec<u64> {
    let right = sums.gain_error_right_hand_sides().iter().flatten();
    right.chain([&sums.gain_error_power()]).map(|x| x.to_bits()).collect()
}

/// Sums of draws are exact: they depend on which visibilities are in them alone, and data without draws leave no trace of them.
#[test]
fn sums_of_draws_are_added_removed_merged_and_kept() {
    let all = geometry();
    let values = observed(&sky(2), &all);
    let drawn = calibrated(&all, &values, &gains(4, 1));
    let bare = calibrated(&all, &values, &gains(0, 1));
    let (first, rest) = drawn.split_at(drawn.len() / 3);
    let bytes = |engine: &mut HarmonicEngine| {
        let mut bytes = Vec::new();
        engine.checkpoint(&mut bytes).unwrap();
        bytes
    };
    let mut whole = low_engine(&drawn);
    let expected = bytes(&mut whole);
    let mut merged = low_engine(rest);
    merged.merge(low_engine(first)).unwrap();
    assert!(bytes(&mut merged) == expected);
    for block in first {
        assert_eq!(merged.remove(block).unwrap().visibilities, block.len() as u64);
    }
    assert!(bytes(&mut merged) == bytes(&mut low_engine(rest)));
    let restored = HarmonicEngine::restore(&mut &expected[..]).unwrap();
    let whole = whole.into_sums();
    assert_eq!(whole.gain_error_right_hand_sides().len(), 4);
    assert!(error_bits(&restored.into_sums()) == error_bits(&whole));
    // The data themselves are summed as without draws; and with draws taken out again nothing is left of them.
    let mut plain = low_engine(&bare);
    let expected = bytes(&mut plain);
    assert!(plain.sums().right_hand_side() == whole.right_hand_side());
    let mut changed = low_engine(&drawn);
    drawn.iter().for_each(|block| assert!(changed.remove(block).unwrap().refused.is_empty()));
    bare.iter().for_each(|block| assert!(changed.add(block).unwrap().refused.is_empty()));
    assert!(bytes(&mut changed) == expected);
    assert!(error_bits(&changed.into_sums()) == [0.0_f64.to_bits()]);
}

/// Right-hand sides of draws by the forward model's rows, which the engine's are near; also of several ranks, and of sums in parts.
#[test]
fn right_hand_sides_of_draws_are_those_of_the_rows() {
    let blocks = geometry();
    let drawn = calibrated(&blocks, &observed(&sky(2), &blocks), &gains(4, 1));
    let whole = low_engine(&drawn).into_sums();
    let rows = dense_rows(&blocks);
    let norm_of = |x: &[f64]| dot(x, x).sqrt();
    for (draw, found) in whole.gain_error_right_hand_sides().iter().enumerate() {
        let errors = drawn.iter().flat_map(|block| {
            let of = move |k: usize| block.gain_errors_of(k)[draw] * block.value_k_sr[k] / NOISE_K_SR;
            (0..block.len()).flat_map(move |k| [of(k).re, of(k).im])
        });
        let errors: Vec<f64> = errors.collect();
        let expected = rows.transpose() * Mat::from_fn(errors.len(), 1, |row, _| errors[row]);
        let away: Vec<f64> = found.iter().enumerate().map(|(k, x)| x - expected[(k, 0)]).collect();
        // Interpolation between nodes errs by 4e-4 of a row.
        assert!(norm_of(&away) < 1e-3 * norm_of(found), "{draw}: {} {}", norm_of(&away), norm_of(found));
    }
    let shared = on_threads(3, |ranks| {
        let mut engine = HarmonicEngine::new(low_setup()).unwrap().with_ranks(ranks);
        drawn.iter().for_each(|block| assert!(engine.add(block).unwrap().refused.is_empty()));
        error_bits(&engine.into_sums())
    });
    assert!(shared.iter().all(|bits| *bits == error_bits(&whole)));
    let folder = tempfile::tempdir().unwrap();
    let on_disk = low_engine(&drawn).into_sums().on_disk(folder.path()).unwrap();
    assert!(error_bits(&on_disk) == error_bits(&whole) && on_disk.gain_error_tori.is_empty());
    let mut part = Some(SumPart::first(3, folder.path()));
    let mut parts = None;
    while let Some(this) = part {
        let mut engine = HarmonicEngine::new(low_setup()).unwrap().with_ranks(&this.ranks());
        drawn.iter().for_each(|block| assert!(engine.add(block).unwrap().refused.is_empty()));
        parts = engine.finish_part(&this).unwrap();
        part = this.next();
    }
    let parts = parts.unwrap();
    assert_eq!(parts.gain_error_power(), whole.gain_error_power());
    for (part, whole) in parts.gain_error_right_hand_sides().iter().zip(whole.gain_error_right_hand_sides()) {
        let away: Vec<f64> = part.iter().zip(whole).map(|(a, b)| a - b).collect();
        // Parts are added in f64; each is rounded to 2^-51 of its largest element.
        assert!(norm_of(&away) < 1e-12 * norm_of(whole), "{}", norm_of(&away));
    }
}
