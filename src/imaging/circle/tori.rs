//! Sums at the nodes in baseline length as numbers: for each node a torus in alpha and gamma.

use std::ops::Range;
use std::sync::Arc;

use rayon::prelude::*;

use super::grid::ALPHAS;
use super::grid::Grids;
use super::stored::{ReadRows, StoredTori, TorusPart};
use crate::ranks::Ranks;

/// The sums at one node.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct NodeSums {
    /// `[alpha][diagonal][gamma]`, of the alphas that this process holds: weights of this node with itself and with the nodes above, (K sr)^-2.
    pub(super) weights: Vec<f32>,
    /// `[alpha][data re, data im, noise re, noise im][gamma]`, likewise, (K sr)^-1.
    pub(super) right: Vec<f32>,
}

/// All nodes; those that no visibility has reached take no memory.
#[derive(Clone, Debug, Default)]
pub(super) struct Tori {
    pub(super) nodes: Vec<Option<NodeSums>>,
    /// What is on disk, all of it; `nodes` are empty then.
    pub(super) stored: Option<Arc<StoredTori>>,
}

/// The rows of a block of alphas, of all nodes.
pub(super) enum BlockRows<'a> {
    Held {
        tori: &'a Tori,
        part: TorusPart,
        /// Where the block begins in each node's sums.
        first: usize,
        row: usize,
    },
    Read(ReadRows<'a>),
}

impl NodeSums {
    pub(super) fn zeros(grids: &Grids) -> Self {
        Self { weights: vec![0.0; grids.weights_len()], right: vec![0.0; grids.right_len()] }
    }

    fn part(&self, part: TorusPart) -> &[f32] {
        match part {
            TorusPart::Weights => &self.weights,
            TorusPart::Right => &self.right,
        }
    }
}

impl BlockRows<'_> {
    /// The row of a node at the alpha `place` of the block, if it has data.
    #[inline]
    pub(super) fn row(&self, node: usize, place: usize) -> Option<&[f32]> {
        match self {
            Self::Held { tori, part, first, row } => {
                let sums = tori.nodes.get(node)?.as_ref()?.part(*part);
                sums.get(first + place * row..first + (place + 1) * row)
            }
            Self::Read(read) => read.row(node, place),
        }
    }
}

impl Tori {
    pub(super) fn held(nodes: Vec<Option<NodeSums>>) -> Self {
        Self { nodes, stored: None }
    }

    pub(super) fn stored(stored: StoredTori) -> Self {
        Self { nodes: Vec::new(), stored: Some(Arc::new(stored)) }
    }

    /// The range of nodes that hold data, of any rank.
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

    /// Which alphas of the grid of a part hold data here.
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

    /// The rows of a block of alphas that is held here; `None` if they could not be read.
    pub(super) fn block(&self, grids: &Grids, part: TorusPart, block: usize) -> Option<BlockRows<'_>> {
        match &self.stored {
            Some(stored) => stored.block(part, block, part.row(grids)).map(BlockRows::Read),
            None => {
                let (row, first) = (part.row(grids), grids.row(block * ALPHAS));
                Some(BlockRows::Held { tori: self, part, first: first * row, row })
            }
        }
    }

    /// Whether the next product takes the blocks from the last to the first. Of sums on disk every second one does: what memory has kept
    /// of the file is what was read last.
    pub(super) fn turns_back(&self) -> bool {
        self.stored.as_ref().is_some_and(|stored| stored.turns_back())
    }

    /// Bytes of the weights that a product reads.
    pub(super) fn weight_bytes(&self, grids: &Grids) -> u64 {
        match &self.stored {
            Some(stored) => stored.weight_bytes(TorusPart::Weights.row(grids)),
            None => self.nodes.iter().flatten().map(|node| size_of_val(&node.weights[..]) as u64).sum(),
        }
    }
}
