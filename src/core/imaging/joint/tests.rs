//! Tests against dense matrices and other formulas.

use std::borrow::Cow;

use faer::linalg::solvers::{DenseSolveCore, Solve};
use faer::{Mat, Side};
use rand_distr::{Distribution, StandardNormal};

use super::correlation::Covariance;
use super::evidence::{evidence, moments, most_likely};
use super::posterior::{Equations, JointRequest, Posterior};
use super::powers::{PowerPriors, PowerRows, PowerSample};
use super::prior::{Prior, View};
use super::sums::{JointSums, ScaledBlocks, scaled_blocks};
use crate::imaging::SkyPower;
use crate::imaging::circle::{coefficients, degrees};
use crate::imaging::power::Block;
use crate::imaging::solver::{SolveWatch, StoppingRule};
use crate::imaging::unknowns::{degrees_orders_parts, index_of};
use crate::imaging::{Accuracy, NormalSums, SumCounts};
use crate::sky::harmonics::synthesis;
use crate::sky::healpix::{pixel_area_sr, pixel_directions};
use crate::units::vector::{add, cross, dot, norm, scale, unit};
use crate::units::{StreamKind, random_stream};

/// Sums with a dense matrix.
struct Dense {
    matrix: Mat<f64>,
    right: Vec<f64>,
}

impl NormalSums for Dense {
    fn unknowns(&self) -> usize {
        self.right.len()
    }

    fn apply(&self, x: &[f64], y: &mut [f64]) {
        for (i, y) in y.iter_mut().enumerate() {
            *y = x.iter().enumerate().map(|(j, x)| self.matrix[(i, j)] * x).sum();
        }
    }

    fn right_hand_side(&self) -> &[f64] {
        &self.right
    }

    fn noise_right_hand_side(&self) -> &[f64] {
        &self.right
    }

    fn counts(&self) -> SumCounts {
        SumCounts { visibilities: 100, ..SumCounts::default() }
    }

    fn accuracy(&self) -> Accuracy {
        Accuracy { relative: 0.0, absolute: 0.0 }
    }
}

fn normal(seed: u64) -> impl FnMut() -> f64 {
    let mut stream = random_stream(seed, StreamKind::Probe, [0, 0]);
    move || StandardNormal.sample(&mut stream)
}

/// Random sums of a channel, with some badly measured combinations.
fn dense(l_max: usize, seed: u64) -> Dense {
    let mut normal = normal(seed);
    let order = (l_max + 1).pow(2);
    let b =
        Mat::from_fn(2 * order, order, |row, _| normal() * 10.0_f64.powf(-1.5 * row as f64 / order as f64));
    Dense { matrix: b.transpose() * &b, right: (0..order).map(|_| normal()).collect() }
}

fn unit_vector(count: usize, k: usize) -> Vec<f64> {
    (0..count).map(|j| f64::from(u8::from(j == k))).collect()
}

/// The matrix of the equations plus that of the prior, 1.
fn dense_precision(sums: &JointSums<'_>) -> Mat<f64> {
    let count = sums.unknowns();
    let product = |k: usize| sums.apply_all(&[&unit_vector(count, k)]).remove(0);
    let products: Vec<Vec<f64>> = (0..count).map(product).collect();
    Mat::from_fn(count, count, |i, j| products[j][i] + f64::from(u8::from(i == j)))
}

/// The blocks of each order and parity of a matrix, taken from the cosine unknowns.
fn order_blocks(dense: &Dense, l_max: usize) -> Vec<Block<'static>> {
    let of = |(m, parity): (usize, usize)| {
        let degrees: Vec<usize> = (m + parity..=l_max).step_by(2).collect();
        let at = |k: usize, part| index_of(l_max, degrees[k], m, part);
        let matrix = Mat::from_fn(degrees.len(), degrees.len(), |i, j| dense.matrix[(at(i, 0), at(j, 0))]);
        let parts = if m == 0 { 1 } else { 2 };
        let places = (0..parts).map(|part| (0..degrees.len()).map(|k| at(k, part)).collect()).collect();
        Block { matrix: Cow::Owned(matrix), degrees, places }
    };
    let orders = (0..=l_max).flat_map(|m| [(m, 0), (m, 1)]);
    orders.filter(|(m, parity)| m + parity <= l_max).map(of).collect()
}

