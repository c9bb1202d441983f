//! Spreading visibilities onto the sums at the nodes.

use super::grid::{Grids, NODES};
use super::tori::Node;
use crate::array::harmonic::kernel::LANES;

/// A visibility as it waits to be spread.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Pending {
    /// Omega - pi/2, rad.
    pub(super) alpha_rad: f64,
    /// phi + pi/2, rad.
    pub(super) gamma_rad: f64,
    /// Baseline, wavelengths.
    pub(super) u: f64,
    /// Inverse variance, (K sr)^-2.
    pub(super) weight: f64,
    /// Weight times visibility, real and imaginary part; root of the weight times unit noise, likewise.
    pub(super) sides: [f64; 4],
}

/// A visibility's place on every grid.
#[derive(Clone, Debug)]
pub(super) struct Located {
    pub(super) first_node: usize,
    u: [f32; LANES],
    weight_first: [u32; 2],
    weight_alpha: [f32; LANES],
    weight_gamma: [f32; LANES],
    data_first: [u32; 2],
    data_alpha: [f32; LANES],
    data_gamma: [f32; LANES],
    weight: f32,
    sides: [f32; 4],
}

impl Located {
    /// `u` must lie within the grid.
    pub(super) fn new(grids: &Grids, pending: &Pending) -> Self {
        let (first_node, u) = grids.u.spread((pending.u - grids.nodes.first) / grids.nodes.step);
        let (points, data_points) = (grids.points, grids.data_points());
        let (a, weight_alpha) = Grids::on_circle(&grids.weight_alpha, points, pending.alpha_rad);
        let (g, weight_gamma) = Grids::on_circle(&grids.weight_gamma, points, pending.gamma_rad);
        let (da, data_alpha) = Grids::on_circle(&grids.data, data_points, pending.alpha_rad);
        let (dg, data_gamma) = Grids::on_circle(&grids.data, data_points, pending.gamma_rad);
        Self {
            first_node: first_node.max(0) as usize,
            u,
            weight_first: [a, g],
            weight_alpha,
            weight_gamma,
            data_first: [da, dg],
            data_alpha,
            data_gamma,
            weight: pending.weight as f32,
            sides: pending.sides.map(|x| x as f32),
        }
    }

    /// Adds to the sums at one of its nodes; the first is 0.
    pub(super) fn spread(&self, grids: &Grids, at: usize, node: &mut Node) {
        let mut diagonals = [0.0; NODES];
        for (diagonal, other) in diagonals.iter_mut().zip(&self.u[at..NODES]) {
            *diagonal = self.weight * self.u[at] * other;
        }
        let alphas = &self.weight_alpha[..grids.weight_alpha.width()];
        let weights = Rows {
            sums: &mut node.weights,
            stride: grids.weight_stride(),
            first: self.weight_first,
            points: grids.points,
        };
        spread_rows::<NODES>(weights, NODES - at, (&diagonals, alphas, &self.weight_gamma));
        let sides = self.sides.map(|side| side * self.u[at]);
        let alphas = &self.data_alpha[..grids.data.width()];
        let data = Rows {
            sums: &mut node.sides,
            stride: grids.data_stride(),
            first: self.data_first,
            points: grids.data_points(),
        };
        spread_rows::<4>(data, 4, (&sides, alphas, &self.data_gamma));
    }
}

/// Sums `[alpha][K][gamma]`, and the first point in alpha and gamma to add to.
struct Rows<'a> {
    sums: &'a mut [f32],
    stride: usize,
    first: [u32; 2],
    points: usize,
}

/// Adds the outer product of `values` (the first `used` of K), alphas and gammas.
#[multiversion::multiversion(targets("x86_64+avx512f+avx512vl+fma", "x86_64+avx2+fma"))]
fn spread_rows<const K: usize>(
    rows: Rows<'_>,
    used: usize,
    (values, alphas, gammas): (&[f32; K], &[f32], &[f32; LANES]),
) {
    let [first, gamma] = rows.first.map(|x| x as usize);
    let mut alpha = first;
    for weight in alphas {
        let start = alpha * K * rows.stride + gamma;
        for (k, value) in values[..used].iter().enumerate() {
            let factor = value * weight;
            let start = start + k * rows.stride;
            if let Some(sums) = rows.sums.get_mut(start..start + LANES) {
                for (sum, lane) in sums.iter_mut().zip(gammas) {
                    *sum += factor * lane;
                }
            }
        }
        alpha = if alpha + 1 == rows.points { 0 } else { alpha + 1 };
    }
}
