//! The covariance of the daughters' samples as a function of frequency and time.
//!
//! A visibility is a smooth function of time and of the frequency's offset from the channel's centre: its
//! phase sweeps at most `2 pi |v| nu T / c` in a time T and `2 pi |b| dnu / c` over the channel. Both are
//! interpolated from equally spaced nodes, as many as that sweep needs ([`crate::daughters::nodes`]).

use std::collections::HashMap;
use std::sync::{Arc, Mutex, PoisonError};

use num_complex::Complex64;

use super::epochs::{COLUMNS, EPOCHS, combine, time_matrix};
use super::nodes::{Basis, node, nodes_for};
use crate::array::Array;
use crate::frames::Channel;
use crate::response::model::{DaughterPosition, ModelError, PairPosition, VisibilityModel};
use crate::response::pixel::Comb;
use crate::units::constants::SPEED_OF_LIGHT_M_S;
use crate::units::vector::{norm, sub};
use crate::units::{Pair, all_pairs};

/// Equally spaced instants at which covariances are needed.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Epochs {
    /// Time of the first epoch, s.
    pub start_s: f64,
    /// Spacing of epochs, s.
    pub step_s: f64,
    /// Number of epochs.
    pub count: usize,
}

/// Location of the visibilities V_ji of one pair, as an expansion over the channel.
pub(super) struct PairSeries {
    pub(super) pair: Pair,
    /// Basis functions of frequency.
    pub(super) basis: Arc<Basis>,
    /// Index of the first coefficient within an epoch.
    at: usize,
}

impl PairSeries {
    /// Coefficients of the real and of the imaginary part, from the values of an epoch.
    pub(super) fn of<'a>(&self, epoch: &'a [f32]) -> (&'a [f32], &'a [f32]) {
        let nodes = self.basis.nodes();
        epoch[self.at..][..2 * nodes].split_at(nodes)
    }
}

/// The covariance of all daughters in one channel, over frequency and a range of epochs.
///
/// Values are corrected for the blending of epochs in the synthesis: with weights cos^2 the blend of two epochs
/// `h` apart flattens a second derivative by (1/3 - 2/pi^2) h^2 / 2, which is subtracted beforehand.
#[derive(Default)]
pub struct Covariances {
    daughters: usize,
    series: Vec<PairSeries>,
    /// Number of values per epoch, a multiple of `COLUMNS`.
    stride: usize,
    /// By epoch, K sr: the power of each daughter, receiver included; then, for each pair, the coefficients of the real
    /// part followed by those of the imaginary part.
    values: Vec<f32>,
}

/// Tables by key.
type TableCache<K, T> = Mutex<HashMap<K, Arc<T>>>;

/// Interpolation tables over time and over the channel, shared by all channels and chunks.
#[derive(Debug, Default)]
pub struct Tables {
    /// Keyed by the numbers of instants and of epochs.
    times: TableCache<(usize, usize), [f32]>,
    /// Keyed by the number of nodes.
    bases: TableCache<usize, Basis>,
}

/// Maximum number of tables kept; each takes some 100 kB.
const TABLES_MAX: usize = 256;

impl Tables {
    /// Weights of `instants` nodes at `count` epochs, padded to a multiple of `EPOCHS`.
    fn times(&self, instants: usize, count: usize) -> Arc<[f32]> {
        shared(&self.times, (instants, count), || time_matrix(instants, count).into())
    }

    fn basis(&self, nodes: usize) -> Arc<Basis> {
        shared(&self.bases, nodes, || Arc::new(Basis::new(nodes)))
    }
}

/// The table of `key`, made on first use. Two threads may both make it; the results are equal.
fn shared<K: Copy + Eq + std::hash::Hash, T: ?Sized>(
    tables: &TableCache<K, T>,
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

/// Inputs of a prediction of covariances.
pub struct CovarianceRequest<'a> {
    /// The array.
    pub array: &'a Array,
    /// The channel's frequency and width.
    pub channel: Channel,
    /// Receiver noise of each daughter, K sr.
    pub receiver_noise_k_sr: f64,
    /// Epochs.
    pub epochs: Epochs,
    /// Shared interpolation tables.
    pub tables: &'a Tables,
}

