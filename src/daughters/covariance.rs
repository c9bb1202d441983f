//! What the daughters' samples have in common, as it changes with frequency and time.
//!
//! A visibility is a smooth function of time and of the frequency's offset from the channel's centre: its
//! phase sweeps at most `2 pi |v| nu T / c` in a time T and `2 pi |b| dnu / c` over the channel. Both are
//! expanded by interpolation at Chebyshev points, as many as that sweep asks for: `z + 2.5 z^(1/3) + 2` for
//! a phase of +-z, which leaves 5e-4 of the visibility.

use std::collections::HashMap;
use std::sync::{Arc, Mutex, PoisonError};

use crate::array::Array;
use crate::array::response::kernel::fused;
use crate::frames::Channel;
use crate::mother::{ModelError, PairPosition, Prediction, VisibilityModel};
use crate::units::constants::SPEED_OF_LIGHT_M_S;
use crate::units::vector::{Vec3, add, norm, scale, sub};
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

/// Visibilities of one pair at each epoch, at Chebyshev points over the channel.
struct PairSeries {
    pair: Pair,
    /// Points over the channel.
    points: usize,
    /// K sr; by epoch: real parts at the points, then imaginary parts.
    values: Vec<f32>,
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

/// Interpolations from Chebyshev points in time to epochs, which channels and stretches have in common.
#[derive(Debug, Default)]
pub struct Tables(Mutex<TableMap>);

/// By numbers of instants and of epochs.
type TableMap = HashMap<(usize, usize), Arc<[f32]>>;

/// Most tables that are kept: some 200 kB each.
const TABLES_MAX: usize = 256;

impl Tables {
    /// The table of `instants` points for `count` epochs.
    fn get(&self, instants: usize, count: usize) -> Arc<[f32]> {
        let lock = || self.0.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(table) = lock().get(&(instants, count)) {
            return Arc::clone(table);
        }
        // Two threads may both make one; they are equal.
        let table: Arc<[f32]> = time_matrix(instants, count).into();
        let mut tables = lock();
        if tables.len() >= TABLES_MAX {
            tables.clear();
        }
        tables.insert((instants, count), Arc::clone(&table));
        table
    }
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
        let mut positions = Vec::new();
        for plan in &plans {
            plan.positions(request, &mut positions);
        }
        let steady = Plan::steady();
        for daughter in 0..daughters {
            positions.extend(steady.instants_s(request.epochs).map(|t_s| {
                // The plane of the orbit, which a dipole stands on, asks for two places: 1.5 m apart.
                let place = |t_s| request.array.position_m(daughter, t_s);
                PairPosition { r_i_m: place(t_s), r_j_m: place(t_s + 1e-3), span_rad: 0.0 }
            }));
        }
        let mut predictions = vec![Prediction::default(); positions.len()];
        model.predict(&positions, &mut predictions)?;
        let mut rest = &predictions[..];
        let mut series = Vec::with_capacity(plans.len());
        for plan in &plans {
            let (own, others) = rest.split_at(plan.instants * plan.points);
            rest = others;
            series.push(plan.series(request, own));
        }
        let matrix = request.tables.get(steady.instants, request.epochs.count);
        let powers = (0..daughters).map(|daughter| {
            let own: Vec<f32> = rest[daughter * steady.instants..][..steady.instants]
                .iter()
                .map(|p| (p.zero_spacing_k_sr + request.receiver_noise_k_sr) as f32)
                .collect();
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

    /// Pairs with their values at one epoch: points over the channel, and real and imaginary parts at them.
    pub fn at(&self, epoch: usize) -> impl Iterator<Item = (Pair, usize, &[f32])> {
        self.series.iter().map(move |series| {
            let points = series.points;
            (series.pair, points, &series.values[epoch * 2 * points..][..2 * points])
        })
    }

    /// Most points over the channel of any pair.
    #[must_use]
    pub fn points_max(&self) -> usize {
        self.series.iter().map(|series| series.points).max().unwrap_or(1)
    }
}

/// Where one pair is predicted.
struct Plan {
    pair: Pair,
    instants: usize,
    points: usize,
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
            instants: points_for(per_m * request.channel.frequency_hz * speed_m_s * half_s),
            points: points_for(per_m * length_m * 0.5 * request.channel.width_hz),
        }
    }

    /// For powers, which change as the Moon's limb moves over the sky.
    fn steady() -> Self {
        Self { pair: Pair::default(), instants: 6, points: 1 }
    }

    /// Chebyshev points over the epochs and one step on either side, s.
    fn instants_s(&self, epochs: Epochs) -> impl Iterator<Item = f64> {
        let half_s = 0.5 * epochs.step_s * (epochs.count + 1) as f64;
        let middle_s = epochs.start_s + half_s - epochs.step_s;
        chebyshev_points(self.instants).map(move |x| middle_s + half_s * x)
    }

    fn positions(&self, request: &Request<'_>, out: &mut Vec<PairPosition>) {
        let relative = 0.5 * request.channel.width_hz / request.channel.frequency_hz;
        for t_s in self.instants_s(request.epochs) {
            let r_i_m = request.array.position_m(self.pair.i.into(), t_s);
            let r_j_m = request.array.position_m(self.pair.j.into(), t_s);
            out.extend(chebyshev_points(self.points).map(|x| stretched(r_i_m, r_j_m, 1.0 + relative * x)));
        }
    }

