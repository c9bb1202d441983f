//! Pixel maps as map methods: with a stored matrix, or from visibilities whose rows are computed again.

use std::io::{Read, Write};
use std::path::Path;

use super::anywhere::{ArchiveSolver, ArchivedSums};
use crate::frames::PlacedVisibilities;
use crate::imaging::anywhere::{SegmentFolder, VisibilityArchive};
use crate::imaging::circle::{HarmonicRequest, HarmonicSums};
use crate::imaging::cost::{ChannelData, EngineCost};
use crate::imaging::method::{MapEquations, MapMethod, MapSums, NewChannel, NewOrRefused, same_method};
use crate::imaging::pixel::{
    MatrixFreeVisibilities, POWER_NSIDE_MAX, PixelEngine, PixelEquations, PixelExtras, PixelSetup,
    PixelSolution, PixelSums, SolvedByDegree, averaged_blocks, degree_max, matrix_free_cost, pixel_cost,
    solve_matrix_free, solve_pixels_with, solve_pixels_with_power,
};
use crate::imaging::request::{MapRequest, SolvedMap};
use crate::imaging::{AccumulationError, Added, MapConfig, NormalEngine, Regulariser};
use crate::imaging::{SolveError, SumCounts, Uncertainty};
use crate::ranks::{RankShare, Ranks};
use crate::response::pixel::PixelMethod;

/// Maps over pixels with a stored matrix.
pub(in crate::imaging) struct PixelMaps;

impl MapMethod for PixelMaps {
    fn create(&self, channel: &NewChannel<'_>) -> Result<NewOrRefused<Box<dyn MapSums>>, AccumulationError> {
        let NewChannel { config, instrument, frequency_hz, weight_max, .. } = *channel;
        let engine = PixelEngine::new(PixelSetup {
            nside: config.nside,
            frequency_hz,
            method: config.rows,
            moon_radius_m: instrument.moon_radius_m,
            response: instrument.response,
            companion_seed: config.companion_seed,
            weight_max,
        })?;
        Ok(Ok(Box::new(engine)))
    }

    fn load(
        &self,
        _config: &MapConfig,
        from: &mut dyn Read,
        _folder: Option<&Path>,
        _shares: (RankShare, &Ranks),
    ) -> Result<Box<dyn MapSums>, AccumulationError> {
        Ok(Box::new(PixelEngine::restore(from)?))
    }

    fn cost(&self, map: &MapConfig, data: ChannelData) -> EngineCost {
        pixel_cost(map, data.solutions)
    }
}

impl MapSums for PixelEngine {
    fn add(&mut self, placed: &PlacedVisibilities) -> Result<Added, AccumulationError> {
        NormalEngine::add(self, placed)
    }

    fn remove(&mut self, placed: &PlacedVisibilities) -> Result<Added, AccumulationError> {
        NormalEngine::remove(self, placed)
    }

    fn merge(&mut self, other: Box<dyn MapSums>) -> Result<(), AccumulationError> {
        NormalEngine::merge(self, *same_method(other)?)
    }

    fn save(&mut self, out: &mut dyn Write, _segments: SegmentFolder<'_>) -> Result<(), AccumulationError> {
        self.checkpoint(out)
    }

    fn counts(&self) -> SumCounts {
        NormalEngine::counts(self)
    }

    fn snapshot(&mut self) -> Result<Box<dyn MapEquations>, AccumulationError> {
        Ok(Box::new(self.sums()))
    }

    fn finish(self: Box<Self>) -> Result<Option<Box<dyn MapEquations>>, AccumulationError> {
        Ok(Some(Box::new(self.into_sums())))
    }
}

impl MapEquations for PixelSums {
    fn counts(&self) -> SumCounts {
        self.counts
    }

    fn solve(self: Box<Self>, request: MapRequest<'_>) -> Result<Option<SolvedMap>, SolveError> {
        let (prior, beams, watch) = (request.prior.as_deref(), &request.beam_pixels()[..], request.watch);
        let solved = match &request.regulariser {
            Regulariser::Data if request.nside <= POWER_NSIDE_MAX => {
                solve_pixels_with_power(&self, prior, request.samples(), beams, watch)
                    .map(|(solved, errors)| solved.into_map(Some(errors)))
            }
            regulariser if *regulariser != Regulariser::default() => {
                let equations = PixelEquations { sums: &*self, blocks: &averaged_blocks(&self) };
                let settings = HarmonicRequest::of(&request);
                equations
                    .solve(settings, regulariser, prior, None, beams, watch)
                    .map(|solved| solved.solution.into_map(solved.uncertainty))
            }
            _ => {
                let extras = PixelExtras { probes: request.probes(), beams };
                solve_pixels_with(*self, request.epsilon, prior, extras, watch).map(|map| map.into_map(None))
            }
        };
        if request.is_stopped() {
            return Ok(None);
        }
        match solved {
            Err(SolveError::Interrupted) => Ok(None),
            // The first data, or forged data, may not determine a map. A later snapshot has more data, so only a final failure is an error.
            Err(SolveError::NotPositive { .. } | SolveError::NoPower) if !request.is_final => Ok(None),
            solved => solved.map(Some),
        }
    }

