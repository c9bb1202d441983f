//! Sums at the nodes in baseline length as numbers: for each node a torus in alpha and gamma.

use rayon::prelude::*;

use super::grid::Grids;

/// The sums at one node.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct NodeSums {
    /// `[alpha][diagonal][gamma]`: weights of this node with itself and with the nodes above, (K sr)^-2.
    pub(super) weights: Vec<f32>,
    /// `[alpha][data re, data im, noise re, noise im][gamma]`, (K sr)^-1.
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
    /// The range of nodes that hold data.
    pub(super) fn reached(&self) -> std::ops::Range<usize> {
        let first = self.nodes.iter().position(Option::is_some).unwrap_or(0);
        let last = self.nodes.iter().rposition(Option::is_some).map_or(first, |last| last + 1);
        first..last
    }

    /// Which alphas of a grid of `points` hold data; `part` selects the sums.
    pub(super) fn alphas(&self, points: usize, part: impl Fn(&NodeSums) -> &[f32] + Sync) -> Vec<bool> {
        let used = |alpha: usize| {
            self.nodes.iter().flatten().any(|node| {
                let sums = part(node);
                let row = sums.len() / points;
                sums[alpha * row..(alpha + 1) * row].iter().any(|x| *x != 0.0)
            })
        };
        (0..points).into_par_iter().map(used).collect()
    }
}
