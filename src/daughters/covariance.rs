//! What the daughters' samples have in common, as it changes with frequency and time.
//!
//! A visibility is a smooth function of time and of the frequency's offset from the channel's centre: its
//! phase sweeps at most `2 pi |v| nu T / c` in a time T and `2 pi |b| dnu / c` over the channel. Both are
//! interpolated from equally spaced nodes, as many as that sweep asks for ([`super::nodes`]).

use std::collections::HashMap;
use std::sync::{Arc, Mutex, PoisonError};

use num_complex::Complex64;

use super::nodes::{Basis, Interpolation, node, nodes_for};
use crate::array::Array;
use crate::array::response::Comb;
use crate::array::response::kernel::fused;
use crate::frames::Channel;
use crate::mother::{DaughterPosition, ModelError, PairPosition, VisibilityModel};
use crate::units::constants::SPEED_OF_LIGHT_M_S;
use crate::units::vector::{norm, sub};
use crate::units::{Pair, all_pairs};

/// Equally spaced instants at which covariances are wanted.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Epochs {
    /// The first, s.
    pub start_s: f64,
    /// Their distance, s.
    pub step_s: f64,
    /// Their number.
    pub count: usize,
}

/// Visibilities V_ji of one pair at each epoch, expanded over the channel.
pub(super) struct PairSeries {
    pub(super) pair: Pair,
    /// The functions of frequency.
    pub(super) basis: Arc<Basis>,
    /// Values from one epoch to the next: a multiple of `COLUMNS`.
    stride: usize,
    /// K sr; by epoch: coefficients of the real part, then of the imaginary part.
    values: Vec<f32>,
}

impl PairSeries {
    /// Coefficients of the real and of the imaginary part at one epoch.
    pub(super) fn at(&self, epoch: usize) -> (&[f32], &[f32]) {
        let nodes = self.basis.nodes();
        self.values[epoch * self.stride..][..2 * nodes].split_at(nodes)
    }
}

/// The covariance of all daughters in one channel, over frequency and some epochs.
///
/// Values are sharpened for the daughters' blending of epochs: with weights cos^2 the blend of two epochs
/// `h` apart flattens a second derivative by (1/3 - 2/pi^2) h^2 / 2, which is taken off beforehand.
pub struct Covariances {
    series: Vec<PairSeries>,
    /// Power of each daughter by epoch, receiver included, K sr.
    powers: Vec<Vec<f32>>,
}

/// Tables by what they are made for.
type Shared<K, T> = Mutex<HashMap<K, Arc<T>>>;

/// Interpolations over time and over the channel, which channels and stretches have in common.
#[derive(Debug, Default)]
pub struct Tables {
    /// By numbers of instants and of epochs.
    times: Shared<(usize, usize), [f32]>,
    /// By number of nodes.
    bases: Shared<usize, Basis>,
}

/// Most tables that are kept: some 100 kB each.
const TABLES_MAX: usize = 256;

impl Tables {
    /// Weights of `instants` nodes at `count` epochs and up to the next multiple of `EPOCHS`.
    fn times(&self, instants: usize, count: usize) -> Arc<[f32]> {
        shared(&self.times, (instants, count), || time_matrix(instants, count).into())
    }

    fn basis(&self, nodes: usize) -> Arc<Basis> {
        shared(&self.bases, nodes, || Arc::new(Basis::new(nodes)))
    }
}

/// The table of `key`, made if it is not there. Two threads may both make one; they are equal.
fn shared<K: Copy + Eq + std::hash::Hash, T: ?Sized>(
    tables: &Shared<K, T>,
    key: K,
    make: impl FnOnce() -> Arc<T>,
) -> Arc<T> {
    let lock = || tables.lock().unwrap_or_else(PoisonError::into_inner);
    if let Some(table) = lock().get(&key) {
        return Arc::clone(table);
    }
    let table = make();
    let mut tables = lock();
    if tables.len() >= TABLES_MAX {
        tables.clear();
    }
    tables.insert(key, Arc::clone(&table));
    table
}

