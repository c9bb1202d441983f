//! What a map method is: how it sums the visibilities of a channel, saves the sums, and solves them for a map.
//!
//! Each method is a folder, and a file in `methods` that implements the traits; [`Method`](super::Method) names them all. Stages, estimates
//! and saved states know only the traits.

use std::any::Any;
use std::io::{Read, Write};
use std::path::Path;

use super::anywhere::{ArchiveSegment, SegmentFolder};
use super::circle::{HarmonicSums, SumPart};
use super::cost::{ChannelData, EngineCost};
use super::request::{MapRequest, SolvedMap};
use super::{AccumulationError, Added, MapConfig, SolveError, SumCounts};
use crate::frames::{Instrument, PlacedVisibilities, VisibilityReason};
use crate::ranks::{RankShare, Ranks};

/// A map method.
pub(in crate::imaging) trait MapMethod: Sync {
    /// Creates empty sums for a channel from its first data; refuses positions that determine no usable orbit.
    ///
    /// # Errors
    /// The settings do not fit the instrument.
    fn create(&self, channel: &NewChannel<'_>) -> Result<NewOrRefused<Box<dyn MapSums>>, AccumulationError>;

    /// Reads what [`MapSums::save`] wrote on the rank of the first of `shares`, with archive files in `folder`. Of it that of the second, the
    /// reading rank, is kept.
    ///
    /// # Errors
    /// The data are damaged, or of another method.
    fn load(
        &self,
        config: &MapConfig,
        from: &mut dyn Read,
        folder: Option<&Path>,
        shares: (RankShare, &Ranks),
    ) -> Result<Box<dyn MapSums>, AccumulationError>;

    /// Estimates what the map of a channel takes.
    fn cost(&self, map: &MapConfig, data: ChannelData) -> EngineCost;
}

/// A value, or why it could not be created from the first data of its channel.
pub(in crate::imaging) type NewOrRefused<T> = Result<T, VisibilityReason>;

/// The channel for which sums are created.
pub(in crate::imaging) struct NewChannel<'a> {
    /// Settings.
    pub(in crate::imaging) config: &'a MapConfig,
    /// Instrument.
    pub(in crate::imaging) instrument: &'a Instrument,
    /// The channel's first data.
    pub(in crate::imaging) placed: &'a PlacedVisibilities,
    /// Its frequency, Hz.
    pub(in crate::imaging) frequency_hz: f64,
    /// Maximum weight of a visibility, (K sr)^-2.
    pub(in crate::imaging) weight_max: f64,
    /// Which of the sums are made.
    pub(in crate::imaging) share: &'a SumShare,
}

/// Which sums an accumulator makes. Only the harmonic method divides its sums and adds realisations; the others make all on every rank.
#[derive(Clone, Debug)]
pub(in crate::imaging) struct SumShare {
    /// The ranks that share the sums.
    pub(in crate::imaging) ranks: Ranks,
    /// The part that this reading of the data accumulates, if memory cannot hold all of them.
    pub(in crate::imaging) part: Option<SumPart>,
    /// Seeds of additional noise realisations.
    pub(in crate::imaging) realisation_seeds: Vec<u64>,
}

/// The sums of one channel while data arrive.
pub(in crate::imaging) trait MapSums: Any + Send {
    /// Adds visibilities.
    ///
    /// # Errors
    /// As [`NormalEngine::add`](super::NormalEngine::add).
    fn add(&mut self, placed: &PlacedVisibilities) -> Result<Added, AccumulationError>;

    /// Removes visibilities that were added.
    ///
    /// # Errors
    /// As [`NormalEngine::remove`](super::NormalEngine::remove).
    fn remove(&mut self, placed: &PlacedVisibilities) -> Result<Added, AccumulationError>;

    /// Adds other sums of the same setup.
    ///
    /// # Errors
    /// They are of another setup or method, or too large together.
    fn merge(&mut self, other: Box<dyn MapSums>) -> Result<(), AccumulationError>;

    /// Adds another rank's share of the same sums.
    ///
    /// # Errors
    /// The shares are of different sums, or the method does not divide its sums.
    fn join(&mut self, _other: Box<dyn MapSums>) -> Result<(), AccumulationError> {
        Err(AccumulationError::Undivided)
    }

    /// Writes everything that is needed to resume; visibilities go into files of their own in `segments`.
    ///
    /// # Errors
    /// The writer's.
    fn save(&mut self, out: &mut dyn Write, segments: SegmentFolder<'_>) -> Result<(), AccumulationError>;

    /// The files of visibilities that belong to what was saved.
    fn segments(&self) -> &[ArchiveSegment] {
        &[]
    }

    /// Forgets these files, so that they can be written into another folder.
    fn forget_segments(&mut self) {}

    /// Number and weight of the visibilities.
    fn counts(&self) -> SumCounts;

    /// The equations of an intermediate map.
    ///
    /// # Errors
    /// As [`NormalEngine::add`](super::NormalEngine::add).
    fn snapshot(&mut self) -> Result<Box<dyn MapEquations>, AccumulationError>;

    /// The equations of the final map; `None` if they need more readings of the data.
    ///
    /// # Errors
    /// Sums that cannot be written to disk.
    fn finish(self: Box<Self>) -> Result<Option<Box<dyn MapEquations>>, AccumulationError>;
}

/// Other sums as those of this method.
///
/// # Errors
/// They are of another method.
pub(in crate::imaging) fn same_method<T: MapSums>(
    other: Box<dyn MapSums>,
) -> Result<Box<T>, AccumulationError> {
    let other: Box<dyn Any> = other;
    other.downcast().map_err(|_| AccumulationError::Mismatch { what: "kinds" })
}

/// The equations of one channel's map, to be solved while more data arrive.
pub trait MapEquations: Send {
    /// Number and weight of the visibilities.
    fn counts(&self) -> SumCounts;

    /// Solves for the map; `None` for an intermediate map that was interrupted, or that the data do not determine yet.
    ///
    /// # Errors
    /// As the solver of the method.
    fn solve(self: Box<Self>, request: MapRequest<'_>) -> Result<Option<SolvedMap>, SolveError>;

    /// The normal equations over harmonics, or what they are instead.
    ///
    /// # Errors
    /// Equations of another method.
    fn into_harmonic(self: Box<Self>) -> Result<Box<HarmonicSums>, &'static str>;
}