/// The mean `(A + C^-1)^-1 b` and covariance of the coefficients of 10 MHz, 5 MHz, and 7 MHz without data.
fn posterior_of_dense(scales: [&Vec<f64>; 3], channels: &[Dense; 2]) -> (Mat<f64>, Mat<f64>) {
    let hz = [10e6, 5e6, 7e6];
    let rows: Vec<(usize, usize, usize)> = [4, 3, 3]
        .iter()
        .enumerate()
        .flat_map(|(k, l_max)| {
            (0..=*l_max).flat_map(move |m| {
                (m..=*l_max).flat_map(move |l| {
                    (0..if m == 0 { 1 } else { 2 }).map(move |part| (k, l, 1000 * m + part))
                })
            })
        })
        .collect();
    let count = rows.len();
    let c = Mat::from_fn(count, count, |i, j| {
        let ((a, l, m), (b, k, n)) = (rows[i], rows[j]);
        if (l, m) != (k, n) {
            return 0.0;
        }
        let x = f64::ln(hz[a] / hz[b]) / 0.8;
        // Mean and dipole of each channel are free.
        let alike = if l < 2 { 0.0 } else { 0.98 * (-0.5 * x * x).exp() };
        scales[a][l] * scales[b][l] * if a == b { 1.0 } else { alike }
    });
    let (first, second) = (25, 16);
    let a = Mat::from_fn(count, count, |i, j| {
        if i < first && j < first {
            channels[0].matrix[(i, j)]
        } else if (first..first + second).contains(&i) && (first..first + second).contains(&j) {
            channels[1].matrix[(i - first, j - first)] / 1.69
        } else {
            0.0
        }
    });
    let b = Mat::from_fn(count, 1, |i, _| match i {
        i if i < first => channels[0].right[i],
        i if i < first + second => channels[1].right[i - first] / 1.69,
        _ => 0.0,
    });
    let whole = &a + c.llt(Side::Lower).unwrap().inverse();
    let factor = whole.llt(Side::Lower).unwrap();
    (factor.solve(&b), factor.inverse())
}

/// The channels' scales, their prior, and their noise factors.
fn two_channels() -> (Vec<Vec<f64>>, Prior, Vec<f64>) {
    let covariance = Covariance::constant(vec![10e6, 5e6], 4, 0.8, 0.02);
    let scale = vec![vec![3.0, 2.0, 1.0, 0.7, 0.5], vec![5.0, 4.0, 2.0, 1.0]];
    (scale.clone(), Prior::new(scale, covariance).unwrap(), vec![1.0, 1.3])
}