/// Where a model of one channel is asked.
pub struct Request<'a> {
    /// The array.
    pub array: &'a Array,
    /// The channel's frequency and width.
    pub channel: Channel,
    /// Receiver noise of each daughter, K sr.
    pub receiver_noise_k_sr: f64,
    /// When.
    pub epochs: Epochs,
    /// Tables to be shared.
    pub tables: &'a Tables,
}

impl Covariances {
    /// Asks the model and interpolates to the epochs.
    ///
    /// # Errors
    /// [`ModelError`], for positions that the model does not cover.
    pub fn predict(model: &mut dyn VisibilityModel, request: &Request<'_>) -> Result<Self, ModelError> {
        let daughters = request.array.satellites();
        let plans: Vec<Plan> =
            all_pairs(daughters).into_iter().map(|pair| Plan::new(request, pair)).collect();
        let mut series = Vec::with_capacity(plans.len());
        for plan in &plans {
            series.push(plan.series(model, request)?);
        }
        let steady = Plan::steady();
        let mut positions = Vec::with_capacity(daughters * steady.instants);
        for daughter in 0..daughters {
            positions.extend(steady.instants_s(request.epochs).map(|t_s| DaughterPosition {
                r_m: request.array.position_m(daughter, t_s),
                normal_hat: request.array.orbit_normal_hat(t_s),
            }));
        }
        let mut predictions = vec![0.0; positions.len()];
        model.predict_powers(&positions, &mut predictions)?;
        let matrix = request.tables.times(steady.instants, request.epochs.count);
        let powers = predictions.chunks_exact(steady.instants).map(|own| {
            let own: Vec<f32> =
                own.iter().map(|power| (power + request.receiver_noise_k_sr) as f32).collect();
            matrix
                .chunks_exact(steady.instants)
                .map(|row| row.iter().zip(&own).map(|(a, b)| a * b).sum())
                .collect()
        });
        let powers = powers.collect();
        Ok(Self { series, powers })
    }

    /// Number of daughters.
    #[must_use]
    pub fn daughters(&self) -> usize {
        self.powers.len()
    }

    /// Power of a daughter, K sr.
    #[must_use]
    pub fn power(&self, daughter: usize, epoch: usize) -> f32 {
        self.powers[daughter][epoch]
    }

    /// All pairs.
    pub(super) fn pairs(&self) -> &[PairSeries] {
        &self.series
    }
}

/// Where one pair is predicted.
struct Plan {
    pair: Pair,
    instants: usize,
    /// Nodes over the channel.
    nodes: usize,
}

impl Plan {
    fn new(request: &Request<'_>, pair: Pair) -> Self {
        let Epochs { start_s, step_s, count } = request.epochs;
        let half_s = 0.5 * step_s * (count + 1) as f64;
        let middle_s = start_s + half_s - step_s;
        let (i, j) =
            (request.array.state(pair.i.into(), middle_s), request.array.state(pair.j.into(), middle_s));
        // Speeds and lengths change by less than 1 % in seconds.
        let per_m = 1.01 * std::f64::consts::TAU / SPEED_OF_LIGHT_M_S;
        let speed_m_s = norm(sub(i.velocity_m_s, j.velocity_m_s));
        let length_m = norm(sub(i.position_m, j.position_m));
        Self {
            pair,
            instants: nodes_for(per_m * request.channel.frequency_hz * speed_m_s * half_s),
            nodes: nodes_for(per_m * length_m * 0.5 * request.channel.width_hz),
        }
    }

    /// For powers, which change as the Moon's limb moves over the sky.
    fn steady() -> Self {
        Self { pair: Pair::default(), instants: 6, nodes: 1 }
    }

    /// Nodes over the epochs and one step on either side, s.
    fn instants_s(&self, epochs: Epochs) -> impl Iterator<Item = f64> {
        let half_s = 0.5 * epochs.step_s * (epochs.count + 1) as f64;
        let middle_s = epochs.start_s + half_s - epochs.step_s;
        (0..self.instants).map(move |k| middle_s + half_s * node(k, self.instants))
    }

