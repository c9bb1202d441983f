//! The visibilities of one channel, held one by one for a map that is refined with their own positions.
//!
//! They are in memory, and in segments beside the checkpoints of a saved state. They are sorted before anything is summed, so that
//! maps depend on which visibilities are held and on nothing else: not on the order in which they arrived, nor on sessions, merges, or
//! what was held and removed again.

use std::collections::BTreeSet;
use std::io::{Read, Write};
use std::path::Path;

use rayon::prelude::*;

use super::archived::{ArchivedVisibility, RefinedSetup, VisibilitiesHead};
use super::assumed_instrument::AssumedInstrument;
use super::segments::{ArchiveSegment, SEGMENTS_MAX, SegmentPlace};
use super::sums::{
    BLOCK, Departures, RefinedData, RefinedSums, circle_engine, nearest_circle, refined_sums, taken_apart,
};
use crate::frames::PlacedVisibilities;
use crate::imaging::circle::{HarmonicEngine, HarmonicSums};
use crate::imaging::exact::checkpoint::{BasisKind, FrameReader, FrameWriter, refused};
use crate::imaging::exact::fixed_point::{Direction, Totals, WeightScale};
use crate::imaging::{AccumulationError, Added, NormalEngine, Refusal, SumCounts};
use crate::response::general::TimedPair;

/// Memory of a visibility while it is held, sorted and refined with, bytes: the arrays' elements, and what they grow by.
pub const REFINED_VISIBILITY_BYTES: u64 = 400;

/// The visibilities of one channel.
#[derive(Debug)]
pub struct VisibilityArchive {
    setup: RefinedSetup,
    scale: WeightScale,
    totals: Totals,
    held: Vec<ArchivedVisibility>,
    is_sorted: bool,
    /// Those on disk: the first of `held`, in their order.
    segments: Vec<ArchiveSegment>,
    /// Places in `held`, which is sorted, of visibilities that are to go.
    removed: BTreeSet<usize>,
    /// For maps on the way.
    circle: Option<QuickCircle>,
}

/// Sums on the nearest circle while data arrive.
#[derive(Debug)]
struct QuickCircle {
    engine: HarmonicEngine,
    /// How many of those held are in them.
    taken: usize,
}

impl VisibilityArchive {
    /// An empty archive.
    ///
    /// # Errors
    /// A greatest weight out of range.
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

