//! Sums at the nodes in baseline length, ready to be used: for each a torus in alpha and gamma.

use rayon::prelude::*;

use super::grid::Grids;

/// The sums at one node.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Node {
    /// `[alpha][diagonal][gamma]`: weights of this node with itself and with the nodes above, (K sr)^-2.
    pub(super) weights: Vec<f32>,
    /// `[alpha][data re, data im, noise re, noise im][gamma]`, (K sr)^-1.
    pub(super) sides: Vec<f32>,
}

/// All nodes; those that no visibility has reached take no memory.
#[derive(Clone, Debug, Default, PartialEq)]
pub(super) struct Tori {
    pub(super) nodes: Vec<Option<Node>>,
}

impl Node {
    pub(super) fn zeros(grids: &Grids) -> Self {
        Self { weights: vec![0.0; grids.weights_len()], sides: vec![0.0; grids.sides_len()] }
    }
}

impl Tori {
    /// The nodes that hold something: the first, and one behind the last.
    pub(super) fn reached(&self) -> std::ops::Range<usize> {
        let first = self.nodes.iter().position(Option::is_some).unwrap_or(0);
        let last = self.nodes.iter().rposition(Option::is_some).map_or(first, |last| last + 1);
        first..last
    }

    /// Which alphas of a grid of `points` have data; `part` gives the sums on it and floats an alpha.
    pub(super) fn alphas(&self, points: usize, part: impl Fn(&Node) -> &[f32] + Sync) -> Vec<bool> {
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