    /// Asks the model at the instants, and interpolates to the epochs.
    fn series(
        &self,
        model: &mut dyn VisibilityModel,
        request: &Request<'_>,
    ) -> Result<PairSeries, ModelError> {
        let place = |n: u8, t_s| request.array.position_m(n.into(), t_s);
        let position = |t_s| PairPosition {
            r_i_m: place(self.pair.i, t_s),
            r_j_m: place(self.pair.j, t_s),
            span_rad: 0.0,
        };
        let positions: Vec<PairPosition> = self.instants_s(request.epochs).map(position).collect();
        let half = 0.5 * request.channel.width_hz / request.channel.frequency_hz;
        let step = 2.0 * half / (self.nodes - 1) as f64;
        let comb = Comb { first: -half, step, count: self.nodes };
        let mut found = vec![Complex64::ZERO; positions.len() * self.nodes];
        model.predict_comb(&positions, comb, &mut found)?;
        let basis = request.tables.basis(self.nodes);
        let stride = (2 * self.nodes).next_multiple_of(COLUMNS);
        let mut known = vec![0.0; self.instants * stride];
        for (row, found) in known.chunks_exact_mut(stride).zip(found.chunks_exact(self.nodes)) {
            let (re, rest) = row.split_at_mut(self.nodes);
            let (im, _) = rest.split_at_mut(self.nodes);
            // Below the diagonal stands V_ji, the conjugate.
            basis.coefficients(|k| found[k].re, re);
            basis.coefficients(|k| -found[k].im, im);
        }
        let matrix = request.tables.times(self.instants, request.epochs.count);
        let mut values = vec![0.0; matrix.len() / self.instants * stride];
        combine(&matrix, &known, stride, &mut values);
        Ok(PairSeries { pair: self.pair, basis, stride, values })
    }
}

/// Epochs and values that are interpolated together.
const EPOCHS: usize = 4;
const COLUMNS: usize = 8;

/// Weights of the instants at each epoch, by epoch: interpolation, and sharpening for the blending of epochs. Zeros
/// for what fills the last `EPOCHS`.
fn time_matrix(instants: usize, count: usize) -> Vec<f32> {
    // Variance of a density cos^2 of half width 1, halved.
    let flattening = 0.5 * (1.0 / 3.0 - 2.0 / std::f64::consts::PI.powi(2));
    let interpolation = Interpolation::new(instants);
    let step = 2.0 / (count + 1) as f64;
    let mut weights = vec![0.0; (count + 2) * instants];
    for (k, row) in weights.chunks_exact_mut(instants).enumerate() {
        interpolation.weights(-1.0 + step * k as f64, row);
    }
    let sharpened = |k: usize| {
        let (before, here, after) = (weights[k - instants], weights[k], weights[k + instants]);
        (here - flattening * (after - 2.0 * here + before)) as f32
    };
    let mut matrix: Vec<f32> = (instants..(count + 1) * instants).map(sharpened).collect();
    matrix.resize(count.next_multiple_of(EPOCHS) * instants, 0.0);
    matrix
}

