//! Exact sums at the nodes in baseline length: integers, row by row of a torus.
//!
//! A term is a product, rounded to a multiple of the quantum by adding `BIAS` in the same operation; its multiple is
//! what the bits of the sum are above those of the bias. The terms of a visibility that would exceed 2^21 quanta
//! are rounded to the quantum times a power of two instead, which keeps 21 bits. The power depends on that visibility
//! alone.

use rayon::prelude::*;

use super::grid::{Grids, NODES};
use super::quanta::{ExactNode, Quanta};
use super::spread::{Located, TorusPoint, spread};
use super::tori::Tori;
use crate::imaging::AccumulationError;
use crate::imaging::exact::checkpoint::refused;
use crate::imaging::exact::engine::Accepted;
use crate::imaging::exact::fixed_point::Direction;

/// Most weight, in units of the scale: its 2^62 quanta, and a sixteenth more for what kernels reach above one, fit 63
/// bits.
pub(super) const SCALES_MAX: f64 = 4_294_967_296.0 - 1.0; // 2^32

/// All nodes; nodes and alphas that no visibility has reached take no memory.
#[derive(Clone, Debug, Default)]
pub struct ExactTori {
    pub(super) nodes: Vec<Option<ExactNode>>,
}

impl ExactTori {
    pub(super) fn zeros(grids: &Grids) -> Self {
        Self { nodes: vec![None; grids.nodes.count] }
    }

    /// Adds visibilities or removes them.
    pub(super) fn add(
        &mut self,
        grids: &Grids,
        quanta: Quanta,
        batch: &[Accepted<TorusPoint>],
        direction: Direction,
    ) {
        let locate = |visibility| Located::new(grids, quanta, visibility, direction);
        let located: Vec<Located> = batch.par_iter().map(locate).collect();
        let mut reaching: Vec<Vec<&Located>> = vec![Vec::new(); self.nodes.len()];
        for visibility in located.iter().filter(|visibility| visibility.reaches(grids)) {
            for list in reaching.iter_mut().skip(visibility.first_node).take(NODES) {
                list.push(visibility);
            }
        }
        self.nodes.par_iter_mut().zip(&reaching).enumerate().for_each(|(index, (node, reaching))| {
            if reaching.is_empty() {
                return;
            }
            let node = node.get_or_insert_with(|| ExactNode::zeros(grids));
            spread(grids, direction, index, reaching, node);
        });
    }

    /// Adds other sums, or removes them.
    pub(super) fn combine(&mut self, grids: &Grids, other: &Self, direction: Direction) {
        self.nodes.par_iter_mut().zip(&other.nodes).for_each(|(node, other)| {
            let Some(other) = other else { return };
            let node = node.get_or_insert_with(|| ExactNode::zeros(grids));
            for (rows, others) in [(&mut node.weights, &other.weights), (&mut node.right, &other.right)] {
                rows.iter_mut().zip(others).for_each(|(row, other)| row.combine(other, direction));
            }
        });
    }

    /// Takes in sums of other alphas.
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

    /// The sums in f32.
    pub(super) fn values(&self, grids: &Grids, quanta: Quanta) -> Tori {
        let value = |node: &ExactNode| (!node.is_empty()).then(|| node.values(grids, quanta));
        Tori::held(self.nodes.par_iter().map(|node| node.as_ref().and_then(value)).collect())
    }

    /// The sums in f32; their integers are freed node by node.
    pub(super) fn into_values(self, grids: &Grids, quanta: Quanta) -> Tori {
        let value = |node: ExactNode| (!node.is_empty()).then(|| node.values(grids, quanta));
        Tori::held(self.nodes.into_par_iter().map(|node| node.and_then(value)).collect())
    }
}
