//! An archive of the individual visibilities of one channel, for maps that need them again in each iteration.
//!
//! Visibilities are held in memory, and in segments beside the checkpoints of a saved state. They are sorted before they are used, so that
//! maps depend only on which visibilities are held: not on their order, sessions or merges, nor on what was added and removed again.

use std::collections::BTreeSet;
use std::io::{Read, Write};
use std::path::Path;

use rayon::prelude::*;

use super::archived::{ArchivedVisibility, RefinedSetup, VisibilitiesHead};
use super::segments::{ArchiveSegment, SEGMENTS_MAX, SegmentFolder};
use super::sums::{
    BLOCK, Departures, RefinedData, RefinedSums, VisibilityColumns, circle_engine, nearest_circle,
    refined_sums,
};
use crate::frames::PlacedVisibilities;
use crate::imaging::assumed_instrument::AssumedInstrument;
use crate::imaging::circle::{HarmonicEngine, HarmonicSums, OrderBlocks};
use crate::imaging::exact::checkpoint::{BasisKind, FrameReader, FrameWriter, refused};
use crate::imaging::exact::fixed_point::{Direction, Totals, WeightScale};
use crate::imaging::{AccumulationError, Added, NormalEngine, Refusal, SumCounts};
use crate::response::general::TimedPair;
use crate::units::constants::SPEED_OF_LIGHT_M_S;
use crate::units::vector::{norm, sub};

/// Longest baseline of blocks on a circle, wavelengths: just below what the circle's engine takes.
const CIRCLE_WAVELENGTHS_MAX: f64 = 9_999.0;

/// Memory of a visibility while it is stored, sorted and used for refinement, bytes, including spare capacity of arrays.
pub const REFINED_VISIBILITY_BYTES: u64 = 400;

/// An archive of the visibilities of one channel.
#[derive(Debug)]
pub struct VisibilityArchive {
    setup: RefinedSetup,
    scale: WeightScale,
    totals: Totals,
    held: Vec<ArchivedVisibility>,
    is_sorted: bool,
    /// Segments on disk, which hold the first of `held` in the same order.
    segments: Vec<ArchiveSegment>,
    /// Indices into `held`, which is then sorted, of visibilities to be removed.
    removed: BTreeSet<usize>,
    /// Circle sums for snapshots.
    circle: Option<SnapshotCircle>,
}

/// Sums on the nearest circle while data arrive.
#[derive(Debug)]
struct SnapshotCircle {
    engine: HarmonicEngine,
    /// How many of the held visibilities the sums contain.
    summed: usize,
}

impl VisibilityArchive {
    /// Creates an empty archive.
    ///
    /// # Errors
    /// The maximum weight is out of range.
    pub fn new(setup: RefinedSetup) -> Result<Self, AccumulationError> {
        Ok(Self {
            setup,
            scale: WeightScale::new(setup.weight_max)?,
            totals: Totals::default(),
            held: Vec::new(),
            is_sorted: true,
            segments: Vec::new(),
            removed: BTreeSet::new(),
            circle: None,
        })
    }

    /// Adds visibilities. One without a row of B, or without room, is counted as refused.
    ///
    /// # Errors
    /// The block has another frequency, or arrays of unequal lengths.
    pub fn add(&mut self, placed: &PlacedVisibilities) -> Result<Added, AccumulationError> {
        self.check(placed)?;
        self.flush();
        let mut added = Added::default();
        for k in 0..placed.len() {
            match self.checked(placed, k).and_then(|held| Ok((self.totals_with(&held)?, held))) {
                Ok((totals, held)) => {
                    self.totals = totals;
                    self.held.push(held);
                    self.is_sorted = false;
                    added.visibilities += 1;
                }
                Err(reason) => added.refuse(reason),
            }
        }
        Ok(added)
    }

