//! Plan of the rows of B that are computed, and of those that are interpolated from them.
//!
//! With P(t) the axes that follow the normal z(t) of the pair's plane without rotation about it (parallel transport), and gamma(t)
//! the angle from their x to the pair's own x, the row of a pair at time t is
//!
//! ```text
//! V(t) = sum_mu exp(-i mu gamma(t)) g_mu(t)
//! ```
//!
//! where g depends on P, on the baseline's length and on the radii: slowly along an orbit, and smoothly however its plane,
//! altitude, pitch and yaw change. So g is computed at the Chebyshev points of a track of one pair, where positions are interpolated
//! from those of the visibilities, and interpolated in between by a polynomial. The number of points follows from the motion of the
//! pattern's phases; if it is not less than the number of visibilities, each row is computed on its own.

use std::ops::Range;

use num_complex::Complex64;

use super::antennas::PairResponse;
use super::classes::NodeClass;
use super::instants::{Instant, Instants};
use super::view::PairView;

/// Maximum step between times from which positions are interpolated, s: 0.09 rad of a low orbit, so that the error of positions is 0.1 mm.
pub(super) const POSITION_STEP_S_MAX: f64 = 120.0;

/// Number of rows that a task computes together, and whose patterns a product with `Bt W B` keeps: 0.3 MB each at l = 191.
pub(super) const GROUP_NODES: usize = 256;

/// A row that is computed.
#[derive(Clone, Copy, Debug)]
pub(super) struct RowNode {
    /// Rotation of a sky into P: angles about z, between the quarter turns, and about the new z.
    pub(super) turns_rad: [f64; 3],
    pub(super) view: PairView,
    /// Index of the node's class.
    pub(super) class: u32,
}

/// Consecutive visibilities of a pair, and the nodes of their rows.
#[derive(Clone, Debug)]
pub(super) struct Track {
    pub(super) rows: Range<usize>,
    pub(super) nodes: Range<usize>,
    /// Times of the nodes, -1 to 1; empty if each row has its own node.
    pub(super) tau: Vec<f64>,
    /// Barycentric weights of the nodes.
    pub(super) weights: Vec<f64>,
    /// Angles gamma of the nodes, rad, unwrapped; empty for instants.
    pub(super) gamma_rad: Vec<f64>,
    /// Motion of the phases of the fringe and of the limb's highest degree per unit of tau, rad; `None` for instants.
    pub(super) rate_rad: Option<[f64; 2]>,
}

/// Integration times and antenna responses.
#[derive(Clone, Copy, Default)]
pub struct ObservationDetails<'a> {
    /// Length of each integration, s, centred on the time of its positions; visibilities beyond the list are instants.
    pub duration_s: &'a [f32],
    /// Returns the factor of a visibility's pair on the setup's response, with a degree up to the setup's.
    pub response: Option<&'a (dyn Fn(usize) -> PairResponse + Sync)>,
}

/// Plan for computing the rows of a list of visibilities.
#[derive(Clone, Debug)]
pub struct RowPlan {
    pub(super) nodes: Vec<RowNode>,
    pub(super) tracks: Vec<Track>,
    /// Ranges of tracks, one per task.
    pub(super) groups: Vec<Range<usize>>,
    /// Angle gamma of each row, rad.
    pub(super) gamma_rad: Vec<f64>,
    /// Time of each row within its track, -1 to 1.
    pub(super) tau: Vec<f64>,
    /// Half of each row's integration in units of tau; empty for instants.
    pub(super) half_tau: Vec<f32>,
    /// Coefficients of each row's response; empty if rows have the setup's response.
    pub(super) coefficients: Vec<f32>,
    /// Number of averages that are replaced by instants.
    pub(super) instants: usize,
    pub(super) classes: Vec<NodeClass>,
    /// Whether each row is computed on its own, without shared frames.
    pub(super) direct: bool,
}

impl RowPlan {
    /// Number of rows.
    #[must_use]
    pub fn rows(&self) -> usize {
        self.gamma_rad.len()
    }

    /// Number of rows that are computed; the others are interpolated.
    #[must_use]
    pub fn computed(&self) -> usize {
        self.nodes.len()
    }