/// Compares solution, variances and an intermediate frequency with `(A + C^-1)^-1 b` from dense matrices, without T. `expected` are the
/// channels whose dense sums hold all, `tolerance` that of the solution in standard deviations. Returns the errors of pixels relative to
/// theirs by frequency.
fn compare(
    channels: &[Dense; 2],
    powers: Option<&PowerRows>,
    expected: &[Dense; 2],
    tolerance: f64,
) -> Vec<f64> {
    let (scale, prior, factors) = two_channels();
    let blocks: Vec<Vec<Block<'_>>> =
        channels.iter().zip([4, 3]).map(|(dense, l_max)| order_blocks(dense, l_max)).collect();
    let sums: Vec<&(dyn NormalSums + Sync)> =
        channels.iter().map(|dense| dense as &(dyn NormalSums + Sync)).collect();
    let weighted = powers.map(|rows| rows.weighted(&rows.measured(), 1.0));
    let equations = Equations {
        prior: &prior,
        sums: &sums,
        blocks: &blocks,
        couplings: vec![None, None],
        noise_factors: &factors,
    };
    let (joint, approximation) = equations.joint(vec![weighted, None]);
    let rule = StoppingRule { residual_max: 1e-11, iterations_max: 500 };
    let samples = if powers.is_some() { 0 } else { 400 };
    let request = JointRequest { rule, samples, at_hz: Vec::new(), powers: None };
    let watch = SolveWatch::default();
    let found = Posterior::new(&joint, &approximation, &request, None, watch.named("test")).unwrap();
    assert!(found.convergence.converged);

    let at_seven = prior.view_at(7e6, &found.amplitudes_of_free()).unwrap();
    let (expected, covariance) = posterior_of_dense([&scale[0], &scale[1], &at_seven.scale], expected);
    let count = covariance.nrows();
    let views = [prior.view_of(0), prior.view_of(1), at_seven];
    let solved: Vec<f64> = views.iter().flat_map(|view| found.coefficients(view, &found.solution)).collect();
    // Mean and dipole between channels have another prior.
    let own = [(0, 0, 0), (1, 0, 0), (1, 1, 0), (1, 1, 1)].map(|(l, m, part)| 41 + index_of(3, l, m, part));
    for (i, value) in solved.iter().enumerate().filter(|(i, _)| !own.contains(i)) {
        let error = (value - expected[(i, 0)]).abs() / covariance[(i, i)].sqrt();
        assert!(error < tolerance, "{i}: {value} {}", expected[(i, 0)]);
    }
    if powers.is_some() {
        // Without samples, the covariance of the unknowns of the two channels from products with the equations.
        let inverse = dense_precision(&joint).llt(Side::Lower).unwrap().inverse();
        let column = |k: usize| -> Vec<f64> {
            let unit = unit_vector(41, k);
            views[..2].iter().flat_map(|view| found.coefficients(view, &unit)).collect()
        };
        let columns: Vec<Vec<f64>> = (0..41).map(column).collect();
        let skies = Mat::from_fn(41, 41, |i, k| columns[k][i]);
        let found = &skies * inverse * skies.transpose();
        for i in 0..41 {
            let ratio = found[(i, i)] / covariance[(i, i)];
            // Rows of pixels have errors of some 1e-3 sr at the limb, and the largest have few sr.
            assert!((ratio - 1.0).abs() < 0.1, "{i}: {ratio}");
        }
        return Vec::new();
    }
    let samples: Vec<Vec<f64>> = (0..request.samples)
        .map(|number| views.iter().flat_map(|view| found.sample(view, number)).collect())
        .collect();
    for i in (0..count).filter(|i| !own.contains(i)) {
        let variance: f64 =
            samples.iter().map(|sample| (sample[i] - solved[i]).powi(2)).sum::<f64>() / samples.len() as f64;
        // Five standard errors of a variance from 400 samples.
        assert!((variance / covariance[(i, i)] - 1.0).abs() < 0.36, "{i}: {variance} {}", covariance[(i, i)]);
    }
    let ratio = |(view, at): (&View, std::ops::Range<usize>)| {
        let map = found.map(view, 4).unwrap();
        let found: f64 = map.sigma_k.iter().map(|sigma| sigma * sigma).sum::<f64>() / 192.0;
        let trace: f64 = at.map(|i| covariance[(i, i)]).sum();
        found / (trace / (4.0 * std::f64::consts::PI))
    };
    views.iter().zip([0..25, 25..41]).map(ratio).collect()
}

#[test]
fn the_joint_map_is_that_of_the_dense_matrices() {
    let channels = [dense(4, 1), dense(3, 2)];
    // The iteration stops at 1e-11, and C^-1 loses some digits.
    for ratio in compare(&channels, None, &channels, 1e-6) {
        // Blocks neglect coupling, for which the ratio of samples corrects by degree.
        assert!((ratio - 1.0).abs() < 0.15, "{ratio}");
    }
}

