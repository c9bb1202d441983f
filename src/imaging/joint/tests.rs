//! Tests against dense matrices and other formulas.

use std::borrow::Cow;

use faer::linalg::solvers::{DenseSolveCore, Solve};
use faer::{Mat, Side};
use rand_distr::{Distribution, StandardNormal};

use super::prior::{Correlation, Prior, index_of};
use super::solve::{JointRequest, Posterior, most_likely};
use super::sums::{JointSums, scaled_blocks};
use crate::imaging::power::Block;
use crate::imaging::solver::{SolveWatch, StoppingRule};
use crate::imaging::{Accuracy, NormalSums, SumCounts};
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
        scales[a][l] * scales[b][l] * (0.98 * (-0.5 * x * x).exp() + if a == b { 0.02 } else { 0.0 })
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

/// Compares solution, errors of pixels and an intermediate frequency with `(A + C^-1)^-1 b` from dense matrices, without T.
#[test]
fn the_joint_map_is_that_of_the_dense_matrices() {
    let (l_max, likeness) = ([4, 3], Correlation { length: 0.8, own_share: 0.02 });
    let channels = [dense(4, 1), dense(3, 2)];
    let scale = vec![vec![3.0, 2.0, 1.0, 0.7, 0.5], vec![5.0, 4.0, 2.0, 1.0]];
    let prior = Prior::new(vec![10e6, 5e6], scale.clone(), likeness).unwrap();
    let factors = vec![1.0, 1.3];
    let blocks: Vec<Vec<Block<'_>>> =
        channels.iter().zip(l_max).map(|(dense, l_max)| order_blocks(dense, l_max)).collect();
    let sums: Vec<&(dyn NormalSums + Sync)> =
        channels.iter().map(|dense| dense as &(dyn NormalSums + Sync)).collect();
    let joint = JointSums::new(&prior, sums, factors.clone());
    let scaled = scaled_blocks(&prior, &blocks, &factors);
    let rule = StoppingRule { residual_max: 1e-11, iterations_max: 500 };
    let request = JointRequest { rule, samples: 400, at_hz: Vec::new() };
    let watch = SolveWatch::default();
    let found = Posterior::new(&joint, &scaled, &request, watch.named("test")).unwrap();
    assert!(found.convergence.converged);

    let at_seven = prior.view_at(7e6).unwrap();
    let (expected, covariance) = posterior_of_dense([&scale[0], &scale[1], &at_seven.scale], &channels);
    let count = covariance.nrows();
    let views = [prior.view_of(0), prior.view_of(1), at_seven];
    let solved: Vec<f64> = views.iter().flat_map(|view| found.coefficients(view, &found.solution)).collect();
    // Mean and dipole between channels have another prior.
    let own = [(0, 0, 0), (1, 0, 0), (1, 1, 0), (1, 1, 1)].map(|(l, m, part)| 41 + index_of(3, l, m, part));
    for (i, value) in solved.iter().enumerate().filter(|(i, _)| !own.contains(i)) {
        // The iteration stops at 1e-11, and C^-1 loses some digits.
        assert!(
            (value - expected[(i, 0)]).abs() < 1e-7 * (1.0 + value.abs()),
            "{i}: {value} {}",
            expected[(i, 0)]
        );
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
    // Mean variance over pixels. Blocks neglect coupling, for which the ratio of samples corrects by degree.
    for (view, at) in views.iter().zip([0..25, 25..41]) {
        let map = found.map(view, 4).unwrap();
        let found: f64 = map.sigma_k.iter().map(|sigma| sigma * sigma).sum::<f64>() / 192.0;
        let trace: f64 = at.map(|i| covariance[(i, i)]).sum();
        let expected = trace / (4.0 * std::f64::consts::PI);
        assert!((found / expected - 1.0).abs() < 0.15, "{}: {found} {expected}", view.frequency_hz);
    }
}

/// The correlation of simulated skies is recovered.
#[test]
fn the_correlation_of_the_sky_is_found() {
    let truth = Correlation { length: 1.4, own_share: 0.03 };
    let frequencies_hz = vec![4e6, 6e6, 9e6];
    let scale = vec![vec![1.0; 11]; 3];
    let prior = Prior::new(frequencies_hz, scale, truth).unwrap();
    let mut normal = normal(5);
    let (_, count) = prior.offsets();
    let unit: Vec<f64> = (0..count).map(|_| normal()).collect();
    // Each coefficient is measured separately with an error of 0.01, so A = 1e4.
    let rights: Vec<Vec<f64>> = prior
        .skies(&unit)
        .into_iter()
        .map(|sky| sky.into_iter().map(|x| 1e4 * x + 1e2 * normal()).collect())
        .collect();
    let plain = prior.with_correlation(Correlation { length: 2.0, own_share: 1e-3 }).unwrap();
    let of = |(m, parity): (usize, usize)| {
        let degrees: Vec<usize> = (m + parity..=10).step_by(2).collect();
        let n = degrees.len();
        let matrix = Cow::Owned(Mat::from_fn(n, n, |i, j| if i == j { 1e4 } else { 0.0 }));
        let place = |part| degrees.iter().map(|l| index_of(10, *l, m, part)).collect();
        Block { matrix, places: (0..if m == 0 { 1 } else { 2 }).map(place).collect(), degrees }
    };
    let orders = (0..=10).flat_map(|m| [(m, 0), (m, 1)]).filter(|(m, parity)| m + parity <= 10);
    let blocks: Vec<Block<'_>> = orders.map(of).collect();
    let scaled = scaled_blocks(&plain, &[blocks.clone(), blocks.clone(), blocks], &[1.0; 3]);
    let watch = SolveWatch::default();
    let found = most_likely(&plain, &scaled, &rights, watch.named("test")).unwrap();
    // With 121 modes a single parameter's logarithm has an error of sqrt(2 / 121) = 0.13; three times that, and the last step.
    assert!((found.length / truth.length).ln().abs() < 0.5, "{found:?}");
    assert!((found.own_share / truth.own_share).ln().abs() < 0.8, "{found:?}");
}