/// `out = weights x rows`: rows of `stride`, as many of them as a row of `weights` has values.
#[multiversion::multiversion(targets("x86_64+avx512f+avx512vl+fma", "x86_64+avx2+fma", "aarch64+neon"))]
fn combine(weights: &[f32], rows: &[f32], stride: usize, out: &mut [f32]) {
    const FMA: bool =
        multiversion::target::target_cfg_f!(any(target_feature = "fma", target_feature = "neon"));
    let count = rows.len() / stride;
    for (out, weights) in out.chunks_exact_mut(EPOCHS * stride).zip(weights.chunks_exact(EPOCHS * count)) {
        let (first, rest) = weights.split_at(count);
        let (second, rest) = rest.split_at(count);
        let (third, fourth) = rest.split_at(count);
        for column in (0..stride).step_by(COLUMNS) {
            let mut sums = [[0.0_f32; COLUMNS]; EPOCHS];
            let own = first.iter().zip(second).zip(third.iter().zip(fourth));
            for (row, ((a, b), (c, d))) in rows.chunks_exact(stride).zip(own) {
                let Some(row) = row[column..].first_chunk::<COLUMNS>() else { continue };
                for (k, value) in row.iter().enumerate() {
                    sums[0][k] = fused::<FMA>(*a, *value, sums[0][k]);
                    sums[1][k] = fused::<FMA>(*b, *value, sums[1][k]);
                    sums[2][k] = fused::<FMA>(*c, *value, sums[2][k]);
                    sums[3][k] = fused::<FMA>(*d, *value, sums[3][k]);
                }
            }
            for (epoch, sums) in sums.iter().enumerate() {
                out[epoch * stride + column..][..COLUMNS].copy_from_slice(sums);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::mother::Prediction;
    use crate::units::vector::Vec3;

    /// A point source: V = exp(-2 pi i (nu / c) n . r_ij) at 20 MHz.
    struct Point(Vec3);

    const FREQUENCY_HZ: f64 = 20e6;

    fn fringe(n_hat: Vec3, frequency_hz: f64, r_i_m: Vec3, r_j_m: Vec3) -> Complex64 {
        let turns = frequency_hz / SPEED_OF_LIGHT_M_S * crate::units::vector::dot(n_hat, sub(r_i_m, r_j_m));
        Complex64::cis(-std::f64::consts::TAU * turns)
    }

    impl VisibilityModel for Point {
        fn predict(&mut self, positions: &[PairPosition], out: &mut [Prediction]) -> Result<(), ModelError> {
            for (out, at) in out.iter_mut().zip(positions) {
                let visibility_k_sr = fringe(self.0, FREQUENCY_HZ, at.r_i_m, at.r_j_m);
                *out = Prediction { visibility_k_sr, zero_spacing_k_sr: 1.0 };
            }
            Ok(())
        }

        fn predict_powers(&mut self, _: &[DaughterPosition], out: &mut [f64]) -> Result<(), ModelError> {
            out.fill(1.0);
            Ok(())
        }
    }

    #[test]
    fn covariances_follow_the_model_over_the_channel_and_between_epochs() {
        let array = Array::new(&crate::array::ArrayConfig::default()).unwrap();
        // Along the track of the array where it is, so that delays are as long as they get.
        let (from_s, step_s, count) = (5000.0, 8e-3, 257);
        let n_hat = crate::units::vector::unit(sub(array.position_m(0, from_s), array.position_m(7, from_s)));
        let request = Request {
            array: &array,
            channel: Channel { frequency_hz: FREQUENCY_HZ, width_hz: 8e3 },
            receiver_noise_k_sr: 0.5,
            epochs: Epochs { start_s: from_s, step_s, count },
            tables: &Tables::default(),
        };
        let found = Covariances::predict(&mut Point(n_hat), &request).unwrap();
        assert!((found.power(3, 100) - 1.5).abs() < 1e-5);
        for epoch in [0, 100, 256] {
            let t_s = from_s + step_s * epoch as f64;
            for series in found.pairs() {
                let pair = series.pair;
                let (re, im) = series.at(epoch);
                for x in [-1.0, -0.3, 0.9] {
                    // V_ij again.
                    let value = Complex64::new(series.basis.value(re, x), -series.basis.value(im, x));
                    let (i, j) = (array.state(pair.i.into(), t_s), array.state(pair.j.into(), t_s));
                    let frequency_hz = FREQUENCY_HZ + 4e3 * x;
                    let expected = fringe(n_hat, frequency_hz, i.position_m, j.position_m);
                    let apart = norm(sub(i.velocity_m_s, j.velocity_m_s));
                    // At most the sharpening, half of 0.1307 (omega h)^2, and twice the interpolations'.
                    let omega = std::f64::consts::TAU * frequency_hz / SPEED_OF_LIGHT_M_S * apart;
                    let sharpening = 0.5 * 0.1307 * (omega * step_s).powi(2);
                    let off = (value - expected).norm();
                    assert!(off < 1.02 * sharpening + 1e-3, "{pair} {x}: {off} {sharpening}");
                }
            }
        }
    }
}
