//! Sums at the nodes in baseline length as numbers: for each node a torus in alpha and gamma.

use rayon::prelude::*;

use super::grid::Grids;
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
#[derive(Clone, Debug, Default, PartialEq)]
pub(super) struct Tori {
    pub(super) nodes: Vec<Option<NodeSums>>,
}

impl NodeSums {
    pub(super) fn zeros(grids: &Grids) -> Self {
        Self { weights: vec![0.0; grids.weights_len()], right: vec![0.0; grids.right_len()] }
    }
}

impl Tori {
    /// The range of nodes that hold data, of any rank.
    pub(super) fn reached(&self, ranks: &Ranks) -> std::ops::Range<usize> {
        let count = self.nodes.len();
        let first = self.nodes.iter().position(Option::is_some).unwrap_or(count);
        let last = self.nodes.iter().rposition(Option::is_some).map_or(0, |last| last + 1);
        let mut ends = [(count - first) as i64, last as i64];
        ranks.greatest(&mut ends);
        let [from_first, last] = ends.map(|end| end as usize);
        (count - from_first).min(last)..last
    }

    /// Which alphas of a grid of `points` hold data here; `part` selects the sums.
    pub(super) fn alphas(
        &self,
        grids: &Grids,
        points: usize,
        part: impl Fn(&NodeSums) -> &[f32] + Sync,
    ) -> Vec<bool> {
        let used = |alpha: usize| {
            grids.holds(alpha)
                && self.nodes.iter().flatten().any(|node| {
                    let sums = part(node);
                    let row = sums.len() / grids.rows(points);
                    let from = grids.row(alpha) * row;
                    sums[from..from + row].iter().any(|x| *x != 0.0)
                })
        };
        (0..points).into_par_iter().map(used).collect()
    }
}
