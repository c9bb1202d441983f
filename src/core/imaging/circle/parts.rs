//! Sums that exceed memory: the data are read several times, and each reading accumulates one part of the sums, which is stored on disk.

use std::io;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, PoisonError};

use rayon::prelude::*;

use super::exact::ExactTori;
use super::grid::ALPHAS;
use super::grid::Grids;
use super::operator::SharedTori;
use super::quanta::{ExactNode, Quanta};
use super::stored::{StoredBlock, StoredTori, TorusPart};
use super::sums::{HarmonicSums, projected};
use super::tori::{NodeSums, Tori};
use super::{HarmonicBasis, HarmonicEngine};
use crate::files::write_at;
use crate::imaging::exact::fixed_point::rows::IntegerRow;
use crate::imaging::solver::add;
use crate::imaging::{AccumulationError, NormalSums, SumCounts};
use crate::ranks::{RankShare, Ranks};

impl StoredTori {
    /// Appends the sums of the share of `grids`, and frees them node by node.
    fn append(&mut self, grids: &Grids, quanta: Quanta, exact: ExactTori) -> io::Result<()> {
        let has_data = |node: &Option<ExactNode>| node.as_ref().is_some_and(|node| !node.is_empty());
        let filled = exact.nodes.iter().enumerate().filter(|(_, node)| has_data(node));
        self.reserve(grids, filled.map(|(index, _)| index).collect());
        let held = exact.nodes.into_iter().flatten().filter(|node| !node.is_empty()).collect::<Vec<_>>();
        let written: Vec<[Vec<usize>; 2]> = held
            .into_par_iter()
            .enumerate()
            .map(|(index, node)| self.write_node(grids, quanta, index, node))
            .collect::<io::Result<_>>()?;
        for (used, part) in written.iter().flat_map(|parts| parts.iter().zip([0, 1])) {
            used.iter().for_each(|&alpha| self.parts[part].alphas[alpha] = true);
        }
        Ok(())
    }

    /// Assigns places in the file to the blocks of the share of `grids`, with these nodes.
    fn reserve(&mut self, grids: &Grids, nodes: Vec<usize>) {
        if let (Some(&first), Some(&last)) = (nodes.first(), nodes.last()) {
            let reached = if self.reached.is_empty() { first..last + 1 } else { self.reached.clone() };
            self.reached = reached.start.min(first)..reached.end.max(last + 1);
        }
        let nodes = Arc::new(nodes);
        for part in TorusPart::BOTH {
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
    }

    /// Writes complete sums to a new file in a folder.
    fn of_memory(grids: &Grids, tori: &Tori, folder: &Path) -> io::Result<Self> {
        let mut stored = Self::create(folder)?;
        let filled: Vec<(usize, &NodeSums)> =
            tori.nodes.iter().enumerate().filter_map(|(index, node)| Some((index, node.as_ref()?))).collect();
        stored.reserve(grids, filled.iter().map(|(index, _)| *index).collect());
        for part in TorusPart::BOTH {
            let row = part.row(grids);
            for (number, block) in stored.parts[part as usize].blocks.iter().enumerate() {
                let first = number * ALPHAS * row;
                for (index, (_, node)) in filled.iter().enumerate() {
                    let bytes: &[u8] =
                        bytemuck::cast_slice(&node.part(part)[first..first + block.alphas * row]);
                    write_at(&stored.file, bytes, block.offset + (index * bytes.len()) as u64)?;
                }
            }
            stored.parts[part as usize].alphas = tori.alphas(grids, part);
        }
        Ok(stored)
    }

    /// Writes the `index`-th node with data, and returns its alphas with data, by part.
    fn write_node(
        &self,
        grids: &Grids,
        quanta: Quanta,
        index: usize,
        node: ExactNode,
    ) -> io::Result<[Vec<usize>; 2]> {
        let ExactNode { weights, right, .. } = node;
        let write = |part: TorusPart, rows: Vec<IntegerRow>, layout, quantum| -> io::Result<Vec<usize>> {
            let (row, mut used) = (part.row(grids), Vec::new());
            let blocks = &self.parts[part as usize].blocks;
            for (number, (rows, block)) in rows.chunks(ALPHAS).zip(blocks).enumerate() {
                if !grids.share.holds(number) {
                    continue;
                }
                let mut values = vec![0.0_f32; block.alphas * row];
                for (alpha, (out, integers)) in values.chunks_exact_mut(row).zip(rows).enumerate() {
                    integers.write_values(layout, quantum, out);
                    if out.iter().any(|x| *x != 0.0) {
                        used.push(number * ALPHAS + alpha);
                    }
                }
                let bytes: &[u8] = bytemuck::cast_slice(&values);
                write_at(&self.file, bytes, block.offset + (index * bytes.len()) as u64)?;
            }
            Ok(used)
        };
        Ok([
            write(TorusPart::Weights, weights, grids.weight_row(), quanta.weight)?,
            write(TorusPart::Right, right, grids.data_row(), quanta.right)?,
        ])
    }
}

/// One of the parts in which the sums of a channel are accumulated. An engine for each part receives all data; finished parts are on disk.
#[derive(Clone, Debug)]
pub struct SumPart {
    share: RankShare,
    finished: Arc<Mutex<FinishedParts>>,
}

/// The finished parts.
#[derive(Debug)]
struct FinishedParts {
    folder: PathBuf,
    tori: Option<StoredTori>,
    counts: Option<SumCounts>,
    /// Right-hand sides of draws of the errors by gains, of the parts so far.
    gain_errors: Vec<Vec<f64>>,
}

impl SumPart {
    /// The first of `count` parts, which are stored in a folder until the map is solved.
    #[must_use]
    pub fn first(count: usize, folder: &Path) -> Self {
        let finished =
            FinishedParts { folder: folder.to_owned(), tori: None, counts: None, gain_errors: Vec::new() };
        Self { share: RankShare { rank: 0, count: count.max(1) }, finished: Arc::new(Mutex::new(finished)) }
    }

