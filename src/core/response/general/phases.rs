//! Sums over mu of interpolated amplitudes, `V = sum_k weight_k sum_mu exp(-i mu gamma) g_{k mu}`, at many angles gamma.
//!
//! This is a non-uniform FFT (NUFFT): one FFT per node gives its sum at equally spaced angles, between which a gridding kernel
//! interpolates (see `response/harmonic/gridding_kernel.rs`). That costs a dozen angles with one multiply-add per node, where
//! interpolated amplitudes would take one for each mu.

use std::f64::consts::TAU;
use std::sync::Arc;

use num_complex::Complex64;
use rustfft::{Fft, FftPlanner};

use super::lanes::{LANES, Lanes};
use crate::numerics::fft_length;
use crate::response::harmonic::gridding_kernel::{Kernel, LANES as TAPS};

/// Error of the kernel relative to the largest value: below the rounding of patterns in f32.
const TOLERANCE: f64 = 1e-8;

/// Uniform grid of angles with twice as many points as a sum has orders.
#[derive(Clone)]
pub(super) struct PhaseGrid {
    l_max: usize,
    points: usize,
    kernel: Kernel,
    /// Reciprocal of the kernel's transform at each order, by mu + `l_max`.
    factors: Vec<f64>,
    forward: Arc<dyn Fft<f64>>,
    inverse: Arc<dyn Fft<f64>>,
}

/// Values of a track's nodes at all angles: `[angle][sky][real or imaginary part][node]`, nodes padded to whole vectors.
#[derive(Clone, Debug, Default)]
pub(super) struct PhaseTable {
    values: Vec<f64>,
    nodes: usize,
    skies: usize,
    line: Vec<Complex64>,
    scratch: Vec<Complex64>,
}

impl std::fmt::Debug for PhaseGrid {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("PhaseGrid")
            .field("l_max", &self.l_max)
            .field("points", &self.points)
            .finish_non_exhaustive()
    }
}

impl PhaseTable {
    /// Number of nodes, padded to whole vectors.
    fn padded(&self) -> usize {
        self.nodes.next_multiple_of(LANES)
    }

    fn stride(&self) -> usize {
        2 * self.skies * self.padded()
    }

    /// Copies the weights of nodes and pads them to whole vectors.
    fn pad_weights(&self, weights: &[f64], filled: &mut Vec<f64>) {
        filled.clear();
        filled.extend_from_slice(weights);
        filled.resize(self.padded(), 0.0);
    }
}

impl PhaseGrid {
    pub(super) fn new(l_max: usize) -> Self {
        let orders = 2 * l_max + 1;
        let points = fft_length(2 * orders).max(2 * TAPS);
        let kernel = Kernel::new(TOLERANCE, points as f64 / orders as f64);
        let frequency = |place: usize| (place as f64 - l_max as f64) / points as f64;
        let frequencies: Vec<f64> = (0..orders).map(frequency).collect();
        let factors = kernel.transforms(&frequencies).into_iter().map(f64::recip).collect();
        let mut planner = FftPlanner::new();
        let (forward, inverse) = (planner.plan_fft_forward(points), planner.plan_fft_inverse(points));
        Self { l_max, points, kernel, factors, forward, inverse }
    }

    pub(super) fn clear(&self, table: &mut PhaseTable, [nodes, skies]: [usize; 2]) {
        (table.nodes, table.skies) = (nodes, skies);
        table.values.clear();
        table.values.resize(self.points * table.stride(), 0.0);
        table.line.resize(self.points, Complex64::ZERO);
        let length = self.forward.get_inplace_scratch_len().max(self.inverse.get_inplace_scratch_len());
        table.scratch.resize(length, Complex64::ZERO);
    }

    /// FFT bin of order mu = `place` - `l_max`.
    fn bin(&self, place: usize) -> usize {
        (place + self.points - self.l_max) % self.points
    }