/// Three passes of two daughters, the Moon three degrees farther in each power, at changing altitudes.
fn passes() -> Vec<PowerSample> {
    let sample = |k: usize| {
        let (pass, t) = (k / 30, (k % 30) as f64);
        let (sin, cos) = (0.052 * t + pass as f64).sin_cos();
        let ascending = unit([1.0, 0.0, 0.5 * pass as f64]);
        let ahead = unit(cross([0.1, -0.4, 1.0], ascending));
        let r_m = scale(2.0e6 + 2e3 * t, add(scale(cos, ascending), scale(sin, ahead)));
        let power_k_sr = 200.0 + 3.0 * (0.4 * t + pass as f64).sin();
        let (daughter, time_s) = ((pass / 2) as u8, 1e4 * pass as f64 + 20.0 * t);
        PowerSample { daughter, time_s, duration_s: 0.0, r_m, power_k_sr, sigma_k_sr: 0.5 }
    };
    (0..90).map(sample).collect()
}

/// Sums of the powers with their dense covariance, `N + C C'`, and rows that are sums over the pixels of a fine map outside the disc.
fn dense_powers(samples: &[PowerSample], moon_m: f64, constant: f64, priors: [f64; 3]) -> Dense {
    const NSIDE: usize = 128;
    let directions = pixel_directions(NSIDE);
    let harmonics: Vec<Vec<f64>> =
        (0..25).map(|k| synthesis(&coefficients(&unit_vector(25, k), 4), NSIDE).unwrap()).collect();
    let count = samples.len();
    let mut rows = Mat::<f64>::zeros(count, 25);
    for (i, sample) in samples.iter().enumerate() {
        let r = norm(sample.r_m);
        let limb = -(1.0 - (moon_m / r).powi(2)).sqrt();
        let seen = |pixel: &usize| dot(directions[*pixel], sample.r_m) / r > limb;
        for pixel in (0..directions.len()).filter(seen) {
            (0..25).for_each(|k| rows[(i, k)] += harmonics[k][pixel] * pixel_area_sr(NSIDE));
        }
    }
    let covariance = Mat::from_fn(count, count, |i, j| {
        if i / 30 != j / 30 {
            return 0.0;
        }
        let pass = &samples[30 * (i / 30)..][..30];
        let mean = pass.iter().map(|sample| sample.power_k_sr).sum::<f64>() / 30.0;
        let time = |i: usize| (i % 30) as f64 / 29.0 - 0.5;
        let noise = if i == j { samples[i].sigma_k_sr.powi(2) } else { 0.0 };
        let [gain, offset, slope] = priors.map(|sigma| sigma * sigma);
        noise
            + gain * samples[i].power_k_sr * samples[j].power_k_sr
            + mean * mean * (offset + slope * time(i) * time(j))
    });
    let factor = covariance.llt(Side::Lower).unwrap();
    let data = Mat::from_fn(count, 1, |i, _| samples[i].power_k_sr - constant);
    let right = rows.transpose() * factor.solve(&data);
    Dense { matrix: rows.transpose() * factor.solve(&rows), right: (0..25).map(|k| right[(k, 0)]).collect() }
}

#[test]
fn powers_with_free_gains_count_as_those_of_the_dense_matrices() {
    let (moon_m, samples) = (1.7e6, passes());
    let priors = PowerPriors { gain: 0.1, offset: 0.01, slope: 0.02, constant_k_sr: Vec::new() };
    let channels = [dense(4, 1), dense(3, 2)];
    let powers = dense_powers(&samples, moon_m, 190.0, [priors.gain, priors.offset, priors.slope]);
    let both = Dense {
        matrix: &channels[0].matrix + &powers.matrix,
        right: channels[0].right.iter().zip(&powers.right).map(|(a, b)| a + b).collect(),
    };
    // A sky with nothing beyond l_max.
    let power_k2 = vec![1.0, 1.0, 1.0, 1.0, 1e-30];
    let sky = SkyPower { power_k2, sigma_ln: vec![], constrained: vec![], noise_factor: 1.0 };
    let rows = PowerRows::new(&samples, moon_m, &sky, &priors, 190.0).unwrap();
    // Rows of pixels have errors of some 1e-3 sr at the limb, of a sky of some kelvins and data of 13 K sr: a hundredth of a standard deviation
    // for each of 90 powers, and some tenth together.
    compare(&channels, Some(&rows), &[both, dense(3, 2)], 0.25);
}

