//! Refined maps as a map method, and the archive of visibilities as its sums.

use std::io::{Read, Write};
use std::path::Path;

use crate::frames::PlacedVisibilities;
use crate::imaging::anywhere::{
    ArchiveSegment, IterationFile, RefineSteps, RefinedSetup, SegmentFolder, VisibilityArchive, refined_cost,
    solve_refined,
};
use crate::imaging::assumed_instrument::AssumedInstrument;
use crate::imaging::circle::{HarmonicRequest, HarmonicSolution, HarmonicSums};
use crate::imaging::cost::{ChannelData, EngineCost};
use crate::imaging::method::{MapEquations, MapMethod, MapSums, NewChannel, NewOrRefused, same_method};
use crate::imaging::request::{MapRequest, SolvedMap};
use crate::imaging::{AccumulationError, Added, MapConfig, SolveError, SumCounts};
use crate::ranks::{RankShare, Ranks};

/// Maps that are refined with the rows of B at the true positions.
pub(in crate::imaging) struct RefinedMaps;

impl MapMethod for RefinedMaps {
    fn create(&self, channel: &NewChannel<'_>) -> Result<NewOrRefused<Box<dyn MapSums>>, AccumulationError> {
        Ok(Ok(Box::new(ArchivedSums::new(channel, channel.config.degree(), TrueRows)?)))
    }

    fn load(
        &self,
        config: &MapConfig,
        from: &mut dyn Read,
        folder: Option<&Path>,
        _shares: (RankShare, &Ranks),
    ) -> Result<Box<dyn MapSums>, AccumulationError> {
        Ok(Box::new(ArchivedSums::load(config, from, folder, TrueRows)?))
    }

    fn cost(&self, map: &MapConfig, data: ChannelData) -> EngineCost {
        refined_cost(map, data)
    }
}

/// What an archive of visibilities is solved with.
pub(in crate::imaging) trait ArchiveSolver: Send + 'static {
    /// As [`MapSums::snapshot`].
    fn snapshot(&self, archive: &mut VisibilityArchive) -> Result<Box<dyn MapEquations>, AccumulationError>;

    /// As [`MapSums::finish`].
    fn finish(self, archive: VisibilityArchive) -> Box<dyn MapEquations>;
}

/// Rows at the true positions; intermediate maps are those of the nearest circle.
struct TrueRows;

impl ArchiveSolver for TrueRows {
    fn snapshot(&self, archive: &mut VisibilityArchive) -> Result<Box<dyn MapEquations>, AccumulationError> {
        Ok(Box::new(archive.circle_sums()?))
    }

    fn finish(self, archive: VisibilityArchive) -> Box<dyn MapEquations> {
        Box::new(archive)
    }
}

/// The visibilities of a channel, for a method that needs them one by one.
pub(in crate::imaging) struct ArchivedSums<U> {
    archive: VisibilityArchive,
    solver: U,
}

impl<U: ArchiveSolver> ArchivedSums<U> {
    pub(in crate::imaging) fn new(
        channel: &NewChannel<'_>,
        l_max: usize,
        solver: U,
    ) -> Result<Self, AccumulationError> {
        let NewChannel { config, instrument, placed, frequency_hz, weight_max, .. } = *channel;
        let archive = VisibilityArchive::new(RefinedSetup {
            channel: placed.channel,
            l_max,
            frequency_hz,
            baseline_m_max: config.baseline_m_max(frequency_hz),
            moon_radius_m: instrument.moon_radius_m,
            response: instrument.response,
            companion_seed: config.companion_seed,
            weight_max,
            limits: config.limits,
            visibilities_max: config.refine.visibilities_max,
        })?;
        Ok(Self { archive, solver })
    }

    pub(in crate::imaging) fn load(
        config: &MapConfig,
        from: &mut dyn Read,
        folder: Option<&Path>,
        solver: U,
    ) -> Result<Self, AccumulationError> {
        let visibilities_max = config.refine.visibilities_max;
        Ok(Self { archive: VisibilityArchive::restore(from, folder, visibilities_max)?, solver })
    }
}

impl<U: ArchiveSolver> MapSums for ArchivedSums<U> {
    fn add(&mut self, placed: &PlacedVisibilities) -> Result<Added, AccumulationError> {
        self.archive.add(placed)
    }

    fn remove(&mut self, placed: &PlacedVisibilities) -> Result<Added, AccumulationError> {
        self.archive.remove(placed)
    }

    fn merge(&mut self, other: Box<dyn MapSums>) -> Result<(), AccumulationError> {
        self.archive.merge(same_method::<Self>(other)?.archive)
    }

    fn save(&mut self, out: &mut dyn Write, segments: SegmentFolder<'_>) -> Result<(), AccumulationError> {
        self.archive.checkpoint(out, segments)
    }

    fn segments(&self) -> &[ArchiveSegment] {
        self.archive.segments()
    }

    fn forget_segments(&mut self) {
        self.archive.forget_segments();
    }

    fn counts(&self) -> SumCounts {
        self.archive.counts()
    }

    fn snapshot(&mut self) -> Result<Box<dyn MapEquations>, AccumulationError> {
        self.solver.snapshot(&mut self.archive)
    }

    fn finish(self: Box<Self>) -> Result<Option<Box<dyn MapEquations>>, AccumulationError> {
        let Self { archive, solver } = *self;
        Ok(Some(solver.finish(archive)))
    }
}

impl MapEquations for VisibilityArchive {
    fn counts(&self) -> SumCounts {
        self.counts()
    }

    fn solve(self: Box<Self>, request: MapRequest<'_>) -> Result<Option<SolvedMap>, SolveError> {
        let sums = self.into_sums(&AssumedInstrument {
            satellites: request.instrument.satellites.into(),
            epoch_tai_s: request.instrument.epoch_tai_s,
            ..request.setup.assumed.clone()
        })?;
        let settings = HarmonicRequest { probes: 0, ..HarmonicRequest::of(&request) };
        let fingerprint = [request.fingerprint, &[request.epsilon.to_bits().cast_signed()]].concat();
        let folder = request.setup.iteration_folder.as_ref();
        let file = folder.map(|folder| IterationFile::new(folder, request.channel, &fingerprint));
        // An intermediate map would not help: it is the circle's, with which the iteration starts anyway.
        let start = file.as_ref().and_then(IterationFile::read);
        let mut save = |x: [&[f64]; 2]| {
            if let Some(file) = &file {
                file.write(x);
            }
        };
        let steps = RefineSteps { start, save: &mut save };
        let (rule, prior) = ((request.setup.refine, &request.regulariser), request.prior.as_deref());
        let (solved, found) = match solve_refined(&sums, settings, rule, prior, steps, request.watch) {
            Err(SolveError::Interrupted) => return Ok(None),
            solved => solved?,
        };
        // Only an interrupted solution is resumed.
        if let Some(file) = file.filter(|_| !request.setup.watch.was_cut()) {
            file.remove();
        }
        let HarmonicSolution { map_k, noise_k, diagnostics, uncertainty, .. } = solved;
        let (beams, refinement) = (Vec::new(), Some(found));
        Ok(Some(SolvedMap { map_k, noise_k, diagnostics, beams, refinement, uncertainty, movers: None }))
    }

    fn into_harmonic(self: Box<Self>) -> Result<Box<HarmonicSums>, &'static str> {
        Err("visibilities one by one")
    }
}