impl Covariances {
    /// Evaluates the model and interpolates to the epochs; reuses the memory of an earlier prediction.
    ///
    /// # Errors
    /// [`ModelError`], for positions that the model does not cover.
    pub fn predict(
        &mut self,
        model: &mut dyn VisibilityModel,
        request: &CovarianceRequest<'_>,
    ) -> Result<(), ModelError> {
        self.daughters = request.array.satellites();
        self.stride = self.daughters.next_multiple_of(COLUMNS);
        let mut grids = Vec::new();
        for pair in all_pairs(self.daughters) {
            let grid = PairGrid::new(request, pair, self.stride);
            self.stride += grid.width();
            grids.push(grid);
        }
        // Every value is overwritten below.
        self.values.resize(request.epochs.count.next_multiple_of(EPOCHS) * self.stride, 0.0);
        self.predict_powers(model, request)?;
        self.series.clear();
        for grid in &grids {
            let (basis, known) = grid.coefficients(model, request)?;
            let matrix = request.tables.times(grid.instants, request.epochs.count);
            combine(&matrix, &known, grid.width(), &mut self.values[grid.at..], self.stride);
            self.series.push(PairSeries { pair: grid.pair, basis, at: grid.at });
        }
        Ok(())
    }

    fn predict_powers(
        &mut self,
        model: &mut dyn VisibilityModel,
        request: &CovarianceRequest<'_>,
    ) -> Result<(), ModelError> {
        let steady = PairGrid::steady();
        let mut positions = Vec::with_capacity(self.daughters * steady.instants);
        for t_s in steady.instants_s(request.epochs) {
            let normal_hat = request.array.orbit_normal_hat(t_s);
            positions.extend((0..self.daughters).map(|daughter| DaughterPosition {
                r_m: request.array.position_m(daughter, t_s),
                normal_hat,
                daughter_time: Some((daughter as u8, t_s)),
            }));
        }
        let mut powers = vec![0.0; positions.len()];
        model.predict_powers(&positions, &mut powers)?;
        let width = self.daughters.next_multiple_of(COLUMNS);
        let mut known = vec![0.0; steady.instants * width];
        for (known, found) in known.chunks_exact_mut(width).zip(powers.chunks_exact(self.daughters)) {
            for (known, found) in known.iter_mut().zip(found) {
                *known = (found + request.receiver_noise_k_sr) as f32;
            }
        }
        let matrix = request.tables.times(steady.instants, request.epochs.count);
        combine(&matrix, &known, width, &mut self.values, self.stride);
        Ok(())
    }

    /// Number of daughters.
    #[must_use]
    pub fn daughters(&self) -> usize {
        self.daughters
    }

    /// Power of a daughter, K sr.
    #[cfg(test)]
    fn power(&self, daughter: usize, epoch: usize) -> f32 {
        self.epoch(epoch)[daughter]
    }

    /// The values of an epoch: powers by daughter, then the coefficients of the pairs.
    pub(super) fn epoch(&self, epoch: usize) -> &[f32] {
        &self.values[epoch * self.stride..][..self.stride]
    }

    /// All pairs.
    pub(super) fn pairs(&self) -> &[PairSeries] {
        &self.series
    }
}

/// The grid of instants and frequencies at which one pair is predicted.
struct PairGrid {
    pair: Pair,
    instants: usize,
    /// Number of nodes over the channel.
    nodes: usize,
    /// Index of the first coefficient within an epoch.
    at: usize,
}

impl PairGrid {
    fn new(request: &CovarianceRequest<'_>, pair: Pair, at: usize) -> Self {
        let Epochs { start_s, step_s, count } = request.epochs;
        let half_s = 0.5 * step_s * (count + 1) as f64;
        let middle_s = start_s + half_s - step_s;
        let (i, j) =
            (request.array.state(pair.i.into(), middle_s), request.array.state(pair.j.into(), middle_s));
        // Speeds and lengths change by less than 1 % within seconds.
        let per_m = 1.01 * std::f64::consts::TAU / SPEED_OF_LIGHT_M_S;
        let speed_m_s = norm(sub(i.velocity_m_s, j.velocity_m_s));
        let length_m = norm(sub(i.position_m, j.position_m));
        Self {
            pair,
            instants: nodes_for(per_m * request.channel.frequency_hz * speed_m_s * half_s),
            nodes: nodes_for(per_m * length_m * 0.5 * request.channel.width_hz),
            at,
        }
    }

    /// The grid for auto-correlations, which change only as the Moon's limb moves over the sky.
    fn steady() -> Self {
        Self { pair: Pair::default(), instants: 6, nodes: 1, at: 0 }
    }

    /// Number of coefficients of both parts, padded to a multiple of `COLUMNS`.
    fn width(&self) -> usize {
        (2 * self.nodes).next_multiple_of(COLUMNS)
    }

    /// Times of the nodes, s; they span the epochs and one step on either side.
    fn instants_s(&self, epochs: Epochs) -> impl Iterator<Item = f64> {
        let half_s = 0.5 * epochs.step_s * (epochs.count + 1) as f64;
        let middle_s = epochs.start_s + half_s - epochs.step_s;
        (0..self.instants).map(move |k| middle_s + half_s * node(k, self.instants))
    }