    /// Transforms amplitudes `[node][sky][real or imaginary part][mu + l_max]`, each part of `orders` values, to the angles of a table;
    /// `shape` is the number of nodes and of skies.
    pub(super) fn transform(
        &self,
        amplitudes: &[f64],
        orders: usize,
        shape: [usize; 2],
        table: &mut PhaseTable,
    ) {
        self.clear(table, shape);
        let (padded, stride, skies) = (table.padded(), table.stride(), table.skies);
        for (k, both) in amplitudes.chunks_exact(2 * orders).enumerate() {
            let (node, sky) = (k / skies, k % skies);
            let (re, im) = both.split_at(orders);
            table.line.fill(Complex64::ZERO);
            for (place, factor) in self.factors.iter().enumerate() {
                table.line[self.bin(place)] = factor * Complex64::new(re[place], im[place]);
            }
            self.forward.process_with_scratch(&mut table.line, &mut table.scratch);
            let first = 2 * sky * padded + node;
            for (values, z) in table.values.chunks_exact_mut(stride).zip(&table.line) {
                (values[first], values[first + padded]) = (z.re, z.im);
            }
        }
    }

    /// Adds the gradients of amplitudes to `out`, by the transpose of [`Self::transform`].
    pub(super) fn transform_transposed(&self, table: &mut PhaseTable, orders: usize, out: &mut [f64]) {
        let (padded, stride, skies) = (table.padded(), table.stride(), table.skies);
        for (k, both) in out.chunks_exact_mut(2 * orders).enumerate() {
            let (node, sky) = (k / skies, k % skies);
            let first = 2 * sky * padded + node;
            for (z, values) in table.line.iter_mut().zip(table.values.chunks_exact(stride)) {
                *z = Complex64::new(values[first], values[first + padded]);
            }
            self.inverse.process_with_scratch(&mut table.line, &mut table.scratch);
            let (re, im) = both.split_at_mut(orders);
            for (place, factor) in self.factors.iter().enumerate() {
                let z = factor * table.line[self.bin(place)];
                re[place] += z.re;
                im[place] += z.im;
            }
        }
    }

    /// Returns the first angle within the kernel's support about gamma, and the kernel at it and the following angles.
    fn kernel_at(&self, gamma_rad: f64) -> (usize, [f32; TAPS]) {
        let x = (gamma_rad / TAU).rem_euclid(1.0) * self.points as f64;
        let (first, lanes) = self.kernel.spread(x);
        (first.rem_euclid(self.points as i64) as usize, lanes)
    }

    /// Interpolates the value of each sky at an angle, with these weights of the nodes.
    pub(super) fn interpolate(
        &self,
        table: &PhaseTable,
        gamma_rad: f64,
        weights: &PaddedWeights,
        out: &mut [Complex64],
    ) {
        let (first, lanes) = self.kernel_at(gamma_rad);
        let (padded, stride) = (table.padded(), table.stride());
        let taps = &lanes[..self.kernel.width()];
        for (sky, out) in out.iter_mut().enumerate() {
            let [re, im] = [0, 1].map(|part| {
                let column = (2 * sky + part) * padded;
                gather(&table.values[column..], stride, first, self.points, taps, &weights.0)
            });
            *out = Complex64::new(re, im);
        }
    }

    /// Adds the values of each sky to a table, by the transpose of [`Self::interpolate`].
    pub(super) fn interpolate_transposed(
        &self,
        table: &mut PhaseTable,
        gamma_rad: f64,
        weights: &PaddedWeights,
        values: &[Complex64],
    ) {
        let (first, lanes) = self.kernel_at(gamma_rad);
        let (padded, stride) = (table.padded(), table.stride());
        let taps = &lanes[..self.kernel.width()];
        for (sky, value) in values.iter().enumerate() {
            for (part, value) in [value.re, value.im].into_iter().enumerate() {
                let column = (2 * sky + part) * padded;
                scatter(&mut table.values[column..], stride, first, self.points, taps, (&weights.0, value));
            }
        }
    }
}

/// Weights of a track's nodes in a row, padded to whole vectors.
#[derive(Clone, Debug, Default)]
pub(super) struct PaddedWeights(Vec<f64>);

impl PaddedWeights {
    pub(super) fn set(&mut self, table: &PhaseTable, weights: &[f64]) {
        table.pad_weights(weights, &mut self.0);
    }
}