    /// Removes visibilities that were added. One that is not held is counted as refused for lack of room, the reason why it was not added.
    ///
    /// # Errors
    /// The block has another frequency.
    pub fn remove(&mut self, placed: &PlacedVisibilities) -> Result<Added, AccumulationError> {
        self.check(placed)?;
        self.sort();
        let mut removed = Added::default();
        for k in 0..placed.len() {
            let found = self.checked(placed, k).and_then(|held| {
                let index = self.find(&held).ok_or(Refusal::Full)?;
                let totals = self
                    .totals
                    .combined(Totals::single(self.scale, held.weight, held.value_k_sr), Direction::Out);
                Ok((index, totals.ok_or(Refusal::Full)?))
            });
            match found {
                Ok((index, totals)) => {
                    self.totals = totals;
                    self.removed.insert(index);
                    removed.visibilities += 1;
                }
                Err(reason) => removed.refuse(reason),
            }
        }
        Ok(removed)
    }

    /// Adds all visibilities of another archive of the same setup.
    ///
    /// # Errors
    /// The setups differ, or together there are too many visibilities.
    pub fn merge(&mut self, mut other: Self) -> Result<(), AccumulationError> {
        let setup = RefinedSetup { visibilities_max: self.setup.visibilities_max, ..other.setup };
        if setup != self.setup {
            let what = "map sizes, frequencies, baselines, limits, responses, seeds or maximum weights";
            return Err(AccumulationError::Mismatch { what });
        }
        self.flush();
        other.flush();
        let (found, limit) = ((self.held.len() + other.held.len()) as u64, self.setup.visibilities_max);
        if found > limit {
            return Err(AccumulationError::TooManyVisibilities { channel: self.setup.channel, found, limit });
        }
        self.totals = self.totals.combined(other.totals, Direction::In).ok_or(AccumulationError::Range)?;
        self.is_sorted = self.held.is_empty() && other.is_sorted;
        self.held.append(&mut other.held);
        Ok(())
    }

    /// Number, weight and power of the visibilities.
    #[must_use]
    pub fn counts(&self) -> SumCounts {
        self.totals.counts(self.scale)
    }

    /// The segments on disk, as they were last written or read.
    #[must_use]
    pub fn segments(&self) -> &[ArchiveSegment] {
        &self.segments
    }

    /// Forgets its segments, so that the next checkpoint can go into another folder.
    pub fn forget_segments(&mut self) {
        self.segments.clear();
    }

    /// A copy of the visibilities without their segments.
    pub(in crate::imaging) fn copy(&mut self) -> Self {
        self.flush();
        Self {
            setup: self.setup,
            scale: self.scale,
            totals: self.totals,
            held: self.held.clone(),
            is_sorted: self.is_sorted,
            segments: Vec::new(),
            removed: BTreeSet::new(),
            circle: None,
        }
    }

    /// The setup, and the sorted positions and data with their simulated noise.
    pub(in crate::imaging) fn into_data(mut self) -> (RefinedSetup, Vec<TimedPair>, RefinedData) {
        self.circle = None;
        self.sort();
        self.flush();
        let columns = VisibilityColumns::new(&self.setup, self.held);
        (self.setup, columns.at, columns.data)
    }

    /// Sorts the visibilities, plans their rows for the `assumed` instrument, and sums them on the nearest circle.
    ///
    /// # Errors
    /// The engine refuses the setup, or there is no data.
    pub fn into_sums(mut self, assumed: &AssumedInstrument) -> Result<RefinedSums, AccumulationError> {
        self.circle = None;
        self.sort();
        self.flush();
        refined_sums(&self.setup, self.held, assumed)
    }

    /// Harmonic sums on the circle that was nearest when this was first called, for a snapshot. Its map needs no refinement, but has the errors
    /// of the circle's rows.
    ///
    /// # Errors
    /// The engine refuses the setup.
    pub fn circle_sums(&mut self) -> Result<HarmonicSums, AccumulationError> {
        self.flush();
        let mut circle = match self.circle.take() {
            Some(circle) => circle,
            None => {
                let (orbit, _) = nearest_circle(&self.setup, &|k| self.held[k].at, self.held.len());
                SnapshotCircle { engine: circle_engine(&self.setup, orbit)?, summed: 0 }
            }
        };
        sum_on_circle(&self.setup, &self.held[circle.summed..], &mut circle.engine)?;
        circle.summed = self.held.len();
        let sums = circle.engine.sums();
        self.circle = Some(circle);
        Ok(sums)
    }

