//! Sums at the nodes in baseline length: for each a torus in alpha and gamma.

use rayon::prelude::*;

use super::grid::{Grids, NODES, OVERHANG};
use super::spread::{Located, Pending, spread};

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

    fn parts(&self) -> [&[f32]; 2] {
        [&self.weights, &self.sides]
    }

    fn parts_mut(&mut self) -> [&mut [f32]; 2] {
        [&mut self.weights, &mut self.sides]
    }

    /// Brings what lies beyond the rows' ends round to their starts.
    fn fold(&mut self, grids: &Grids) {
        let strides = [grids.weight_stride(), grids.data_stride()];
        for (part, stride) in self.parts_mut().into_iter().zip(strides) {
            for row in part.chunks_exact_mut(stride) {
                let (circle, beyond) = row.split_at_mut(stride - OVERHANG);
                // Memory that was never touched stays so.
                if beyond.iter().all(|x| *x == 0.0) {
                    continue;
                }
                for (sum, term) in circle.iter_mut().zip(beyond) {
                    *sum += *term;
                    *term = 0.0;
                }
            }
        }
    }
}

impl Tori {
    pub(super) fn zeros(grids: &Grids) -> Self {
        Self { nodes: vec![None; grids.nodes.count] }
    }

    /// Adds visibilities. Every sum takes its terms in their order, whatever the number of threads and
    /// however they come in calls.
    pub(super) fn add(&mut self, grids: &Grids, pending: &[Pending]) {
        let located: Vec<Located> = pending.par_iter().map(|p| Located::new(grids, p)).collect();
        let mut reaching: Vec<Vec<u32>> = vec![Vec::new(); self.nodes.len()];
        for (k, visibility) in located.iter().enumerate() {
            for list in reaching.iter_mut().skip(visibility.first_node).take(NODES) {
                list.push(k as u32);
            }
        }
        self.nodes.par_iter_mut().zip(&reaching).enumerate().for_each(|(index, (node, reaching))| {
            if reaching.is_empty() {
                return;
            }
            let node = node.get_or_insert_with(|| Node::zeros(grids));
            spread(grids, index, &located, reaching, node);
        });
    }

    /// Adds other sums `sign` times.
    pub(super) fn merge(&mut self, grids: &Grids, other: &Self, sign: f32) {
        self.nodes.par_iter_mut().zip(&other.nodes).for_each(|(node, other)| {
            let Some(other) = other else { return };
            let node = node.get_or_insert_with(|| Node::zeros(grids));
            for (sums, terms) in node.parts_mut().into_iter().zip(other.parts()) {
                sums.iter_mut().zip(terms).for_each(|(sum, term)| *sum += sign * term);
            }
        });
    }

    /// Brings every row's overhang home; needed before the sums are used.
    pub(super) fn fold(&mut self, grids: &Grids) {
        self.nodes.par_iter_mut().flatten().for_each(|node| node.fold(grids));
    }

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