    /// Takes visibilities.
    ///
    /// # Errors
    /// A block of another frequency, or with arrays of unequal lengths. A visibility without a row of B, or for which there is no room, is counted as refused.
    pub fn add(&mut self, placed: &PlacedVisibilities) -> Result<Added, AccumulationError> {
        self.check(placed)?;
        self.flush();
        let mut added = Added::default();
        for k in 0..placed.len() {
            match self.checked(placed, k).and_then(|held| Ok((self.with(&held)?, held))) {
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

    /// Removes visibilities that were taken. One that is not held was left out for want of room, and is counted so.
    ///
    /// # Errors
    /// A block of another frequency.
    pub fn remove(&mut self, placed: &PlacedVisibilities) -> Result<Added, AccumulationError> {
        self.check(placed)?;
        self.sort();
        let mut removed = Added::default();
        for k in 0..placed.len() {
            let found = self.checked(placed, k).and_then(|held| {
                let place = self.find(&held).ok_or(Refusal::Full)?;
                let totals =
                    self.totals.and(Totals::one(self.scale, held.weight, held.value_k_sr), Direction::Out);
                Ok((place, totals.ok_or(Refusal::Full)?))
            });
            match found {
                Ok((place, totals)) => {
                    self.totals = totals;
                    self.removed.insert(place);
                    removed.visibilities += 1;
                }
                Err(reason) => removed.refuse(reason),
            }
        }
        Ok(removed)
    }

    /// Takes all that another archive of the same setup holds.
    ///
    /// # Errors
    /// Archives of different setups; more visibilities than may be held.
    pub fn merge(&mut self, mut other: Self) -> Result<(), AccumulationError> {
        let of_ours = RefinedSetup { visibilities_max: self.setup.visibilities_max, ..other.setup };
        if of_ours != self.setup {
            let what = "map sizes, frequencies, baselines, limits, responses, seeds or greatest weights";
            return Err(AccumulationError::Mismatch { what });
        }
        self.flush();
        other.flush();
        let (found, most) = ((self.held.len() + other.held.len()) as u64, self.setup.visibilities_max);
        if found > most {
            return Err(AccumulationError::TooManyVisibilities { channel: self.setup.channel, found, most });
        }
        self.totals = self.totals.and(other.totals, Direction::In).ok_or(AccumulationError::Range)?;
        self.is_sorted = self.held.is_empty() && other.is_sorted;
        self.held.append(&mut other.held);
        Ok(())
    }

    /// Number and weight of the visibilities.
    #[must_use]
    pub fn counts(&self) -> SumCounts {
        self.totals.counts(self.scale)
    }

    /// The segments on disk that hold what was written or read last.
    #[must_use]
    pub fn segments(&self) -> &[ArchiveSegment] {
        &self.segments
    }

    /// Forgets its segments: the next checkpoint goes into another folder.
    pub fn leave_segments(&mut self) {
        self.segments.clear();
    }

    /// A copy of the visibilities, without their files.
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

    /// The visibilities, sorted, and the noise of their companion.
    pub(in crate::imaging) fn into_data(mut self) -> (RefinedSetup, Vec<TimedPair>, RefinedData) {
        self.circle = None;
        self.sort();
        self.flush();
        let parts = taken_apart(&self.setup, self.held);
        (self.setup, parts.at, parts.data)
    }

    /// Sorts the visibilities, plans their rows for the `assumed` instrument, and sums them on the nearest circle.
    ///
    /// # Errors
    /// A setup that an engine does not take; no data.
    pub fn into_sums(mut self, assumed: &AssumedInstrument) -> Result<RefinedSums, AccumulationError> {
        self.circle = None;
        self.sort();
        self.flush();
        refined_sums(&self.setup, self.held, assumed)
    }

    /// Sums on the circle that was nearest when this was first called, for a map on the way: it costs no pass, and has the errors of
    /// the circle's rows.
    ///
    /// # Errors
    /// A setup that an engine does not take.
    pub fn circle_sums(&mut self) -> Result<HarmonicSums, AccumulationError> {
        self.flush();
        let mut circle = match self.circle.take() {
            Some(circle) => circle,
            None => {
                let (orbit, _) = nearest_circle(&self.setup, &|k| self.held[k].at, self.held.len());
                QuickCircle { engine: circle_engine(&self.setup, orbit)?, taken: 0 }
            }
        };
        for piece in self.held[circle.taken..].chunk_by(|a, b| a.at.pair == b.at.pair && a.band == b.band) {
            for block in piece.chunks(BLOCK) {
                let _ = circle.engine.add(&placed(&self.setup, block))?;
            }
        }
        circle.taken = self.held.len();
        let sums = circle.engine.sums();
        self.circle = Some(circle);
        Ok(sums)
    }

    /// How far the visibilities are from their circle.
    #[must_use]
    pub fn departures(&self) -> Departures {
        nearest_circle(&self.setup, &|k| self.held[k].at, self.held.len()).1
    }

    /// Writes what is new as a segment, and a checkpoint that names all of them.
    ///
    /// # Errors
    /// The writer's, and the system's.
    pub fn checkpoint(
        &mut self,
        out: &mut dyn Write,
        place: SegmentPlace<'_>,
    ) -> Result<(), AccumulationError> {
        self.flush();
        self.save(place)?;
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

    fn save(&mut self, place: SegmentPlace<'_>) -> Result<(), AccumulationError> {
        // One of this number belongs to a checkpoint that failed, and may be gone: it is written again.
        while self.segments.pop_if(|last| last.number >= place.number).is_some() {}
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
        self.segments.push(ArchiveSegment::write(place, self.setup.channel, new)?);
        Ok(())
    }

    /// Reads a checkpoint and the segments that it names, in `folder`; at most `visibilities_max` may be added to what they hold.
    ///
    /// # Errors
    /// A checkpoint or a segment that is damaged, missing, or does not fit the other.
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
            totals.and(Totals::one(archive.scale, held.weight, held.value_k_sr), Direction::In)
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
        let held = ArchivedVisibility::of(placed, k, self.setup.moon_radius_m)?;
        self.scale.check(held.value_k_sr, held.weight, self.setup.weight_max)?;
        Ok(held)
    }

    /// The totals with one more, if there is room.
    fn with(&self, held: &ArchivedVisibility) -> Result<Totals, Refusal> {
        if self.held.len() as u64 >= self.setup.visibilities_max {
            return Err(Refusal::Full);
        }
        self.totals
            .and(Totals::one(self.scale, held.weight, held.value_k_sr), Direction::In)
            .ok_or(Refusal::Full)
    }

    /// Sorts those held; what stands in segments stands there in another order.
    fn sort(&mut self) {
        if !self.is_sorted {
            self.held.par_sort_unstable_by(|a, b| {
                a.order().partial_cmp(&b.order()).unwrap_or(std::cmp::Ordering::Equal)
            });
            self.is_sorted = true;
            self.segments.clear();
            self.circle = None;
        }
    }

    /// The place of a visibility that is held and is not to go.
    fn find(&self, held: &ArchivedVisibility) -> Option<usize> {
        let order = held.order();
        let first = self.held.partition_point(|other| other.order() < order);
        let equal = self.held[first..].iter().take_while(|other| other.order() == order);
        (first..first + equal.count()).find(|place| !self.removed.contains(place))
    }

    /// Lets go what is to go.
    fn flush(&mut self) {
        let removed = std::mem::take(&mut self.removed);
        if removed.is_empty() {
            return;
        }
        let mut place = 0;
        self.held.retain(|_| {
            place += 1;
            !removed.contains(&(place - 1))
        });
        self.segments.clear();
        self.circle = None;
    }
}

/// A block of one pair and sub-band, as an engine takes it.
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
    }
}