/// Blocks and coupling of the powers make up their normal matrix.
#[test]
fn blocks_and_coupling_are_the_matrix_of_the_powers() {
    let priors = PowerPriors { gain: 0.1, offset: 0.01, slope: 0.02, constant_k_sr: Vec::new() };
    let sky = SkyPower { power_k2: vec![1.0; 5], sigma_ln: vec![], constrained: vec![], noise_factor: 1.0 };
    // All at one altitude, that of the blocks.
    let at_one_altitude = |sample: PowerSample| PowerSample { r_m: scale(2.0e6, unit(sample.r_m)), ..sample };
    let samples: Vec<PowerSample> = passes().into_iter().map(at_one_altitude).collect();
    let rows = PowerRows::new(&samples, 1.7e6, &sky, &priors, 190.0).unwrap();
    let weighted = rows.weighted(&rows.measured(), 1.0);
    let blocks = weighted.blocks();
    let coupling = weighted.coupling(&blocks);
    let names: Vec<(usize, usize, usize)> = degrees_orders_parts(4).collect();
    assert_eq!((coupling.degree_max, coupling.places.len()), (4, names.len()));
    for (j, (other, m_other, part_other)) in names.iter().enumerate() {
        let expected =
            weighted.product(&unit_vector(names.len(), index_of(4, *other, *m_other, *part_other)));
        let largest = expected.iter().fold(0.0_f64, |a, b| a.max(b.abs()));
        for (i, (l, m, part)) in names.iter().enumerate() {
            let is_of_block = (m, part) == (m_other, part_other) && (l + other) % 2 == 0;
            let of_block = match is_of_block {
                true => blocks[2 * m + (l - m) % 2][((l - m) / 2, (other - m) / 2)],
                false => 0.0,
            };
            let found = of_block + coupling.matrix[(i, j)];
            // The products interpolate on a grid, which errs by 1e-4 at the highest degree.
            assert!((found - expected[coupling.places[i]]).abs() < 1e-4 * largest, "{i} {j}: {found}");
        }
    }
}

/// A power is an average over its integration, in which the Moon moves: of degrees up to 8 over 2.7 degrees, also where several powers make one
/// row. Compared with the mean over many instants.
#[test]
fn integrated_powers_are_averages_over_the_moons_motion() {
    const INSTANTS: usize = 60;
    let priors = PowerPriors { gain: 0.1, offset: 0.01, slope: 0.01, constant_k_sr: Vec::new() };
    let sky = SkyPower { power_k2: vec![1.0; 9], sigma_ln: vec![], constrained: vec![], noise_factor: 1.0 };
    let x: Vec<f64> = (0..81).map(|k| (0.7 * k as f64 + 0.1).sin()).collect();
    let at = |time_s: f64, duration_s: f64| {
        let (sin, cos) = (7.85e-4 * time_s).sin_cos();
        let r_m = scale(2.0e6, unit([cos, 0.9 * sin, 0.44 * sin]));
        PowerSample { daughter: 0, time_s, duration_s, r_m, power_k_sr: 200.0, sigma_k_sr: 0.5 }
    };
    // Passes of an instant each: no two belong together.
    let instants = |time_s: f64| {
        let sample = PowerSample { time_s: 1e4 * time_s, ..at(time_s, 0.0) };
        PowerRows::new(&[sample], 1.7e6, &sky, &priors, 0.0).unwrap().model(&x)[0]
    };
    for (duration_s, length_s) in [(60.0, 60.0), (10.0, 50.0)] {
        let samples: Vec<PowerSample> = (0..1200)
            .step_by(duration_s as usize)
            .map(|t| at(f64::from(t) + 0.5 * duration_s, duration_s))
            .collect();
        let found = PowerRows::new(&samples, 1.7e6, &sky, &priors, 0.0).unwrap().model(&x);
        assert_eq!(found.len(), (1200.0 / length_s) as usize);
        for (row, found) in found.into_iter().enumerate() {
            let instant_s = |k: usize| length_s * (row as f64 + (k as f64 + 0.5) / INSTANTS as f64);
            let expected = (0..INSTANTS).map(|k| instants(instant_s(k))).sum::<f64>() / INSTANTS as f64;
            // Two points are off by 5e-6 of the highest degree, the motion by some 1e-3 of itself, and at the ends of a pass by its curvature;
            // without an average the difference is up to 0.02.
            assert!((found - expected).abs() < 1e-3, "{row}: {found} {expected}");
        }
    }
}