    /// Evaluates the model at the instants: basis functions of frequency, and `width` coefficients per instant.
    fn coefficients(
        &self,
        model: &mut dyn VisibilityModel,
        request: &CovarianceRequest<'_>,
    ) -> Result<(Arc<Basis>, Vec<f32>), ModelError> {
        let place = |n: u8, t_s| request.array.position_m(n.into(), t_s);
        let position = |t_s| PairPosition {
            r_i_m: place(self.pair.i, t_s),
            r_j_m: place(self.pair.j, t_s),
            span_rad: 0.0,
            pair_time: Some((self.pair, t_s)),
        };
        let positions: Vec<PairPosition> = self.instants_s(request.epochs).map(position).collect();
        let half = 0.5 * request.channel.width_hz / request.channel.frequency_hz;
        let step = 2.0 * half / (self.nodes - 1) as f64;
        let comb = Comb { first: -half, step, count: self.nodes };
        let mut found = vec![Complex64::ZERO; positions.len() * self.nodes];
        model.predict_comb(&positions, comb, &mut found)?;
        let basis = request.tables.basis(self.nodes);
        let mut known = vec![0.0; self.instants * self.width()];
        for (row, found) in known.chunks_exact_mut(self.width()).zip(found.chunks_exact(self.nodes)) {
            let (re, rest) = row.split_at_mut(self.nodes);
            let (im, _) = rest.split_at_mut(self.nodes);
            // The lower triangle holds V_ji, the conjugate.
            basis.coefficients(|k| found[k].re, re);
            basis.coefficients(|k| -found[k].im, im);
        }
        Ok((basis, known))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::units::vector::Vec3;

    /// A point source: V = exp(-2 pi i (nu / c) n . r_ij) at 20 MHz.
    struct Point(Vec3);

    const FREQUENCY_HZ: f64 = 20e6;

    fn fringe(n_hat: Vec3, frequency_hz: f64, r_i_m: Vec3, r_j_m: Vec3) -> Complex64 {
        let turns = frequency_hz / SPEED_OF_LIGHT_M_S * crate::units::vector::dot(n_hat, sub(r_i_m, r_j_m));
        Complex64::cis(-std::f64::consts::TAU * turns)
    }

    impl VisibilityModel for Point {
        fn predict(&mut self, positions: &[PairPosition], out: &mut [Complex64]) -> Result<(), ModelError> {
            for (out, at) in out.iter_mut().zip(positions) {
                *out = fringe(self.0, FREQUENCY_HZ, at.r_i_m, at.r_j_m);
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
        // A source along the array's track, where delays are longest.
        let (from_s, step_s, count) = (5000.0, 8e-3, 257);
        let n_hat = crate::units::vector::unit(sub(array.position_m(0, from_s), array.position_m(7, from_s)));
        let request = CovarianceRequest {
            array: &array,
            channel: Channel { frequency_hz: FREQUENCY_HZ, width_hz: 8e3 },
            receiver_noise_k_sr: 0.5,
            epochs: Epochs { start_s: from_s, step_s, count },
            tables: &Tables::default(),
        };
        let mut found = Covariances::default();
        found.predict(&mut Point(n_hat), &request).unwrap();
        assert!((found.power(3, 100) - 1.5).abs() < 1e-5);
        for epoch in [0, 100, 256] {
            let t_s = from_s + step_s * epoch as f64;
            for series in found.pairs() {
                let pair = series.pair;
                let (re, im) = series.of(found.epoch(epoch));
                for x in [-1.0, -0.3, 0.9] {
                    // V_ij again.
                    let value = Complex64::new(series.basis.value(re, x), -series.basis.value(im, x));
                    let (i, j) = (array.state(pair.i.into(), t_s), array.state(pair.j.into(), t_s));
                    let frequency_hz = FREQUENCY_HZ + 4e3 * x;
                    let expected = fringe(n_hat, frequency_hz, i.position_m, j.position_m);
                    let apart = norm(sub(i.velocity_m_s, j.velocity_m_s));
                    // At most the blending correction, half of 0.1307 (omega h)^2, and twice the error of interpolation.
                    let omega = std::f64::consts::TAU * frequency_hz / SPEED_OF_LIGHT_M_S * apart;
                    let sharpening = 0.5 * 0.1307 * (omega * step_s).powi(2);
                    let off = (value - expected).norm();
                    assert!(off < 1.02 * sharpening + 1e-3, "{pair} {x}: {off} {sharpening}");
                }
            }
        }
    }
}