    /// The next part; `None` after the last.
    #[must_use]
    pub fn next(&self) -> Option<Self> {
        let RankShare { rank, count } = self.share;
        (rank + 1 < count).then(|| Self {
            share: RankShare { rank: rank + 1, count },
            finished: Arc::clone(&self.finished),
        })
    }

    /// The share of an engine for this part.
    pub(in crate::imaging) fn ranks(&self) -> Ranks {
        Ranks::single_with_share(self.share)
    }
}

impl HarmonicSums {
    /// The same sums in an unnamed file in a folder, where every product reads them, in place of memory. Sums of several ranks, and those
    /// that are on disk already, stay as they are.
    ///
    /// # Errors
    /// The system's, in particular a full disk.
    pub(in crate::imaging) fn on_disk(mut self, folder: &Path) -> Result<Self, AccumulationError> {
        if self.tori.stored.is_none() && !self.ranks.is_distributed() {
            let store_error = |source| AccumulationError::Store { folder: folder.to_owned(), source };
            // What remains of the draws in memory are their right-hand sides.
            self.gain_error_right_hand_sides();
            self.gain_error_tori = Vec::new();
            let stored = StoredTori::of_memory(&self.grids, &self.tori, folder).map_err(store_error)?;
            self.tori = Tori::on_disk(stored);
        }
        Ok(self)
    }
}

impl HarmonicBasis {
    /// The right-hand sides of a pair of draws of the errors by gains, of the alphas that this process holds.
    fn projected_gain_errors(&self, tori: &Tori) -> [Vec<f64>; 2] {
        let operator = self.tables.get_or_init(|| self.setup.operator(&self.grids));
        let reached = tori.reached(&self.ranks);
        projected(operator, &SharedTori { ranks: &self.ranks, tori, reached, used: &[] })
    }
}

impl HarmonicEngine {
    /// Stores the sums of a part; after the last part, returns the complete sums.
    ///
    /// # Errors
    /// The data differ from those of the earlier parts; or the system's, in particular a full disk.
    pub fn finish_part(self, part: &SumPart) -> Result<Option<HarmonicSums>, AccumulationError> {
        let mut finished = part.finished.lock().unwrap_or_else(PoisonError::into_inner);
        let (basis, exact, counts) = self.into_exact();
        if finished.counts.is_some_and(|before| before != counts) {
            return Err(AccumulationError::Mismatch { what: "data" });
        }
        finished.counts = Some(counts);
        let (pairs, gain_error_power) = (exact.gain_errors(&basis.grids, basis.quanta), exact.error_power());
        let folder = finished.folder.clone();
        let store_error = |source| AccumulationError::Store { folder: folder.clone(), source };
        let mut tori = match finished.tori.take() {
            Some(tori) => tori,
            None => StoredTori::create(&folder).map_err(store_error)?,
        };
        tori.append(&basis.grids, basis.quanta, exact).map_err(store_error)?;
        let draws = pairs.iter().flat_map(|pair| basis.projected_gain_errors(pair));
        for (number, right) in draws.enumerate() {
            match finished.gain_errors.get_mut(number) {
                Some(sum) => add(sum, &right),
                None => finished.gain_errors.push(right),
            }
        }
        if part.next().is_some() {
            finished.tori = Some(tori);
            return Ok(None);
        }
        let sums = basis.unshared().sums(Tori::on_disk(tori), Vec::new(), counts);
        let gain_errors = std::mem::take(&mut finished.gain_errors).into();
        Ok(Some(HarmonicSums { gain_errors, gain_error_power, ..sums }))
    }
}