/// Powers are averaged while the Moon's direction changes little.
#[test]
fn powers_are_averaged_and_split_into_passes() {
    let priors = PowerPriors { gain: 0.1, offset: 0.01, slope: 0.01, constant_k_sr: Vec::new() };
    let sky = SkyPower { power_k2: vec![1.0; 5], sigma_ln: vec![], constrained: vec![], noise_factor: 1.0 };
    let mut samples = passes();
    // Each power again half a degree farther on, with half the noise and so four times the weight.
    let again = samples.clone().into_iter().map(|sample| {
        let r_m = add(sample.r_m, scale(0.008, cross([0.0, 0.3, 1.0], sample.r_m)));
        let power_k_sr = sample.power_k_sr + 5.0;
        PowerSample { r_m, power_k_sr, time_s: sample.time_s + 5.0, sigma_k_sr: 0.25, ..sample }
    });
    samples.extend(again.collect::<Vec<_>>());
    samples.push(PowerSample { sigma_k_sr: f64::NAN, ..samples[0] });
    samples.sort_by(|a, b| (a.daughter, a.time_s).partial_cmp(&(b.daughter, b.time_s)).unwrap());
    let rows = PowerRows::new(&samples, 1.7e6, &sky, &priors, 0.0).unwrap();
    let found = rows.weighted(&rows.measured(), 1.0).agreement(&[0.0; 25]);
    assert_eq!((found.rows, found.passes), (90, 3));
    // Numbers of samples are (P / sigma)^2.
    let [one, other] = [passes()[0].power_k_sr, passes()[0].power_k_sr + 5.0];
    let shares = [(one / 0.5).powi(2), (other / 0.25).powi(2)];
    let expected = (shares[0] * one + shares[1] * other) / (shares[0] + shares[1]);
    assert!((rows.measured()[0] / expected - 1.0).abs() < 1e-12, "{} {expected}", rows.measured()[0]);
}

