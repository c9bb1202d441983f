//! Sums on disk, as a product reads them: block of alphas after block.

use std::fs::File;
use std::io;
use std::ops::Range;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, OnceLock, PoisonError};

use super::grid::{Grids, NODES};
use crate::files::{nameless_file, read_at};

/// Which sums of a node.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum TorusPart {
    Weights,
    Right,
}

impl TorusPart {
    /// Points of the grid in alpha.
    pub(super) fn points(self, grids: &Grids) -> usize {
        match self {
            Self::Weights => grids.points,
            Self::Right => grids.data_points(),
        }
    }

    /// Floats of a row: of one node at one alpha.
    pub(super) fn row(self, grids: &Grids) -> usize {
        match self {
            Self::Weights => NODES * grids.weight_stride(),
            Self::Right => 4 * grids.data_stride(),
        }
    }
}

/// The rows of a block of alphas as they were read.
pub(super) struct ReadRows<'a> {
    from: &'a StoredTori,
    values: Vec<f32>,
    /// Where each node begins, of those that have data.
    nodes: Vec<Option<usize>>,
    row: usize,
}

impl ReadRows<'_> {
    /// The row of a node at the alpha `place` of the block, if it has data.
    #[inline]
    pub(super) fn row(&self, node: usize, place: usize) -> Option<&[f32]> {
        let first = (*self.nodes.get(node)?)? + place * self.row;
        self.values.get(first..first + self.row)
    }
}

impl Drop for ReadRows<'_> {
    fn drop(&mut self) {
        self.from.buffers().push(std::mem::take(&mut self.values));
    }
}

/// Sums of all nodes in a file that has no name, so that it goes with the process: of each block of alphas, of each node that has data,
/// row after row of its sums in f32.
#[derive(Debug)]
pub(super) struct StoredTori {
    pub(super) file: File,
    /// The folder that it is in, for messages.
    folder: PathBuf,
    pub(super) end: u64,
    /// By part of the sums.
    pub(super) parts: [StoredPart; 2],
    /// Nodes of the grid that have data.
    pub(super) reached: Range<usize>,
    /// Memory of blocks that were read: new memory costs as much as reading into it.
    unused: Mutex<Vec<Vec<f32>>>,
    /// Whether the last product took the blocks from the first to the last.
    forth: AtomicBool,
    /// Why a block could not be read.
    failure: OnceLock<String>,
}

/// The weights of all nodes, or their right-hand sides.
#[derive(Debug, Default)]
pub(super) struct StoredPart {
    /// By block of alphas.
    pub(super) blocks: Vec<StoredBlock>,
    /// Which alphas hold data.
    pub(super) alphas: Vec<bool>,
}

/// One block of alphas.
#[derive(Clone, Debug, Default)]
pub(super) struct StoredBlock {
    /// Where it begins in the file.
    pub(super) offset: u64,
    /// Alphas in it.
    pub(super) alphas: usize,
    /// Nodes that have data, in order.
    pub(super) nodes: Arc<Vec<usize>>,
}

impl StoredTori {
    /// Without sums, in a folder.
    pub(super) fn create(folder: &Path) -> io::Result<Self> {
        let file = nameless_file(folder)?;
        Ok(Self {
            file,
            folder: folder.to_owned(),
            end: 0,
            parts: Default::default(),
            reached: 0..0,
            unused: Mutex::default(),
            forth: AtomicBool::new(false),
            failure: OnceLock::new(),
        })
    }

    pub(super) fn reached(&self) -> Range<usize> {
        self.reached.clone()
    }

    /// Whether the next product is to take the blocks from the last to the first: the other way than the one before.
    pub(super) fn turns_back(&self) -> bool {
        self.forth.fetch_not(Ordering::Relaxed)
    }

    pub(super) fn alphas(&self, part: TorusPart) -> &[bool] {
        &self.parts[part as usize].alphas
    }

    /// Bytes of the weights with rows of this many floats.
    pub(super) fn weight_bytes(&self, row: usize) -> u64 {
        let rows = |block: &StoredBlock| block.nodes.len() * block.alphas;
        let [weights, _] = &self.parts;
        (weights.blocks.iter().map(rows).sum::<usize>() * row * size_of::<f32>()) as u64
    }

    /// Shortens the file, as a broken disk would.
    #[cfg(test)]
    pub(super) fn cut(&self, bytes: u64) {
        self.file.set_len(bytes).unwrap();
    }

    pub(super) fn failure(&self) -> Option<&str> {
        self.failure.get().map(String::as_str)
    }

    fn buffers(&self) -> MutexGuard<'_, Vec<Vec<f32>>> {
        self.unused.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// The rows of a block, with `row` floats each; `None` if they cannot be read.
    pub(super) fn block(&self, part: TorusPart, block: usize, row: usize) -> Option<ReadRows<'_>> {
        if self.failure.get().is_some() {
            return None;
        }
        let block = self.parts[part as usize].blocks.get(block)?;
        let floats = block.alphas * row;
        let (mut values, length) = (self.buffers().pop().unwrap_or_default(), block.nodes.len() * floats);
        if values.capacity() < length {
            // No copy of what is to be read over, and no more room than that.
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
