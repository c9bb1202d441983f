//! Sums on disk: those of a map whose sums memory does not hold. They are made part by part, by reading the data as many times, and a product
//! reads them once, block of alphas after block.

use std::fs::File;
use std::io;
use std::ops::Range;
use std::os::unix::fs::FileExt;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, OnceLock, PoisonError};

use rayon::prelude::*;

use super::HarmonicEngine;
use super::exact::{ExactNode, ExactTori, Quanta};
use super::grid::Grids;
use super::sums::HarmonicSums;
use super::tori::{BlockRows, Tori, TorusPart};
use super::workspace::ALPHAS;
use crate::accumulation::fixed_point::rows::IntegerRow;
use crate::accumulation::{AccumulationError, SumCounts};
use crate::files::nameless_file;
use crate::ranks::{RankShare, Ranks};

/// Sums of all nodes in a file that has no name, so that it goes with the process: of each block of alphas, of each node that has data,
/// row after row of its sums in f32.
#[derive(Debug)]
pub(super) struct StoredTori {
    file: File,
    /// The folder that it is in, for messages.
    folder: PathBuf,
    end: u64,
    /// By part of the sums.
    parts: [StoredPart; 2],
    /// Nodes of the grid that have data.
    reached: Range<usize>,
    /// Why a block could not be read.
    failure: OnceLock<String>,
}

/// The weights of all nodes, or their right-hand sides.
#[derive(Debug, Default)]
struct StoredPart {
    /// By block of alphas.
    blocks: Vec<StoredBlock>,
    /// Which alphas hold data.
    alphas: Vec<bool>,
}

/// One block of alphas.
#[derive(Clone, Debug, Default)]
struct StoredBlock {
    /// Where it begins in the file.
    offset: u64,
    /// Alphas in it.
    alphas: usize,
    /// Nodes that have data, in order.
    nodes: Arc<Vec<usize>>,
}

impl StoredTori {
    /// Without sums, in a folder.
    fn create(folder: &Path) -> io::Result<Self> {
        let file = nameless_file(folder)?;
        Ok(Self {
            file,
            folder: folder.to_owned(),
            end: 0,
            parts: Default::default(),
            reached: 0..0,
            failure: OnceLock::new(),
        })
    }

    pub(super) fn reached(&self) -> Range<usize> {
        self.reached.clone()
    }

    pub(super) fn alphas(&self, part: TorusPart) -> &[bool] {
        &self.parts[part as usize].alphas
    }

    /// Bytes of the weights with rows of so many floats.
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

    /// The rows of a block, with `row` floats each; `None` if they cannot be read.
    pub(super) fn block(&self, part: TorusPart, block: usize, row: usize) -> Option<BlockRows<'static>> {
        if self.failure.get().is_some() {
            return None;
        }
        let block = self.parts[part as usize].blocks.get(block)?;
        let floats = block.alphas * row;
        let mut values = vec![0.0_f32; block.nodes.len() * floats];
        if let Err(error) = self.file.read_exact_at(bytemuck::cast_slice_mut(&mut values), block.offset) {
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
        Some(BlockRows::Read { values, nodes, row })
    }

    /// Writes the sums that `grids` says are held, of which there are none yet, and frees them node by node.
    fn append(&mut self, grids: &Grids, quanta: Quanta, exact: ExactTori) -> io::Result<()> {
        let is_filled = |node: &Option<ExactNode>| node.as_ref().is_some_and(|node| !node.is_empty());
        let filled = exact.nodes.iter().enumerate().filter(|(_, node)| is_filled(node));
        let nodes: Arc<Vec<usize>> = Arc::new(filled.map(|(index, _)| index).collect());
        if let (Some(&first), Some(&last)) = (nodes.first(), nodes.last()) {
            let reached = if self.reached.is_empty() { first..last + 1 } else { self.reached.clone() };
            self.reached = reached.start.min(first)..reached.end.max(last + 1);
        }
        for part in [TorusPart::Weights, TorusPart::Right] {
            let (points, row) = (part.points(grids), part.row(grids));
            let stored = &mut self.parts[part as usize];
            stored.blocks.resize(points.div_ceil(ALPHAS), StoredBlock::default());
            stored.alphas.resize(points, false);
            for (number, block) in stored.blocks.iter_mut().enumerate() {
                if grids.share.holds(number) {
                    let alphas = ALPHAS.min(points - number * ALPHAS);
                    *block = StoredBlock { offset: self.end, alphas, nodes: Arc::clone(&nodes) };
                    self.end += (nodes.len() * alphas * row * size_of::<f32>()) as u64;
                }
            }
        }
        let held = exact.nodes.into_iter().flatten().filter(|node| !node.is_empty()).collect::<Vec<_>>();
        let written: Vec<[Vec<usize>; 2]> = held
            .into_par_iter()
            .enumerate()
            .map(|(place, node)| self.write_node(grids, quanta, place, node))
            .collect::<io::Result<_>>()?;
        for (used, part) in written.iter().flat_map(|parts| parts.iter().zip([0, 1])) {
            used.iter().for_each(|&alpha| self.parts[part].alphas[alpha] = true);
        }
        Ok(())
    }