    fn into_harmonic(self: Box<Self>) -> Result<Box<HarmonicSums>, &'static str> {
        Err("sums over pixels")
    }
}

impl MatrixFreeVisibilities {
    /// Solves with an R that depends on the degree, with the blocks of the nearest circle as preconditioner.
    fn solve_by_degree(
        mut self: Box<Self>,
        request: &MapRequest<'_>,
        start: Option<[Vec<f64>; 2]>,
    ) -> Result<SolvedByDegree, SolveError> {
        let order_blocks = self.archive.order_blocks(degree_max(self.nside))?;
        let sums = self.into_sums()?;
        let equations = PixelEquations { sums: &sums, blocks: &order_blocks.blocks() };
        let (settings, regulariser) = (HarmonicRequest::of(request), &request.regulariser);
        let prior = request.prior.as_deref();
        equations.solve(settings, regulariser, prior, start.as_ref(), &[], request.watch)
    }
}

impl PixelSolution {
    fn into_map(self, uncertainty: Option<Uncertainty>) -> SolvedMap {
        let Self { map_k, noise_k, diagnostics, beams } = self;
        SolvedMap { map_k, noise_k, diagnostics, beams, refinement: None, uncertainty, movers: None }
    }
}

/// Maps over pixels from visibilities whose rows of B are computed again for each product.
pub(in crate::imaging) struct MatrixFreeMaps;

/// What rows of pixels an archive of visibilities is solved with.
#[derive(Clone, Copy)]
struct PixelRows {
    nside: usize,
    method: PixelMethod,
}

impl PixelRows {
    fn of(config: &MapConfig) -> Self {
        Self { nside: config.nside, method: config.rows }
    }
}

impl ArchiveSolver for PixelRows {
    fn snapshot(&self, archive: &mut VisibilityArchive) -> Result<Box<dyn MapEquations>, AccumulationError> {
        Ok(self.finish(archive.copy()))
    }

    fn finish(self, archive: VisibilityArchive) -> Box<dyn MapEquations> {
        Box::new(MatrixFreeVisibilities { nside: self.nside, method: self.method, archive })
    }
}

impl MapMethod for MatrixFreeMaps {
    fn create(&self, channel: &NewChannel<'_>) -> Result<NewOrRefused<Box<dyn MapSums>>, AccumulationError> {
        // A pixel map has no l_max.
        Ok(Ok(Box::new(ArchivedSums::new(channel, 0, PixelRows::of(channel.config))?)))
    }

    fn load(
        &self,
        config: &MapConfig,
        from: &mut dyn Read,
        folder: Option<&Path>,
        _shares: (RankShare, &Ranks),
    ) -> Result<Box<dyn MapSums>, AccumulationError> {
        Ok(Box::new(ArchivedSums::load(config, from, folder, PixelRows::of(config))?))
    }

    fn cost(&self, map: &MapConfig, data: ChannelData) -> EngineCost {
        matrix_free_cost(map, data)
    }
}

impl MapEquations for MatrixFreeVisibilities {
    fn counts(&self) -> SumCounts {
        self.archive.counts()
    }

    fn solve(self: Box<Self>, request: MapRequest<'_>) -> Result<Option<SolvedMap>, SolveError> {
        // A final solution starts from zero, so that its bits do not depend on intermediate maps.
        let start = request.last.take().filter(|_| !request.is_final);
        let solved = if request.regulariser == Regulariser::default() {
            let (prior, rule) = (request.prior.as_deref(), request.setup.rule);
            let sums = self.into_sums()?;
            solve_matrix_free(&sums, request.epsilon, prior, start, rule, request.watch)
                .map(|(solution, unknowns)| SolvedByDegree { solution, unknowns, uncertainty: None })
        } else {
            self.solve_by_degree(&request, start)
        };
        let SolvedByDegree { solution, unknowns, uncertainty } = match solved {
            Err(SolveError::Interrupted) => return Ok(None),
            Err(SolveError::NoPower) if !request.is_final => return Ok(None),
            solved => solved?,
        };
        if request.is_stopped() {
            return Ok(None);
        }
        if !request.is_final {
            *request.last = Some(unknowns);
        }
        Ok(Some(solution.into_map(uncertainty)))
    }

    fn into_harmonic(self: Box<Self>) -> Result<Box<HarmonicSums>, &'static str> {
        Err("visibilities one by one")
    }
}