    /// Number of averages over integrations that are replaced by the instant in their middle, because their pair has too few
    /// visibilities nearby to determine its motion.
    #[must_use]
    pub fn instants(&self) -> usize {
        self.instants
    }

    /// Divides the tracks into groups, one per task.
    pub(super) fn group(&mut self) {
        let mut start = 0;
        let mut nodes = 0;
        for (k, track) in self.tracks.iter().enumerate() {
            nodes += track.nodes.len();
            if nodes >= GROUP_NODES || k + 1 == self.tracks.len() {
                self.groups.push(start..k + 1);
                (start, nodes) = (k + 1, 0);
            }
        }
    }

    /// Returns the quadrature instants of a row's integration.
    pub(super) fn instants_of<'a>(&self, track: &Track, row: usize, all: &'a Instants) -> &'a [Instant] {
        let half_tau = self.half_tau.get(row).map_or(0.0, |half_tau| f64::from(*half_tau));
        match track.rate_rad {
            Some(rates_rad) => all.for_phases(rates_rad.map(|rate_rad| rate_rad * half_tau)),
            None => all.middle(),
        }
    }

    /// Writes the weight of each node of a track in a row at an instant, and returns the row's angle gamma.
    pub(super) fn node_weights(
        &self,
        track: &Track,
        row: usize,
        instant: &Instant,
        node_weights: &mut Vec<f64>,
    ) -> f64 {
        let (tau, gamma_rad) = (self.tau[row], self.gamma_rad[row]);
        if instant.offset == 0.0 {
            track.node_weights(tau, node_weights);
            return gamma_rad;
        }
        let interpolated = |node_weights: &[f64]| -> f64 {
            node_weights.iter().zip(&track.gamma_rad).map(|(a, b)| a * b).sum()
        };
        track.node_weights(tau, node_weights);
        let middle_rad = interpolated(node_weights);
        track.node_weights(tau + f64::from(self.half_tau[row]) * instant.offset, node_weights);
        gamma_rad + interpolated(node_weights) - middle_rad
    }

    /// Appends a row's visibility of each sky to `out`, from the visibilities of the sky's products with monomials.
    pub(super) fn combine_products(&self, row: usize, products: &[Complex64], out: &mut [Vec<Complex64>]) {
        let count = products.len() / out.len().max(1);
        for (out, products) in out.iter_mut().zip(products.chunks_exact(count.max(1))) {
            out.push(match self.coefficients.is_empty() {
                true => products[0],
                false => self.row_coefficients(row, count).zip(products).map(|(a, value)| a * value).sum(),
            });
        }
    }

    /// The transpose of [`Self::combine_products`].
    pub(super) fn distribute_to_products(
        &self,
        row: usize,
        values: impl ExactSizeIterator<Item = Complex64>,
        out: &mut [Complex64],
    ) {
        let count = out.len() / values.len().max(1);
        for (out, value) in out.chunks_exact_mut(count.max(1)).zip(values) {
            match self.coefficients.is_empty() {
                true => out[0] = value,
                false => out
                    .iter_mut()
                    .zip(self.row_coefficients(row, count))
                    .for_each(|(out, a)| *out = a * value),
            }
        }
    }

    fn row_coefficients(&self, row: usize, count: usize) -> impl Iterator<Item = f64> {
        self.coefficients[row * count..][..count].iter().map(|a| f64::from(*a))
    }
}

/// Whether positions can be interpolated throughout an integration of this length, s.
pub(super) fn has_known_motion(duration_s: f64) -> bool {
    (0.0..=POSITION_STEP_S_MAX).contains(&duration_s)
}

impl Track {
    /// Writes the weight of each node at a time (barycentric Lagrange interpolation).
    pub(super) fn node_weights(&self, tau: f64, node_weights: &mut Vec<f64>) {
        node_weights.clear();
        if let Some(at) = self.tau.iter().position(|node| *node == tau) {
            node_weights.extend((0..self.tau.len()).map(|k| f64::from(u8::from(k == at))));
            return;
        }
        node_weights.extend(self.tau.iter().zip(&self.weights).map(|(node, weight)| weight / (tau - node)));
        let sum: f64 = node_weights.iter().sum();
        node_weights.iter_mut().for_each(|weight| *weight /= sum);
    }
}