/// The mean's error bars hold in simulations, with gains, offsets and slopes drawn from their priors: as often as they say within one and two
/// standard deviations, and without a bias. A gain that was fitted as a number would make the mean one per cent too high.
#[test]
fn errors_of_the_mean_hold_with_unknown_gains() {
    const TRIALS: u64 = 60;
    let scale = vec![1e3, 1e2, 1.0, 0.7, 0.5];
    let sky = SkyPower {
        power_k2: vec![1.0, 1.0, 1.0, 1.0, 1e-30],
        sigma_ln: vec![],
        constrained: vec![],
        noise_factor: 1.0,
    };
    let covariance = Covariance::constant(vec![10e6], 4, 1.0, 0.5);
    let prior = Prior::new(vec![scale.clone()], covariance).unwrap();
    let priors = PowerPriors { gain: 0.1, offset: 0.01, slope: 0.01, constant_k_sr: Vec::new() };
    let deviations: Vec<f64> = (0..TRIALS)
        .map(|trial| {
            let mut normal = normal(100 + trial);
            // The mean is 50 K, which visibilities do not see.
            let mut x: Vec<f64> = degrees(4).map(|l| scale[l.max(2)] * normal()).collect();
            x[0] = 50.0 * (4.0 * std::f64::consts::PI).sqrt();
            let rows = Mat::from_fn(50, 25, |_, k| if k == 0 { 0.0 } else { normal() });
            let data =
                Mat::from_fn(50, 1, |i, _| (0..25).map(|k| rows[(i, k)] * x[k]).sum::<f64>() + normal());
            let right = rows.transpose() * &data;
            let dense =
                Dense { matrix: rows.transpose() * &rows, right: (0..25).map(|k| right[(k, 0)]).collect() };
            // Eight turns of the three passes, each with errors of its own.
            let mut samples: Vec<PowerSample> = (0..8)
                .flat_map(|turn| passes().into_iter().map(move |one| (turn, one)))
                .map(|(turn, one)| {
                    let time_s = one.time_s + 1e5 * f64::from(turn);
                    PowerSample { time_s, power_k_sr: 1.0, sigma_k_sr: 1.0, ..one }
                })
                .collect();
            samples.sort_by(|a, b| (a.daughter, a.time_s).partial_cmp(&(b.daughter, b.time_s)).unwrap());
            let truth = PowerRows::new(&samples, 1.7e6, &sky, &priors, 0.0).unwrap().model(&x);
            for (pass, powers) in samples.chunks_mut(30).zip(truth.chunks(30)) {
                let mean = powers.iter().sum::<f64>() / 30.0;
                let [gain, offset, slope] = [0.1 * normal(), 0.01 * normal(), 0.01 * normal()];
                for (t, (sample, power)) in pass.iter_mut().zip(powers).enumerate() {
                    let drift = offset + slope * (t as f64 / 29.0 - 0.5);
                    // 1e5 independent samples.
                    let noise = 1.0 + normal() / 1e5_f64.sqrt();
                    sample.power_k_sr = (power * (1.0 + gain) + mean * drift) * noise;
                    sample.sigma_k_sr = sample.power_k_sr / 1e5_f64.sqrt();
                }
            }
            let rows = [PowerRows::new(&samples, 1.7e6, &sky, &priors, 0.0)];
            let blocks = [order_blocks(&dense, 4)];
            let sums: [&(dyn NormalSums + Sync); 1] = [&dense];
            let equations = Equations {
                prior: &prior,
                sums: &sums,
                blocks: &blocks,
                couplings: vec![None],
                noise_factors: &[1.0],
            };
            let rule = StoppingRule { residual_max: 1e-8, iterations_max: 500 };
            let request = JointRequest { rule, samples: 0, at_hz: Vec::new(), powers: None };
            let watch = SolveWatch::default();
            let (joint, approximation, start) =
                equations.with_powers(&rows, &request, watch.named("test")).unwrap();
            let found =
                Posterior::new(&joint, &approximation, &request, start.as_deref(), watch.named("test"))
                    .unwrap();
            let variance = dense_precision(&joint).llt(Side::Lower).unwrap().inverse()[(0, 0)];
            (found.coefficients(&prior.view_of(0), &found.solution)[0] - x[0]) / (scale[0] * variance.sqrt())
        })
        .collect();
    let within = |sigmas: f64| deviations.iter().filter(|z| z.abs() < sigmas).count();
    // 41 and 57 of 60 are expected, with standard errors of 3.6 and 1.6; three of each.
    assert!((30..=52).contains(&within(1.0)) && within(2.0) >= 52, "{} {}", within(1.0), within(2.0));
    let bias = deviations.iter().sum::<f64>() / TRIALS as f64;
    assert!(bias.abs() < 3.0 / (TRIALS as f64).sqrt(), "{bias}");
}