    /// Writes a node, which is `place` among those that have data; returns the alphas at which it has any, by part.
    fn write_node(
        &self,
        grids: &Grids,
        quanta: Quanta,
        place: usize,
        node: ExactNode,
    ) -> io::Result<[Vec<usize>; 2]> {
        let ExactNode { weights, right } = node;
        let write = |part: TorusPart, rows: Vec<IntegerRow>, layout, quantum| -> io::Result<Vec<usize>> {
            let (row, mut used) = (part.row(grids), Vec::new());
            let blocks = &self.parts[part as usize].blocks;
            for (number, (rows, block)) in rows.chunks(ALPHAS).zip(blocks).enumerate() {
                if !grids.share.holds(number) {
                    continue;
                }
                let mut values = vec![0.0_f32; block.alphas * row];
                for (alpha, (out, integers)) in values.chunks_exact_mut(row).zip(rows).enumerate() {
                    integers.values(layout, quantum, out);
                    if out.iter().any(|x| *x != 0.0) {
                        used.push(number * ALPHAS + alpha);
                    }
                }
                let bytes: &[u8] = bytemuck::cast_slice(&values);
                self.file.write_all_at(bytes, block.offset + (place * bytes.len()) as u64)?;
            }
            Ok(used)
        };
        Ok([
            write(TorusPart::Weights, weights, grids.weight_row(), quanta.weight)?,
            write(TorusPart::Right, right, grids.data_row(), quanta.right)?,
        ])
    }
}

/// One of the parts in which the sums of a channel are made, by an engine each that takes all data: they wait on disk for one another.
#[derive(Clone, Debug)]
pub struct SumPart {
    share: RankShare,
    made: Arc<Mutex<Made>>,
}

/// What earlier parts have left.
#[derive(Debug)]
struct Made {
    folder: PathBuf,
    tori: Option<StoredTori>,
    counts: Option<SumCounts>,
}

impl SumPart {
    /// The first of some parts, which are kept in a folder until the map is solved.
    #[must_use]
    pub fn first(count: usize, folder: &Path) -> Self {
        let made = Made { folder: folder.to_owned(), tori: None, counts: None };
        Self { share: RankShare { rank: 0, count: count.max(1) }, made: Arc::new(Mutex::new(made)) }
    }

    /// The next one; `None` after the last.
    #[must_use]
    pub fn next(&self) -> Option<Self> {
        let RankShare { rank, count } = self.share;
        (rank + 1 < count)
            .then(|| Self { share: RankShare { rank: rank + 1, count }, made: Arc::clone(&self.made) })
    }

    /// What an engine of this part holds.
    pub(in crate::accumulation) fn ranks(&self) -> Ranks {
        Ranks::part(self.share)
    }
}

impl HarmonicEngine {
    /// Puts the sums of a part beside those before it; returns the whole sums after the last.
    ///
    /// # Errors
    /// Data that are not those of the parts before; the system's, in particular a full disk.
    pub fn finish_part(self, part: &SumPart) -> Result<Option<HarmonicSums>, AccumulationError> {
        let mut made = part.made.lock().unwrap_or_else(PoisonError::into_inner);
        let (basis, exact, counts) = self.into_exact();
        if made.counts.is_some_and(|before| before != counts) {
            return Err(AccumulationError::Mismatch { what: "data, of which each holds a part," });
        }
        made.counts = Some(counts);
        let folder = made.folder.clone();
        let unstored = |source| AccumulationError::Store { folder: folder.clone(), source };
        let mut tori = match made.tori.take() {
            Some(tori) => tori,
            None => StoredTori::create(&folder).map_err(unstored)?,
        };
        tori.append(&basis.grids, basis.quanta, exact).map_err(unstored)?;
        if part.next().is_some() {
            made.tori = Some(tori);
            return Ok(None);
        }
        Ok(Some(basis.whole().sums(Tori::stored(tori), counts)))
    }
}
