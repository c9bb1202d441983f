//! Patterns in the memory layout of the forward operator: block after block of nodes.

use rayon::prelude::*;

use super::filter::FilteredPatterns;
use super::pattern::{NodeGrid, degree_count};

pub(crate) const BLOCK_NODES: usize = 8;
/// Values of a block at one degree: both signs of mu at every node.
pub(crate) const PATTERN_LANES: usize = 2 * BLOCK_NODES;

/// A block at one degree, which fills a cache line.
#[derive(Clone, Copy, Debug, PartialEq)]
#[repr(align(64))]
pub(crate) struct PatternLanes(pub(crate) [f32; PATTERN_LANES]);

/// Patterns by blocks of nodes.
///
/// The degrees of a block are contiguous in memory. In rows over all nodes they would be kilobytes apart, and reading them
/// would take four times as long as the arithmetic.
#[derive(Clone, Debug)]
pub(crate) struct BlockedPatterns {
    pub(crate) grid: NodeGrid,
    /// By mu: `[block][l]`.
    orders: Vec<Vec<PatternLanes>>,
    l_max: usize,
}

impl BlockedPatterns {
    /// Reorders patterns of degrees up to `l_max`.
    pub(crate) fn new(patterns: FilteredPatterns, l_max: usize) -> Self {
        let (grid, orders) = patterns.into_orders();
        let blocks = grid.count.div_ceil(BLOCK_NODES);
        let orders = orders
            .into_par_iter()
            .enumerate()
            .map(|(mu, values)| {
                let rows = degree_count(l_max, mu);
                let mut out = vec![PatternLanes([0.0; PATTERN_LANES]); blocks * rows];
                for (row, values) in values.chunks_exact(2 * grid.count).take(rows).enumerate() {
                    for (block, values) in values.chunks(PATTERN_LANES).enumerate() {
                        out[block * rows + row].0[..values.len()].copy_from_slice(values);
                    }
                }
                out
            })
            .collect();
        Self { grid, orders, l_max }
    }

    /// Returns a block of order mu: one entry for each l = mu, mu + 2, ..
    #[inline]
    pub(crate) fn block(&self, mu: usize, block: usize) -> &[PatternLanes] {
        let rows = degree_count(self.l_max, mu);
        &self.orders[mu][block * rows..(block + 1) * rows]
    }
}
