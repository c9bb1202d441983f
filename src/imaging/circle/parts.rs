//! Sums that memory does not hold: made part by part, by reading the data as many times, each part left on disk.

use std::io;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, PoisonError};

use rayon::prelude::*;

use super::HarmonicEngine;
use super::exact::ExactTori;
use super::grid::ALPHAS;
use super::grid::Grids;
use super::quanta::{ExactNode, Quanta};
use super::stored::{StoredBlock, StoredTori, TorusPart};
use super::sums::HarmonicSums;
use super::tori::Tori;
use crate::files::write_at;
use crate::imaging::exact::fixed_point::rows::IntegerRow;
use crate::imaging::{AccumulationError, SumCounts};
use crate::ranks::{RankShare, Ranks};

impl StoredTori {
    /// Writes the sums that `grids` holds, and frees them node by node; the file has none yet.
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
                    integers.write_values(layout, quantum, out);
                    if out.iter().any(|x| *x != 0.0) {
                        used.push(number * ALPHAS + alpha);
                    }
                }
                let bytes: &[u8] = bytemuck::cast_slice(&values);
                write_at(&self.file, bytes, block.offset + (place * bytes.len()) as u64)?;
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
    made: Arc<Mutex<FinishedParts>>,
}

/// The parts that are finished.
#[derive(Debug)]
struct FinishedParts {
    folder: PathBuf,
    tori: Option<StoredTori>,
    counts: Option<SumCounts>,
}

impl SumPart {
    /// The first of some parts, which are kept in a folder until the map is solved.
    #[must_use]
    pub fn first(count: usize, folder: &Path) -> Self {
        let made = FinishedParts { folder: folder.to_owned(), tori: None, counts: None };
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
    pub(in crate::imaging) fn ranks(&self) -> Ranks {
        Ranks::single_with_share(self.share)
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
            return Err(AccumulationError::Mismatch { what: "data" });
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