    fn series(&self, request: &Request<'_>, predictions: &[Prediction]) -> PairSeries {
        let count = request.epochs.count;
        let width = 2 * self.points;
        let mut known = Vec::with_capacity(self.instants * width);
        for row in predictions.chunks_exact(self.points) {
            known.extend(row.iter().map(|p| p.visibility_k_sr.re as f32));
            known.extend(row.iter().map(|p| p.visibility_k_sr.im as f32));
        }
        let mut values = vec![0.0; count * width];
        let matrix = request.tables.get(self.instants, count);
        for (out, weights) in values.chunks_exact_mut(width).zip(matrix.chunks_exact(self.instants)) {
            combine(weights, &known, out);
        }
        PairSeries { pair: self.pair, points: self.points, values }
    }
}

/// Weights of the instants at each epoch, by epoch: interpolation, and sharpening for the blending of epochs.
fn time_matrix(instants: usize, count: usize) -> Vec<f32> {
    // Variance of a density cos^2 of half width 1, halved.
    let flattening = 0.5 * (1.0 / 3.0 - 2.0 / std::f64::consts::PI.powi(2));
    let points: Vec<f64> = chebyshev_points(instants).collect();
    let step = 2.0 / (count + 1) as f64;
    let mut weights = vec![0.0; (count + 2) * instants];
    for (k, row) in weights.chunks_exact_mut(instants).enumerate() {
        interpolate(&points, -1.0 + step * k as f64, row);
    }
    let sharpened = |k: usize| {
        let (before, here, after) = (weights[k - instants], weights[k], weights[k + instants]);
        (here - flattening * (after - 2.0 * here + before)) as f32
    };
    (instants..(count + 1) * instants).map(sharpened).collect()
}

/// `out = sum of weight x row`.
#[multiversion::multiversion(targets("x86_64+avx512f+avx512vl+fma", "x86_64+avx2+fma", "aarch64+neon"))]
fn combine(weights: &[f32], rows: &[f32], out: &mut [f32]) {
    const FMA: bool =
        multiversion::target::target_cfg_f!(any(target_feature = "fma", target_feature = "neon"));
    for (weight, row) in weights.iter().zip(rows.chunks_exact(out.len())) {
        for (out, value) in out.iter_mut().zip(row) {
            *out = fused::<FMA>(*weight, *value, *out);
        }
    }
}

/// Points that interpolate a phase of +-`z` to 5e-4.
fn points_for(z: f64) -> usize {
    (z + 2.5 * z.cbrt() + 2.0).ceil() as usize
}

/// Chebyshev points of the first kind between -1 and 1.
pub(super) fn chebyshev_points(count: usize) -> impl Iterator<Item = f64> {
    (0..count).map(move |k| (std::f64::consts::PI * (k as f64 + 0.5) / count as f64).cos())
}

/// Weights that interpolate values at Chebyshev points to `x` (the barycentric formula).
pub(super) fn interpolate(points: &[f64], x: f64, weights: &mut [f64]) {
    if let Some(exact) = points.iter().position(|point| *point == x) {
        weights.fill(0.0);
        weights[exact] = 1.0;
        return;
    }
    let mut total = 0.0;
    for ((weight, point), k) in weights.iter_mut().zip(points).zip(0..) {
        // sin of the point's angle, with alternating sign.
        let sign = if k % 2 == 0 { 1.0 } else { -1.0 };
        *weight = sign * (1.0 - point * point).sqrt() / (x - point);
        total += *weight;
    }
    for weight in weights {
        *weight /= total;
    }
}

/// A pair moved apart along its circle about the Moon until the chord is `factor` times as long.
///
/// At the centre's frequency it has the fringes that the pair has at `factor` times that. The Moon's limb
/// is moved by half the added length: 2e-5 rad for 100 km at 10 MHz, 1e-3 rad at 0.1 MHz.
pub(super) fn stretched(r_i_m: Vec3, r_j_m: Vec3, factor: f64) -> PairPosition {
    let (middle, half) = (scale(0.5, add(r_i_m, r_j_m)), scale(0.5 * factor, sub(r_i_m, r_j_m)));
    let (middle_m, half_m, radius_m) = (norm(middle), norm(half), norm(r_i_m));
    let depth_m = (radius_m * radius_m - half_m * half_m).max(0.0).sqrt();
    let centre = scale(depth_m / middle_m, middle);
    PairPosition { r_i_m: add(centre, half), r_j_m: sub(centre, half), span_rad: 0.0 }
}

#[cfg(test)]
mod tests {
    use super::*;
    use num_complex::Complex64;

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
            for (pair, points, values) in found.at(epoch) {
                let nodes: Vec<f64> = chebyshev_points(points).collect();
                let mut weights = vec![0.0; points];
                for x in [-1.0, -0.3, 0.9] {
                    interpolate(&nodes, x, &mut weights);
                    let part = |values: &[f32]| {
                        weights.iter().zip(values).map(|(w, v)| w * f64::from(*v)).sum::<f64>()
                    };
                    let value = Complex64::new(part(&values[..points]), part(&values[points..]));
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
