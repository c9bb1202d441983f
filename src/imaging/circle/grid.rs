//! The grids of a harmonic engine's sums.

use std::f64::consts::TAU;

use crate::imaging::exact::fixed_point::rows::RowLayout;
use crate::numerics::fft_length;
use crate::ranks::RankShare;
use crate::response::harmonic::NodeGrid;
use crate::response::harmonic::filter::FilteredPatterns;
use crate::response::harmonic::gridding_kernel::{Kernel, LANES};

/// Nodes in u per wavelength; a pattern's band of |n_y| <= 1 needs 2.
const NODES_PER_WAVELENGTH: f64 = 3.5;
/// Nodes in u that a visibility is spread to, and so the number of diagonals of the sums of weights.
pub(super) const NODES: usize = 5;
/// Nodes of a group: a cache line of patterns.
pub(super) const NODE_GROUP: usize = 8;
/// Alphas of a block. Each of them is a column of the matrix products for every sky.
pub(super) const ALPHAS: usize = 16;
/// Nodes in alpha that a weight is spread to.
const WEIGHT_ALPHAS: usize = 16;
/// Kaiser parameter of the weights' kernels: ripples below 2e-4 of a weight, from differences of orders up to 1.7 l_max.
const WEIGHT_BETA: f64 = 7.5;
/// Error of the data's kernels in alpha and gamma.
const DATA_TOLERANCE: f64 = 1e-4;
/// Points of the weights' grid per degree: products of two sky orders have differences up to 2 `l_max`. At 4.5 those at the end fall where the
/// kernels do, and degrees from `0.9 l_max` on err by 3 to 30 %; at 4.75 by 3e-3, as all others.
const POINTS_PER_DEGREE: f64 = 4.75;

/// Multiply-adds of spreading one visibility: pairs of nodes and alphas of weights, nodes and about 11 alphas of four
/// sums of data, each over the lanes of a kernel in gamma.
pub const SPREAD_MULTIPLY_ADDS: f64 =
    ((NODES * (NODES + 1) / 2 * WEIGHT_ALPHAS + NODES * 11 * 4) * LANES) as f64;

/// Floats beyond a row's end, into which a kernel may reach.
pub(super) const OVERHANG: usize = LANES;

/// Nodes in u, alpha and gamma, and the kernels between them.
#[derive(Clone, Debug)]
pub(super) struct Grids {
    /// Points in alpha and in gamma of the sums of weights; those of the sums of data are half as many.
    pub(super) points: usize,
    pub(super) nodes: NodeGrid,
    pub(super) u: Kernel,
    pub(super) weight_alpha: Kernel,
    pub(super) weight_gamma: Kernel,
    pub(super) data: Kernel,
    /// The blocks of alphas whose sums this process holds.
    pub(super) share: RankShare,
}

impl Grids {
    pub(super) fn new(l_max: usize, u_max: f64) -> Self {
        let degrees = l_max as f64;
        // Half of it is a good length too, and holds 2 l_max + 1 orders with room to spare.
        let points =
            2 * fft_length((0.5 * POINTS_PER_DEGREE * degrees).max(2.0 * degrees + 16.0).ceil() as usize);
        let step = 1.0 / NODES_PER_WAVELENGTH;
        let count = (u_max / step).ceil() as usize + 2 * NODES;
        let nodes =
            NodeGrid { first: -(NODES as f64) * step, step, count: count.next_multiple_of(NODE_GROUP) };
        Self {
            points,
            nodes,
            u: Kernel::kaiser_bessel(NODES, 0.5 * NODES_PER_WAVELENGTH),
            weight_alpha: Kernel::windowed_sinc(WEIGHT_ALPHAS, WEIGHT_BETA),
            weight_gamma: Kernel::windowed_sinc(LANES, WEIGHT_BETA),
            data: Kernel::new(DATA_TOLERANCE, (points / 2) as f64 / (2 * l_max + 1) as f64),
            share: RankShare::WHOLE,
        }
    }

    /// Whether this process holds the sums at an alpha.
    #[inline(always)]
    pub(super) fn holds(&self, alpha: usize) -> bool {
        self.share.holds(alpha / ALPHAS)
    }

    /// The row of an alpha that this process holds.
    #[inline(always)]
    pub(super) fn row(&self, alpha: usize) -> usize {
        alpha / ALPHAS / self.share.count * ALPHAS + alpha % ALPHAS
    }

    /// Rows that this process holds of a grid with this many alphas.
    pub(super) fn rows(&self, points: usize) -> usize {
        let blocks = points.div_ceil(ALPHAS);
        let missing = if self.share.holds(blocks - 1) { blocks * ALPHAS - points } else { 0 };
        self.share.of(blocks) * ALPHAS - missing
    }

    /// Points in alpha and in gamma of the sums of data.
    pub(super) fn data_points(&self) -> usize {
        self.points / 2
    }

    /// One over the transform of the data's kernel at the orders 0 ..= `l_max`.
    pub(super) fn data_correction(&self, l_max: usize) -> Vec<f64> {
        let frequencies: Vec<f64> = (0..=l_max).map(|m| m as f64 / self.data_points() as f64).collect();
        self.data.transforms(&frequencies).iter().map(|t| 1.0 / t).collect()
    }

    /// The nodes whose patterns are needed to filter those at `nodes`.
    pub(super) fn table_nodes(&self) -> NodeGrid {
        let margin = FilteredPatterns::MARGIN;
        let NodeGrid { step, count, .. } = self.nodes;
        NodeGrid { first: self.nodes.u(0) - margin as f64 * step, step, count: count + 2 * margin }
    }

    /// Bytes of the sums at one node.
    pub(super) fn node_bytes(&self) -> u64 {
        (4 * (self.weights_len() + self.right_len())) as u64
    }

    /// Layout of a row of weights: `[diagonal][gamma]`.
    pub(super) fn weight_row(&self) -> RowLayout {
        RowLayout { stride: self.weight_stride(), parts: NODES, overhang: OVERHANG }
    }

    /// Layout of a row of data: `[data re, data im, noise re, noise im][gamma]`.
    pub(super) fn data_row(&self) -> RowLayout {
        RowLayout { stride: self.data_stride(), parts: 4, overhang: OVERHANG }
    }

    /// Length of one diagonal of a row of weights.
    pub(super) fn weight_stride(&self) -> usize {
        self.points + OVERHANG
    }

    /// Length of one part of a row of data.
    pub(super) fn data_stride(&self) -> usize {
        self.data_points() + OVERHANG
    }

    /// Floats of a node's weights that this process holds: `[alpha][diagonal][gamma]`.
    pub(super) fn weights_len(&self) -> usize {
        self.rows(self.points) * NODES * self.weight_stride()
    }

    /// Floats of a node's right-hand sides that this process holds: `[alpha][data re, data im, noise re, noise im][gamma]`.
    pub(super) fn right_len(&self) -> usize {
        self.rows(self.data_points()) * 4 * self.data_stride()
    }

    /// Where `angle_rad` lies on a circle of `points`: the first point a kernel reaches, and its values.
    #[inline(always)]
    pub(super) fn on_circle(kernel: &Kernel, points: usize, angle_rad: f64) -> (u32, [f32; LANES]) {
        let (first, lanes) = kernel.spread(angle_rad * (points as f64 / TAU));
        (first.rem_euclid(points as i64) as u32, lanes)
    }
}
