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

    /// Weights of one of its nodes with itself and with those above; the first node is 0.
    fn diagonals(&self, at: usize) -> [f32; NODES] {
        let mut diagonals = [0.0; NODES];
        for (diagonal, other) in diagonals.iter_mut().zip(&self.u[at..NODES]) {
            *diagonal = self.weight * self.u[at] * other;
        }
        diagonals
    }
}

/// Adds visibilities, in their order, to the sums at node `index`, which all of them reach.
///
/// Consecutive ones in one cell of the grid are added together in registers; that changes no bit.
pub(super) fn spread(grids: &Grids, index: usize, located: &[Located], reaching: &[u32], node: &mut Node) {
    let of = |k: &u32| &located[*k as usize];
    let cell = |k: &u32| (of(k).first_node, of(k).weight_first);
    for run in reaching.chunk_by(|a, b| cell(a) == cell(b)) {
        for group in run.chunks(GROUP) {
            let at = index - of(&group[0]).first_node;
            let rows = Rows {
                sums: &mut node.weights,
                stride: grids.weight_stride(),
                first: of(&group[0]).weight_first,
                points: grids.points,
                alphas: grids.weight_alpha.width(),
                used: NODES - at,
            };
            let mut terms = [Term::EMPTY; GROUP];
            for (term, k) in terms.iter_mut().zip(group) {
                let one = of(k);
                *term =
                    Term { values: one.diagonals(at), alphas: &one.weight_alpha, gammas: &one.weight_gamma };
            }
            spread_rows(rows, &terms[..group.len()]);
        }
    }
    let cell = |k: &u32| (of(k).first_node, of(k).data_first);
    for run in reaching.chunk_by(|a, b| cell(a) == cell(b)) {
        for group in run.chunks(GROUP) {
            let at = index - of(&group[0]).first_node;
            let rows = Rows {
                sums: &mut node.sides,
                stride: grids.data_stride(),
                first: of(&group[0]).data_first,
                points: grids.data_points(),
                alphas: grids.data.width(),
                used: 4,
            };
            let mut terms = [Term::EMPTY; GROUP];
            for (term, k) in terms.iter_mut().zip(group) {
                let one = of(k);
                let values = one.sides.map(|side| side * one.u[at]);
                *term = Term { values, alphas: &one.data_alpha, gammas: &one.data_gamma };
            }
            spread_rows(rows, &terms[..group.len()]);
        }
    }
}

/// Most visibilities that are added at once.
const GROUP: usize = 8;

/// Sums `[alpha][K][gamma]`, and the first point in alpha and gamma to add to.
struct Rows<'a> {
    sums: &'a mut [f32],
    stride: usize,
    first: [u32; 2],
    points: usize,
    /// Alphas that are reached.
    alphas: usize,
    /// Of K.
    used: usize,
}

/// One visibility's factors.
#[derive(Clone, Copy)]
struct Term<'a, const K: usize> {
    values: [f32; K],
    alphas: &'a [f32; LANES],
    gammas: &'a [f32; LANES],
}

impl<const K: usize> Term<'_, K> {
    const EMPTY: Self = Self { values: [0.0; K], alphas: &[0.0; LANES], gammas: &[0.0; LANES] };
}

/// Adds the outer products of values, alphas and gammas.
#[multiversion::multiversion(targets("x86_64+avx512f+avx512vl+fma", "x86_64+avx2+fma"))]
fn spread_rows<const K: usize>(rows: Rows<'_>, terms: &[Term<'_, K>]) {
    let [first, gamma] = rows.first.map(|x| x as usize);
    let mut alpha = first;
    for lane in 0..rows.alphas {
        for k in 0..rows.used {
            let start = (alpha * K + k) * rows.stride + gamma;
            let Some(sums) = rows.sums[start..].first_chunk_mut::<LANES>() else { return };
            let mut sum = *sums;
            for term in terms {
                let factor = term.values[k] * term.alphas[lane];
                for (sum, gamma) in sum.iter_mut().zip(term.gammas) {
                    *sum += factor * gamma;
                }
            }
            *sums = sum;
        }
        alpha = if alpha + 1 == rows.points { 0 } else { alpha + 1 };
    }
}
