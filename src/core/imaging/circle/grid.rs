//! The grids of the harmonic engine's sums, and their spreading kernels.

use std::f64::consts::TAU;

use crate::imaging::exact::fixed_point::rows::RowLayout;
use crate::numerics::fft_length;
use crate::ranks::RankShare;
use crate::response::harmonic::NodeGrid;
use crate::response::harmonic::filter::FilteredPatterns;
use crate::response::harmonic::gridding_kernel::{Kernel, LANES};

/// Nodes in u per wavelength; the band |n_y| <= 1 of a pattern needs at least 2.
const NODES_PER_WAVELENGTH: f64 = 3.5;
/// Number of nodes in u that a visibility is spread to, which is also the number of diagonals of the weights.
pub(super) const NODES: usize = 5;
/// Number of nodes in a group: a cache line of patterns.
pub(super) const NODE_GROUP: usize = 8;
/// Number of alphas in a block. Each is a column of the matrix products for every sky.
pub(super) const ALPHAS: usize = 16;
/// Number of points in alpha that a weight is spread to.
const WEIGHT_ALPHAS: usize = 16;
/// Kaiser parameter of the weights' kernels, for ripples below 2e-4 of a weight at differences of orders up to 1.7 l_max.
const WEIGHT_BETA: f64 = 7.5;
/// Error of the data kernels in alpha and gamma.
const DATA_TOLERANCE: f64 = 1e-4;
/// Points of the weights' grid per degree. Products of two orders have differences up to 2 `l_max`. With 4.5 the largest differences lie where
/// the kernels' spectra fall, and degrees above `0.9 l_max` have errors of 3 to 30 %; with 4.75 errors are 3e-3, as at other degrees.
const POINTS_PER_DEGREE: f64 = 4.75;

/// Multiply-adds of gridding one visibility: pairs of nodes and alphas for weights, nodes and about 11 alphas for four
/// sums of data, each times the lanes of a kernel in gamma.
pub const SPREAD_MULTIPLY_ADDS: f64 =
    ((NODES * (NODES + 1) / 2 * WEIGHT_ALPHAS + NODES * 11 * 4) * LANES) as f64;

/// Multiply-adds of gridding a pair of draws of the errors by gains.
pub(super) const ERROR_PAIR_MULTIPLY_ADDS: f64 = (NODES * 11 * 4 * LANES) as f64;

/// Elements beyond the end of a row, into which a kernel may reach.
pub(super) const OVERHANG: usize = LANES;

/// Nodes in u, alpha and gamma, and the kernels between them.
#[derive(Clone, Debug)]
pub(super) struct Grids {
    /// Number of points in alpha and in gamma for weights; data have half as many.
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
        // Half of it is a fast FFT length too, and larger than 2 l_max + 1 orders.
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

    /// The number of nodes up to a baseline, wavelengths.
    pub(super) fn nodes_up_to(&self, wavelengths: f64) -> usize {
        (0..self.nodes.count).take_while(|k| self.nodes.u(*k) <= wavelengths).count()
    }

    /// The row number of an alpha that this process holds.
    #[inline(always)]
    pub(super) fn row(&self, alpha: usize) -> usize {
        alpha / ALPHAS / self.share.count * ALPHAS + alpha % ALPHAS
    }

    /// Number of rows that this process holds of a grid with this many alphas.
    pub(super) fn rows(&self, points: usize) -> usize {
        let blocks = points.div_ceil(ALPHAS);
        let missing = if self.share.holds(blocks - 1) { blocks * ALPHAS - points } else { 0 };
        self.share.block_count(blocks) * ALPHAS - missing
    }

    /// Number of points in alpha and in gamma for data.
    pub(super) fn data_points(&self) -> usize {
        self.points / 2
    }

    /// The inverse transform of the data kernel at the orders 0 ..= `l_max`, which corrects for the gridding.
    pub(super) fn data_correction(&self, l_max: usize) -> Vec<f64> {
        let frequencies: Vec<f64> = (0..=l_max).map(|m| m as f64 / self.data_points() as f64).collect();
        self.data.transforms(&frequencies).iter().map(|t| 1.0 / t).collect()
    }

    /// The nodes whose patterns are needed to filter the patterns at `nodes`.
    pub(super) fn table_nodes(&self) -> NodeGrid {
        let margin = FilteredPatterns::MARGIN;
        let NodeGrid { step, count, .. } = self.nodes;
        NodeGrid { first: self.nodes.u(0) - margin as f64 * step, step, count: count + 2 * margin }
    }

    /// Bytes of the sums at one node.
    pub(super) fn node_bytes(&self) -> u64 {
        (4 * (self.weights_len() + self.right_len())) as u64
    }

    /// The layout of a row of weights: `[diagonal][gamma]`.
    pub(super) fn weight_row(&self) -> RowLayout {
        RowLayout { stride: self.weight_stride(), parts: NODES, overhang: OVERHANG }
    }

    /// The layout of a row of data: `[data re, data im, noise re, noise im][gamma]`.
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

    /// Number of elements of a node's weights that this process holds: `[alpha][diagonal][gamma]`.
    pub(super) fn weights_len(&self) -> usize {
        self.rows(self.points) * NODES * self.weight_stride()
    }

    /// Number of elements of a node's right-hand sides that this process holds: `[alpha][data re, data im, noise re, noise im][gamma]`.
    pub(super) fn right_len(&self) -> usize {
        self.rows(self.data_points()) * 4 * self.data_stride()
    }

    /// The kernel at `angle_rad` on a circle of `points`: the first point that it covers, and its values.
    #[inline(always)]
    pub(super) fn kernel_at(kernel: &Kernel, points: usize, angle_rad: f64) -> (u32, [f32; LANES]) {
        let (first, lanes) = kernel.spread(angle_rad * (points as f64 / TAU));
        (first.rem_euclid(points as i64) as u32, lanes)
    }
}
