//! Sums on disk, which matrix products read by blocks of alphas.

use std::fs::File;
use std::io;
use std::ops::Range;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, OnceLock, PoisonError};

use super::grid::{Grids, NODES};
use crate::files::{nameless_file, read_at};

/// The two parts of a node's sums.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum TorusPart {
    Weights,
    Right,
}

impl TorusPart {
    pub(super) const BOTH: [Self; 2] = [Self::Weights, Self::Right];

    /// Number of points of the grid in alpha.
    pub(super) fn points(self, grids: &Grids) -> usize {
        match self {
            Self::Weights => grids.points,
            Self::Right => grids.data_points(),
        }
    }

    /// Number of elements of a row, which is of one node at one alpha.
    pub(super) fn row(self, grids: &Grids) -> usize {
        match self {
            Self::Weights => NODES * grids.weight_stride(),
            Self::Right => 4 * grids.data_stride(),
        }
    }
}

/// The rows of a block of alphas, read from disk.
pub(super) struct ReadRows<'a> {
    from: &'a StoredTori,
    values: Vec<f32>,
    /// Offset of each node with data.
    nodes: Vec<Option<usize>>,
    row: usize,
}

impl ReadRows<'_> {
    /// The row of a node at the alpha number `alpha` of the block, if it has data.
    #[inline]
    pub(super) fn row(&self, node: usize, alpha: usize) -> Option<&[f32]> {
        let first = (*self.nodes.get(node)?)? + alpha * self.row;
        self.values.get(first..first + self.row)
    }
}

impl Drop for ReadRows<'_> {
    fn drop(&mut self) {
        self.from.buffers().push(std::mem::take(&mut self.values));
    }
}

/// Sums of all nodes in an unnamed file, which the system deletes with the process. For each block of alphas and each node with data it holds
/// rows in f32.
#[derive(Debug)]
pub(super) struct StoredTori {
    pub(super) file: File,
    /// The folder of the file, for messages.
    folder: PathBuf,
    pub(super) end: u64,
    /// Weights and right-hand sides.
    pub(super) parts: [StoredPart; 2],
    /// The range of nodes with data.
    pub(super) reached: Range<usize>,
    /// Buffers for reuse, because allocating memory takes as long as reading into it.
    unused: Mutex<Vec<Vec<f32>>>,
    /// Whether the last product took the blocks in forward order.
    was_forward: AtomicBool,
    /// Why a block could not be read.
    failure: OnceLock<String>,
}

/// The weights of all nodes, or their right-hand sides.
#[derive(Debug, Default)]
pub(super) struct StoredPart {
    pub(super) blocks: Vec<StoredBlock>,
    /// Whether each alpha has data.
    pub(super) alphas: Vec<bool>,
}

/// One block of alphas.
#[derive(Clone, Debug, Default)]
pub(super) struct StoredBlock {
    pub(super) offset: u64,
    pub(super) alphas: usize,
    /// Nodes with data, in order.
    pub(super) nodes: Arc<Vec<usize>>,
}

impl StoredTori {
    /// Creates an empty file in a folder.
    pub(super) fn create(folder: &Path) -> io::Result<Self> {
        let file = nameless_file(folder)?;
        Ok(Self {
            file,
            folder: folder.to_owned(),
            end: 0,
            parts: Default::default(),
            reached: 0..0,
            unused: Mutex::default(),
            was_forward: AtomicBool::new(false),
            failure: OnceLock::new(),
        })
    }

    pub(super) fn reached(&self) -> Range<usize> {
        self.reached.clone()
    }

    /// Whether the next product takes the blocks in reverse order, which alternates.
    pub(super) fn next_is_reversed(&self) -> bool {
        self.was_forward.fetch_not(Ordering::Relaxed)
    }

    pub(super) fn alphas(&self, part: TorusPart) -> &[bool] {
        &self.parts[part as usize].alphas
    }

    /// Bytes of the weights, with rows of `row` elements.
    pub(super) fn weight_bytes(&self, row: usize) -> u64 {
        let rows = |block: &StoredBlock| block.nodes.len() * block.alphas;
        let [weights, _] = &self.parts;
        (weights.blocks.iter().map(rows).sum::<usize>() * row * size_of::<f32>()) as u64
    }

    /// Truncates the file, as a broken disk would.
    #[cfg(test)]
    pub(super) fn truncate(&self, bytes: u64) {
        self.file.set_len(bytes).unwrap();
    }

    pub(super) fn failure(&self) -> Option<&str> {
        self.failure.get().map(String::as_str)
    }

    fn buffers(&self) -> MutexGuard<'_, Vec<Vec<f32>>> {
        self.unused.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Reads the rows of a block, with `row` elements each; `None` if they cannot be read.
    pub(super) fn block(&self, part: TorusPart, block: usize, row: usize) -> Option<ReadRows<'_>> {
        if self.failure.get().is_some() {
            return None;
        }
        let block = self.parts[part as usize].blocks.get(block)?;
        let floats = block.alphas * row;
        let (mut values, length) = (self.buffers().pop().unwrap_or_default(), block.nodes.len() * floats);
        if values.capacity() < length {
            // A new buffer: old content need not be copied, and spare capacity not be allocated.
            values = Vec::new();
            values.reserve_exact(length);
        }
        values.resize(length, 0.0);
        if let Err(error) = read_at(&self.file, bytemuck::cast_slice_mut(&mut values), block.offset) {
            let reason = format!(
                "sums on disk in {}: {error}; expected to read what was written",
                self.folder.display()
            );
            self.failure.get_or_init(|| reason);
            return None;
        }
        let mut nodes = vec![None; block.nodes.last().map_or(0, |last| last + 1)];
        for (place, &node) in block.nodes.iter().enumerate() {
            nodes[node] = Some(place * floats);
        }
        Some(ReadRows { from: self, values, nodes, row })
    }
}
