//! Exact gridded sums: integers at the nodes in baseline length, as rows of a torus.
//!
//! A term is a product that is rounded to a multiple of the quantum by adding `BIAS` in the same operation; the multiple is
//! the difference between the bits of the sum and those of the bias. Terms of a visibility that would exceed 2^21 quanta
//! are rounded to the quantum times a power of two instead, which keeps 21 bits. The power depends only on that visibility.

use rayon::prelude::*;

use super::grid::{Grids, NODES};
use super::quanta::{ExactNode, Quanta};
use super::spread::{GriddedVisibility, TorusPoint, add_visibilities};
use super::tori::Tori;
use crate::imaging::AccumulationError;
use crate::imaging::exact::checkpoint::refused;
use crate::imaging::exact::engine::Accepted;
use crate::imaging::exact::fixed_point::Direction;

/// Maximum total weight in units of the scale: its 2^62 quanta, and a sixteenth more for kernel values above one, fit 63 bits.
pub(super) const SCALES_MAX: f64 = 4_294_967_296.0 - 1.0; // 2^32

/// The sums at all nodes; nodes and alphas without data take no memory.
#[derive(Clone, Debug, Default)]
pub struct ExactTori {
    pub(super) nodes: Vec<Option<ExactNode>>,
}

impl ExactTori {
    pub(super) fn zeros(grids: &Grids) -> Self {
        Self { nodes: vec![None; grids.nodes.count] }
    }

    /// Adds visibilities or removes them, depending on the direction.
    pub(super) fn add(
        &mut self,
        grids: &Grids,
        quanta: Quanta,
        batch: &[Accepted<TorusPoint>],
        direction: Direction,
    ) {
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
        self.nodes.par_iter_mut().zip(&other.nodes).for_each(|(node, other)| {
            let Some(other) = other else { return };
            let node = node.get_or_insert_with(|| ExactNode::zeros(grids));
            for (rows, others) in [(&mut node.weights, &other.weights), (&mut node.right, &other.right)] {
                rows.iter_mut().zip(others).for_each(|(row, other)| row.combine(other, direction));
            }
        });
    }

    /// Adds sums of other alphas.
    pub(super) fn join(&mut self, grids: &Grids, other: &Self) -> Result<(), AccumulationError> {
        for (node, other) in self.nodes.iter().zip(&other.nodes) {
            let (Some(node), Some(other)) = (node, other) else { continue };
            let rows = node.weights.iter().chain(&node.right);
            let mut both = rows.zip(other.weights.iter().chain(&other.right));
            if both.any(|(row, other)| !row.is_empty() && !other.is_empty()) {
                return Err(refused("the same alphas in two parts".into(), "each alpha in one"));
            }
        }
        self.combine(grids, other, Direction::In);
        Ok(())
    }

    /// Converts the sums to f32.
    pub(super) fn values(&self, grids: &Grids, quanta: Quanta) -> Tori {
        let value = |node: &ExactNode| (!node.is_empty()).then(|| node.values(grids, quanta));
        Tori::in_memory(self.nodes.par_iter().map(|node| node.as_ref().and_then(value)).collect())
    }

    /// Converts the sums to f32, and frees the integers node by node.
    pub(super) fn into_values(self, grids: &Grids, quanta: Quanta) -> Tori {
        let value = |node: ExactNode| (!node.is_empty()).then(|| node.values(grids, quanta));
        Tori::in_memory(self.nodes.into_par_iter().map(|node| node.and_then(value)).collect())
    }
}
