//! The sums as floating-point numbers: for each node in baseline length a torus in alpha and gamma.

use std::ops::Range;
use std::sync::Arc;

use rayon::prelude::*;

use super::grid::ALPHAS;
use super::grid::Grids;
use super::stored::{ReadRows, StoredTori, TorusPart};
use crate::ranks::Ranks;

/// The sums at one node, for the alphas that this process holds.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct NodeSums {
    /// `[alpha][diagonal][gamma]`: weights that couple this node with itself and with the nodes above, (K sr)^-2.
    pub(super) weights: Vec<f32>,
    /// `[alpha][data re, data im, noise re, noise im][gamma]`: right-hand sides, (K sr)^-1.
    pub(super) right: Vec<f32>,
}

/// The sums at all nodes; nodes without data take no memory.
#[derive(Clone, Debug, Default)]
pub(super) struct Tori {
    pub(super) nodes: Vec<Option<NodeSums>>,
    /// All sums, if they are on disk; `nodes` is empty then.
    pub(super) stored: Option<Arc<StoredTori>>,
}

/// The rows of all nodes for a block of alphas.
pub(super) enum BlockRows<'a> {
    Held {
        tori: &'a Tori,
        part: TorusPart,
        /// Offset of the block in each node's sums.
        first: usize,
        row: usize,
    },
    Read(ReadRows<'a>),
}

impl NodeSums {
    /// Right-hand sides alone.
    pub(super) fn of_right(right: Vec<f32>) -> Self {
        Self { weights: Vec::new(), right }
    }

    pub(super) fn part(&self, part: TorusPart) -> &[f32] {
        match part {
            TorusPart::Weights => &self.weights,
            TorusPart::Right => &self.right,
        }
    }
}

impl BlockRows<'_> {
    /// The row of a node at the alpha number `alpha` of the block, if it has data.
    #[inline]
    pub(super) fn row(&self, node: usize, alpha: usize) -> Option<&[f32]> {
        match self {
            Self::Held { tori, part, first, row } => {
                let sums = tori.nodes.get(node)?.as_ref()?.part(*part);
                sums.get(first + alpha * row..first + (alpha + 1) * row)
            }
            Self::Read(read) => read.row(node, alpha),
        }
    }
}

impl Tori {
    pub(super) fn in_memory(nodes: Vec<Option<NodeSums>>) -> Self {
        Self { nodes, stored: None }
    }

    pub(super) fn on_disk(stored: StoredTori) -> Self {
        Self { nodes: Vec::new(), stored: Some(Arc::new(stored)) }
    }

    /// The range of nodes with data on any rank.
    pub(super) fn reached(&self, ranks: &Ranks) -> Range<usize> {
        if let Some(stored) = &self.stored {
            return stored.reached();
        }
        let count = self.nodes.len();
        let first = self.nodes.iter().position(Option::is_some).unwrap_or(count);
        let last = self.nodes.iter().rposition(Option::is_some).map_or(0, |last| last + 1);
        let mut ends = [(count - first) as i64, last as i64];
        ranks.max(&mut ends);
        let [from_first, last] = ends.map(|end| end as usize);
        (count - from_first).min(last)..last
    }

    /// Whether each alpha of the grid of a part has data here.
    pub(super) fn alphas(&self, grids: &Grids, part: TorusPart) -> Vec<bool> {
        if let Some(stored) = &self.stored {
            return stored.alphas(part).to_vec();
        }
        let row = part.row(grids);
        let used = |alpha: usize| {
            grids.holds(alpha)
                && self.nodes.iter().flatten().any(|node| {
                    let from = grids.row(alpha) * row;
                    node.part(part)[from..from + row].iter().any(|x| *x != 0.0)
                })
        };
        (0..part.points(grids)).into_par_iter().map(used).collect()
    }

    /// The rows of a block of alphas that this process holds; `None` if they could not be read.
    pub(super) fn block(&self, grids: &Grids, part: TorusPart, block: usize) -> Option<BlockRows<'_>> {
        match &self.stored {
            Some(stored) => stored.block(part, block, part.row(grids)).map(BlockRows::Read),
            None => {
                let (row, first) = (part.row(grids), grids.row(block * ALPHAS));
                Some(BlockRows::Held { tori: self, part, first: first * row, row })
            }
        }
    }

    /// Whether the next product takes the blocks in reverse order. For sums on disk every second product does, because the blocks read last are
    /// still in the file cache.
    pub(super) fn next_is_reversed(&self) -> bool {
        self.stored.as_ref().is_some_and(|stored| stored.next_is_reversed())
    }

    /// Bytes of the weights that a product reads.
    pub(super) fn weight_bytes(&self, grids: &Grids) -> u64 {
        match &self.stored {
            Some(stored) => stored.weight_bytes(TorusPart::Weights.row(grids)),
            None => self.nodes.iter().flatten().map(|node| size_of_val(&node.weights[..]) as u64).sum(),
        }
    }
}