    /// Blocks of the normal matrix over harmonics up to `l_max` on the nearest circle.
    ///
    /// # Errors
    /// The engine refuses the setup.
    pub(in crate::imaging) fn order_blocks(
        &mut self,
        l_max: usize,
    ) -> Result<OrderBlocks, AccumulationError> {
        self.sort();
        self.flush();
        let lengths_m = self.held.iter().map(|held| norm(sub(held.at.r_i_m, held.at.r_j_m)));
        // Tables grow with the longest baseline, and a circle takes a bounded one. Blocks only precondition.
        let longest_m = (1.001 * lengths_m.fold(1.0, f64::max))
            .min(CIRCLE_WAVELENGTHS_MAX * SPEED_OF_LIGHT_M_S / self.setup.frequency_hz);
        let setup =
            RefinedSetup { l_max, baseline_m_max: self.setup.baseline_m_max.min(longest_m), ..self.setup };
        let (orbit, _) = nearest_circle(&setup, &|k| self.held[k].at, self.held.len());
        let mut engine = circle_engine(&setup, orbit)?;
        sum_on_circle(&setup, &self.held, &mut engine)?;
        Ok(engine.into_sums().order_blocks())
    }

    /// The departures of the visibilities from their nearest circle.
    #[must_use]
    pub fn departures(&self) -> Departures {
        nearest_circle(&self.setup, &|k| self.held[k].at, self.held.len()).1
    }

    /// Writes new visibilities as a segment, and a checkpoint that names all segments.
    ///
    /// # Errors
    /// The writer's or the system's.
    pub fn checkpoint(
        &mut self,
        out: &mut dyn Write,
        folder: SegmentFolder<'_>,
    ) -> Result<(), AccumulationError> {
        self.flush();
        self.save(folder)?;
        let mut out =
            FrameWriter::new(out, BasisKind::Archive, (VisibilitiesHead::new(&self.setup), self.totals))?;
        out.write(&(self.segments.len() as u32).to_le_bytes())?;
        for ArchiveSegment { channel: _, number, visibilities, checksum } in &self.segments {
            for field in [number, visibilities, checksum] {
                out.write(&field.to_le_bytes())?;
            }
        }
        Ok(out.finish()?)
    }

    /// Writes new visibilities as a segment, merged with short segments before them.
    fn save(&mut self, folder: SegmentFolder<'_>) -> Result<(), AccumulationError> {
        // A segment of this number belongs to a checkpoint that failed; it may be missing, so it is written again.
        while self.segments.pop_if(|last| last.number >= folder.number).is_some() {}
        let all = self.held.len() as u64;
        let mut saved: u64 = self.segments.iter().map(|segment| segment.visibilities).sum();
        if all == saved {
            return Ok(());
        }
        while let Some(last) = self.segments.last()
            && last.visibilities < 2 * (all - saved)
        {
            saved -= last.visibilities;
            self.segments.pop();
        }
        let new = &self.held[saved as usize..];
        self.segments.push(ArchiveSegment::write(folder, self.setup.channel, new)?);
        Ok(())
    }

    /// Reads a checkpoint and the segments that it names from `folder`. Later additions are limited to `visibilities_max` in all.
    ///
    /// # Errors
    /// The checkpoint or a segment is damaged or missing, or they do not match.
    pub fn restore(
        from: &mut dyn Read,
        folder: Option<&Path>,
        visibilities_max: u64,
    ) -> Result<Self, AccumulationError> {
        let (mut from, (head, totals)) = FrameReader::new(from, BasisKind::Archive)?;
        let setup = VisibilitiesHead::setup(&head, visibilities_max)?;
        let mut archive = Self { totals, ..Self::new(setup)? };
        let mut count = [0; 4];
        from.read(&mut count)?;
        let count = u32::from_le_bytes(count) as usize;
        if count > SEGMENTS_MAX {
            return Err(refused(format!("{count} segments of visibilities"), "at most 64"));
        }
        for _ in 0..count {
            let mut fields = [[0; 8]; 3];
            fields.iter_mut().try_for_each(|field| from.read(field))?;
            let [number, visibilities, checksum] = fields.map(u64::from_le_bytes);
            archive.segments.push(ArchiveSegment { channel: setup.channel, number, visibilities, checksum });
        }
        from.finish()?;
        if let Some(segment) = archive.segments.first()
            && folder.is_none()
        {
            return Err(refused(segment.file_name(), "a folder in which the segments of visibilities are"));
        }
        for segment in folder.iter().flat_map(|_| archive.segments.clone()) {
            segment.read(folder.unwrap_or(Path::new("")), &mut |piece| archive.held.extend(piece))?;
        }
        let found = archive.held.iter().try_fold(Totals::default(), |totals, held| {
            totals.combined(Totals::single(archive.scale, held.weight, held.value_k_sr), Direction::In)
        });
        if found != Some(totals) {
            return Err(refused("other visibilities in the segments".into(), "those of the checkpoint"));
        }
        archive.is_sorted = archive.held.is_empty();
        Ok(archive)
    }