/// Skies of three channels with parameters that change with degree, each coefficient measured with an error of 0.01: their prior, a start of
/// the search, its blocks and right-hand sides.
fn simulated(l_max: usize) -> (Prior, Prior, Vec<ScaledBlocks>, Vec<Vec<f64>>) {
    let frequencies_hz = vec![4e6, 6e6, 9e6];
    let start = Covariance::constant(frequencies_hz, l_max, 2.0, 1e-2);
    let plain = Prior::new(vec![vec![1.0; l_max + 1]; 3], start).unwrap();
    let per_knot = 5;
    let knots = plain.covariance.theta.len() / per_knot;
    // From l = 2 on L falls, p rises, and the amplitude of the last channel is 0.7 of that of its own C_l.
    let of_knot = |knot: usize| [0.6 - 0.2 * knot as f64, -5.0 + knot as f64, 0.0, 0.0, 0.7_f64.ln()];
    let theta: Vec<f64> = (0..knots).flat_map(of_knot).collect();
    let truth = plain.with_theta(&theta).unwrap();
    let mut normal = normal(5);
    let (_, count) = truth.offsets();
    let unit: Vec<f64> = (0..count).map(|_| normal()).collect();
    let measured = |sky: Vec<f64>| sky.into_iter().map(|x| 1e4 * x + 1e2 * normal()).collect();
    let rights: Vec<Vec<f64>> = truth.skies(&unit).into_iter().map(measured).collect();
    let of = |(m, parity): (usize, usize)| {
        let degrees: Vec<usize> = (m + parity..=l_max).step_by(2).collect();
        let n = degrees.len();
        let matrix = Cow::Owned(Mat::from_fn(n, n, |i, j| if i == j { 1e4 } else { 0.0 }));
        let place = |part| degrees.iter().map(|l| index_of(l_max, *l, m, part)).collect();
        Block { matrix, places: (0..if m == 0 { 1 } else { 2 }).map(place).collect(), degrees }
    };
    let orders = (0..=l_max).flat_map(|m| [(m, 0), (m, 1)]).filter(|(m, parity)| m + parity <= l_max);
    let blocks: Vec<Block<'_>> = orders.map(of).collect();
    let scaled = scaled_blocks(&plain, &[blocks.clone(), blocks.clone(), blocks], &[1.0; 3], &[]);
    (truth, plain, scaled, rights)
}

/// The gradient of evidence and prior is that of their differences.
#[test]
fn derivatives_of_the_evidence_are_its_differences() {
    let (truth, _, scaled, rights) = simulated(11);
    let theta = &truth.covariance.theta;
    let value = |theta: &[f64]| {
        let prior = truth.with_theta(theta).unwrap();
        evidence(&prior, &scaled, &rights).unwrap() + prior.covariance.hyperprior().value
    };
    let (gradient, information) = truth.derivatives(&moments(&truth, &scaled, &rights).unwrap());
    for k in 0..theta.len() {
        let moved = |by: f64| {
            let mut moved = theta.clone();
            moved[k] += by;
            value(&moved)
        };
        // The error of the difference is the third derivative, some thousand, times 1e-8.
        let difference = (moved(1e-4) - moved(-1e-4)) / 2e-4;
        assert!((gradient[k] - difference).abs() < 1e-3, "{k}: {} {difference}", gradient[k]);
        assert!(information[(k, k)] > 0.0);
    }
}

/// Correlation and amplitudes of simulated skies are recovered, degree by degree.
#[test]
fn the_covariance_of_the_sky_is_found() {
    let (truth, plain, scaled, rights) = simulated(47);
    let watch = SolveWatch::default();
    let found = most_likely(&plain, &scaled, &rights, watch.named("test")).unwrap();
    let (found, truth) = (&found.covariance, &truth.covariance);
    // From l = 8 there are 100 modes or more for each parameter, whose logarithms so have errors of sqrt(2 / 100) = 0.14; that of L is found from
    // 1 less the correlation, which p shares. Three times these.
    for l in [8, 12, 24, 47] {
        let (a, b) = (found.correlation(l), truth.correlation(l));
        assert!((a.length / b.length).ln().abs() < 0.5, "{a:?} {b:?}");
        assert!((a.own_share / b.own_share).ln().abs() < 0.8, "{a:?} {b:?}");
        // The amplitude's error is half of that of a power.
        for (a, b) in found.amplitudes(l).into_iter().zip(truth.amplitudes(l)) {
            assert!((a / b).ln().abs() < 0.2, "{l} {a} {b}");
        }
    }
}