/// Sums over taps and nodes of one column.
#[multiversion::multiversion(targets("x86_64+avx512f+avx512dq+avx512vl", "x86_64+avx2+fma"))]
fn gather(values: &[f64], stride: usize, first: usize, points: usize, taps: &[f32], weights: &[f64]) -> f64 {
    let mut sums: Lanes = [0.0; LANES];
    for (chunk, weights) in weights.chunks_exact(LANES).enumerate() {
        let mut row: Lanes = [0.0; LANES];
        let mut angle = first;
        for tap in taps {
            let tap = f64::from(*tap);
            let values = &values[angle * stride + chunk * LANES..][..LANES];
            for k in 0..LANES {
                row[k] += tap * values[k];
            }
            angle += 1;
            if angle == points {
                angle = 0;
            }
        }
        for k in 0..LANES {
            sums[k] += weights[k] * row[k];
        }
    }
    sums.iter().sum()
}

/// The transpose of [`gather`].
#[multiversion::multiversion(targets("x86_64+avx512f+avx512dq+avx512vl", "x86_64+avx2+fma"))]
fn scatter(
    values: &mut [f64],
    stride: usize,
    first: usize,
    points: usize,
    taps: &[f32],
    (weights, value): (&[f64], f64),
) {
    let mut angle = first;
    for tap in taps {
        let factor = f64::from(*tap) * value;
        let values = &mut values[angle * stride..][..weights.len()];
        for (values, weights) in values.chunks_exact_mut(LANES).zip(weights.chunks_exact(LANES)) {
            for k in 0..LANES {
                values[k] += factor * weights[k];
            }
        }
        angle += 1;
        if angle == points {
            angle = 0;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Compares the result for two skies at three nodes with the sums as they are written.
    #[test]
    fn sums_are_those_of_all_orders_and_the_transpose_is_one() {
        for l_max in [3, 40, 160] {
            let grid = PhaseGrid::new(l_max);
            let (nodes, skies, orders) = (11, 2, (2 * l_max + 1).next_multiple_of(LANES));
            let mut state = 7_u64;
            let mut random = || {
                state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
                (state >> 11) as f64 / (1_u64 << 53) as f64 - 0.5
            };
            let mut amplitudes = vec![0.0; nodes * skies * 2 * orders];
            for part in amplitudes.chunks_exact_mut(orders) {
                part[..2 * l_max + 1].iter_mut().for_each(|x| *x = random());
            }
            let mut table = PhaseTable::default();
            grid.transform(&amplitudes, orders, [nodes, skies], &mut table);
            let mut gradients = PhaseTable::default();
            grid.clear(&mut gradients, [nodes, skies]);
            let (mut weights, mut product) = (PaddedWeights::default(), 0.0);
            for k in 0..50 {
                let gamma_rad = 0.7 * f64::from(k) - 9.0;
                let node_weights: Vec<f64> = (0..nodes).map(|_| random()).collect();
                let mut found = [Complex64::ZERO; 2];
                weights.set(&table, &node_weights);
                grid.interpolate(&table, gamma_rad, &weights, &mut found);
                for (sky, found) in found.iter().enumerate() {
                    let mut expected = Complex64::ZERO;
                    for (node, weight) in node_weights.iter().enumerate() {
                        let g = &amplitudes[(node * skies + sky) * 2 * orders..];
                        for place in 0..=2 * l_max {
                            let turn = Complex64::cis(-(place as f64 - l_max as f64) * gamma_rad);
                            expected += weight * Complex64::new(g[place], g[orders + place]) * turn;
                        }
                    }
                    // A sum of 11 x 321 terms of 0.1: weights in f32 have errors of 6e-8, and the kernel 5e-8 of the largest sum.
                    let size = 0.1 * ((nodes * (2 * l_max + 1)) as f64).sqrt();
                    assert!((found - expected).norm() < 1e-6 * size, "{l_max}: {found} {expected}");
                }
                let values = [Complex64::new(random(), random()), Complex64::new(random(), random())];
                product += found.iter().zip(&values).map(|(a, b)| (a * b.conj()).re).sum::<f64>();
                grid.interpolate_transposed(&mut gradients, gamma_rad, &weights, &values);
            }
            let mut back = vec![0.0; amplitudes.len()];
            grid.transform_transposed(&mut gradients, orders, &mut back);
            let other: f64 = amplitudes.iter().zip(&back).map(|(a, b)| a * b).sum();
            // Both use the same rounded numbers.
            assert!((product - other).abs() < 1e-10 * (1.0 + product.abs()), "{l_max}: {product} {other}");
        }
    }
}
