//! Symmetric linear filters of patterns along the nodes in u.

use faer::Mat;
use faer::prelude::*;
use rayon::prelude::*;

use super::Real;
use super::pattern::{NodeGrid, PatternTable, degree_count};
use crate::units::arithmetic::sinc;

const TAPS_PER_SIDE: usize = 10;
const SAMPLES_PER_TAP: usize = 12;

/// Patterns after a symmetric filter along the nodes, with both signs of mu interleaved.
#[derive(Clone, Debug)]
pub(crate) struct FilteredPatterns {
    pub(crate) grid: NodeGrid,
    /// By mu, for l = mu, mu + 2, ..: `f_{l,mu}` and `(-1)^mu f_{l,-mu}` node by node; padding at the end.
    orders: Vec<Vec<f32>>,
}

/// Padding after the last row, so that a full vector can be read from any node.
const PADDING: usize = 32;

impl FilteredPatterns {
    /// Additional nodes needed at each end.
    pub(crate) const MARGIN: usize = TAPS_PER_SIDE;

    /// Filters every coefficient as a function of u: the component `exp(2 pi i f k)` of node k is
    /// multiplied by `response(f) sinc(pi width(u) f)`, for f up to `band` cycles per node.
    pub(crate) fn new(
        mut table: PatternTable<f32>,
        band: f64,
        response: impl Fn(&[f64]) -> Vec<f64>,
        width: impl Fn(f64) -> f64,
    ) -> Self {
        let from = table.grid();
        let count = from.count - 2 * TAPS_PER_SIDE;
        let grid = NodeGrid { first: from.u(TAPS_PER_SIDE), step: from.step, count };
        let taps = fit_taps(grid, band, response, width);
        let l_max = table.l_max();
        let orders = table
            .orders_mut()
            .par_iter_mut()
            .enumerate()
            .map(|(mu, rows)| {
                let rows = std::mem::take(rows);
                let mut out = Vec::with_capacity(2 * count * degree_count(l_max, mu) + PADDING);
                for row in rows.chunks_exact(2 * from.count) {
                    let (plus, minus) = row.split_at(from.count);
                    for (k, taps) in taps.iter().enumerate() {
                        out.push(apply_taps(&plus[k..=k + 2 * TAPS_PER_SIDE], taps));
                        out.push(apply_taps(&minus[k..=k + 2 * TAPS_PER_SIDE], taps));
                    }
                }
                out.resize(out.len() + PADDING, 0.0);
                out
            })
            .collect();
        Self { grid, orders }
    }

    /// Returns the nodes, and the rows of each order mu as in [`Self::order`].
    pub(crate) fn into_orders(self) -> (NodeGrid, Vec<Vec<f32>>) {
        (self.grid, self.orders)
    }

    /// Rows of order mu: `2 count` values for each l = mu, mu + 2, .., followed by padding.
    pub(crate) fn order(&self, mu: usize) -> &[f32] {
        &self.orders[mu]
    }
}

#[inline]
fn apply_taps(values: &[f32], taps: &[f32; 2 * TAPS_PER_SIDE + 1]) -> f32 {
    let sum: f32 = values.iter().zip(taps).map(|(v, t)| v * t).sum();
    f32::table_entry(f64::from(sum))
}

/// Fits symmetric taps by least squares over the band; the spectrum outside is not constrained.
fn fit_taps(
    grid: NodeGrid,
    band: f64,
    response: impl Fn(&[f64]) -> Vec<f64>,
    width: impl Fn(f64) -> f64,
) -> Vec<[f32; 2 * TAPS_PER_SIDE + 1]> {
    let samples = SAMPLES_PER_TAP * TAPS_PER_SIDE;
    // Chebyshev spacing makes the fit as good at the ends of the band as in the middle.
    let frequency = |k: usize| band * (std::f64::consts::PI * (k as f64 + 0.5) / (2 * samples) as f64).cos();
    let basis = Mat::from_fn(samples, TAPS_PER_SIDE + 1, |k, j| {
        let wave = (std::f64::consts::TAU * frequency(k) * j as f64).cos();
        if j == 0 { 1.0 } else { 2.0 * wave }
    });
    let frequencies: Vec<f64> = (0..samples).map(frequency).collect();
    let response = response(&frequencies);
    let target = Mat::from_fn(samples, grid.count, |k, node| {
        let phase = std::f64::consts::PI * width(grid.u(node)) * frequencies[k];
        response[k] * sinc(phase)
    });
    let solution = basis.qr().solve_lstsq(&target);
    (0..grid.count)
        .map(|node| std::array::from_fn(|j| solution[(j.abs_diff(TAPS_PER_SIDE), node)] as f32))
        .collect()
}
