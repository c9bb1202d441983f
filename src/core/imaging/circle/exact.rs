//! Exact gridded sums: integers at the nodes in baseline length, as rows of a torus.
//!
//! A term is a product that is rounded to a multiple of the quantum by adding `BIAS` in the same operation; the multiple is
//! the difference between the bits of the sum and those of the bias. Terms of a visibility that would exceed 2^21 quanta
//! are rounded to the quantum times a power of two instead, which keeps 21 bits. The power depends only on that visibility.

use rayon::prelude::*;

use super::grid::{Grids, NODES};
use super::quanta::{ExactNode, Quanta, right_values};
use super::spread::{GriddedVisibility, TorusPoint, add_visibilities};
use super::tori::{NodeSums, Tori};
use crate::imaging::AccumulationError;
use crate::imaging::exact::checkpoint::refused;
use crate::imaging::exact::engine::Accepted;
use crate::imaging::exact::fixed_point::Direction;

/// The mean power of draws of the error of a visibility by its gains, in steps.
fn error_power(visibility: &Accepted<TorusPoint>) -> u128 {
    let draws = &visibility.gain_errors_k_sr;
    let power: f64 = draws.iter().map(|error| visibility.weight * error.norm_sqr()).sum();
    (power / draws.len().max(1) as f64 * ERROR_POWER_STEPS).round() as u128
}

/// Maximum total weight in units of the scale: its 2^62 quanta, and a sixteenth more for kernel values above one, fit 63 bits.
pub(super) const SCALES_MAX: f64 = 4_294_967_296.0 - 1.0; // 2^32

/// The sums at all nodes; nodes and alphas without data take no memory.
#[derive(Clone, Debug, Default)]
pub struct ExactTori {
    pub(super) nodes: Vec<Option<ExactNode>>,
    /// What errors by gains are expected to add to the power of the data, in steps of `ERROR_POWER_STEPS`: of all visibilities on each rank.
    pub(super) error_power: u128,
}

/// Steps per noise variance of the power of errors by gains: one visibility has at most 2^36, so there is room for 2^44 of them.
const ERROR_POWER_STEPS: f64 = 281_474_976_710_656.0; // 2^48

impl ExactTori {
    pub(super) fn zeros(grids: &Grids) -> Self {
        Self { nodes: vec![None; grids.nodes.count], error_power: 0 }
    }

    /// Adds visibilities or removes them, depending on the direction.
    pub(super) fn add(
        &mut self,
        grids: &Grids,
        quanta: Quanta,
        batch: &[Accepted<TorusPoint>],
        direction: Direction,
    ) {
        let power = batch.iter().map(error_power).fold(0, u128::wrapping_add);
        self.change_error_power(power, direction);
        let grid = |visibility| GriddedVisibility::new(grids, quanta, visibility, direction);
        let gridded: Vec<GriddedVisibility> = batch.par_iter().map(grid).collect();
        let mut reaching: Vec<Vec<&GriddedVisibility>> = vec![Vec::new(); self.nodes.len()];
        for visibility in gridded.iter().filter(|visibility| visibility.reaches(grids)) {
            for list in reaching.iter_mut().skip(visibility.first_node).take(NODES) {
                list.push(visibility);
            }
        }
        self.nodes.par_iter_mut().zip(&reaching).enumerate().for_each(|(index, (node, reaching))| {
            if reaching.is_empty() {
                return;
            }
            let node = node.get_or_insert_with(|| ExactNode::zeros(grids));
            add_visibilities(grids, direction, index, reaching, node);
        });
    }

    /// Adds other sums or removes them, depending on the direction.
    pub(super) fn combine(&mut self, grids: &Grids, other: &Self, direction: Direction) {
        self.change_error_power(other.error_power, direction);
        self.nodes.par_iter_mut().zip(&other.nodes).for_each(|(node, other)| {
            let Some(other) = other else { return };
            node.get_or_insert_with(|| ExactNode::zeros(grids)).combine(grids, other, direction);
        });
    }

    /// Adds sums of other alphas.
    pub(super) fn join(&mut self, grids: &Grids, other: &Self) -> Result<(), AccumulationError> {
        for (node, other) in self.nodes.iter().zip(&other.nodes) {
            let (Some(node), Some(other)) = (node, other) else { continue };
            if node.overlaps(other) {
                return Err(refused("the same alphas in two parts".into(), "each alpha in one"));
            }
        }
        let error_power = self.error_power;
        self.combine(grids, other, Direction::In);
        self.error_power = error_power;
        Ok(())
    }

    fn change_error_power(&mut self, power: u128, direction: Direction) {
        self.error_power = match direction {
            Direction::In => self.error_power.wrapping_add(power),
            Direction::Out => self.error_power.wrapping_sub(power),
        };
    }

    /// The power of errors by gains in units of the noise variance.
    pub(super) fn error_power(&self) -> f64 {
        self.error_power as f64 / ERROR_POWER_STEPS
    }

    /// Number of pairs of draws of the errors by gains.
    fn error_pairs(&self) -> usize {
        self.nodes.iter().flatten().map(ExactNode::error_pairs).max().unwrap_or(0)
    }

    /// Pairs of right-hand sides of draws of the errors by gains, in f32.
    pub(super) fn gain_errors(&self, grids: &Grids, quanta: Quanta) -> Vec<Tori> {
        let of_pair = |pair: usize| {
            let right = |node: &ExactNode| Some(right_values(node.gain_errors.get(pair)?, grids, quanta));
            let of_node = |node: &Option<ExactNode>| node.as_ref().and_then(right).map(NodeSums::of_right);
            Tori::in_memory(self.nodes.par_iter().map(of_node).collect())
        };
        (0..self.error_pairs()).map(of_pair).collect()
    }

    /// Converts the sums to f32.
    pub(super) fn values(&self, grids: &Grids, quanta: Quanta) -> Tori {
        let value = |node: &ExactNode| (!node.is_empty()).then(|| node.values(grids, quanta));
        Tori::in_memory(self.nodes.par_iter().map(|node| node.as_ref().and_then(value)).collect())
    }

    /// Converts the sums, and the pairs of draws, to f32, and frees the integers node by node.
    pub(super) fn into_values(self, grids: &Grids, quanta: Quanta) -> (Tori, Vec<Tori>) {
        let mut pairs = vec![Vec::with_capacity(self.nodes.len()); self.error_pairs()];
        let value = |node: ExactNode| {
            let draws = node.gain_errors.iter();
            let draws: Vec<NodeSums> =
                draws.map(|rows| NodeSums::of_right(right_values(rows, grids, quanta))).collect();
            (!node.is_empty()).then(|| (node.values(grids, quanta), draws))
        };
        let values: Vec<_> = self.nodes.into_par_iter().map(|node| node.and_then(value)).collect();
        let of_node = |found: Option<(NodeSums, Vec<NodeSums>)>| {
            let (values, draws) = found.unzip();
            let mut draws = draws.unwrap_or_default().into_iter();
            pairs.iter_mut().for_each(|pair| pair.push(draws.next()));
            values
        };
        let values = values.into_iter().map(of_node).collect();
        (Tori::in_memory(values), pairs.into_iter().map(Tori::in_memory).collect())
    }
}