    fn check(&self, placed: &PlacedVisibilities) -> Result<(), AccumulationError> {
        let (expected_hz, found_hz) = (self.setup.frequency_hz, placed.frequency_hz);
        if found_hz != expected_hz {
            return Err(AccumulationError::Frequency { expected_hz, found_hz });
        }
        Ok(placed.check_lengths()?)
    }

    fn checked(&self, placed: &PlacedVisibilities, k: usize) -> Result<ArchivedVisibility, Refusal> {
        let held = ArchivedVisibility::new(placed, k, self.setup.moon_radius_m)?;
        self.scale.check(held.value_k_sr, held.weight, self.setup.weight_max)?;
        Ok(held)
    }

    /// The totals with one more visibility, if there is room.
    fn totals_with(&self, held: &ArchivedVisibility) -> Result<Totals, Refusal> {
        if self.held.len() as u64 >= self.setup.visibilities_max {
            return Err(Refusal::Full);
        }
        self.totals
            .combined(Totals::single(self.scale, held.weight, held.value_k_sr), Direction::In)
            .ok_or(Refusal::Full)
    }

    /// Sorts the visibilities; segments then have another order and are dropped.
    fn sort(&mut self) {
        if !self.is_sorted {
            self.held.par_sort_unstable_by(|a, b| {
                a.sort_key().partial_cmp(&b.sort_key()).unwrap_or(std::cmp::Ordering::Equal)
            });
            self.is_sorted = true;
            self.segments.clear();
            self.circle = None;
        }
    }

    /// The index of a visibility that is held and not marked for removal.
    fn find(&self, held: &ArchivedVisibility) -> Option<usize> {
        let key = held.sort_key();
        let first = self.held.partition_point(|other| other.sort_key() < key);
        let equal = self.held[first..].iter().take_while(|other| other.sort_key() == key);
        (first..first + equal.count()).find(|index| !self.removed.contains(index))
    }

    /// Removes the visibilities that are marked for removal.
    fn flush(&mut self) {
        let removed = std::mem::take(&mut self.removed);
        if removed.is_empty() {
            return;
        }
        let mut index = 0;
        self.held.retain(|_| {
            index += 1;
            !removed.contains(&(index - 1))
        });
        self.segments.clear();
        self.circle = None;
    }
}

/// Adds visibilities to the sums of a circle.
fn sum_on_circle(
    setup: &RefinedSetup,
    held: &[ArchivedVisibility],
    engine: &mut HarmonicEngine,
) -> Result<(), AccumulationError> {
    for run in held.chunk_by(|a, b| a.at.pair == b.at.pair && a.band == b.band) {
        for block in run.chunks(BLOCK) {
            let _ = engine.add(&placed(setup, block))?;
        }
    }
    Ok(())
}

/// Converts visibilities of one pair and sub-band to a block for an engine.
fn placed(setup: &RefinedSetup, block: &[ArchivedVisibility]) -> PlacedVisibilities {
    PlacedVisibilities {
        channel: setup.channel,
        band: block.first().map_or(0, |held| held.band),
        frequency_hz: setup.frequency_hz,
        pair: block.first().map(|held| held.at.pair).unwrap_or_default(),
        time_s: block.iter().map(|held| held.at.time_s).collect(),
        r_i_m: block.iter().map(|held| held.at.r_i_m).collect(),
        r_j_m: block.iter().map(|held| held.at.r_j_m).collect(),
        value_k_sr: block.iter().map(|held| held.value_k_sr).collect(),
        weight: block.iter().map(|held| held.weight).collect(),
        duration_s: block.iter().map(|held| held.duration_s).collect(),
        gain_errors: Vec::new(),
    }
}
