//! Maps of satellites on one circular orbit, as a map method. It alone divides its sums among ranks and readings.

use std::io::{Read, Write};
use std::path::Path;

use crate::frames::{PlacedVisibilities, VisibilityReason};
use crate::imaging::anywhere::SegmentFolder;
use crate::imaging::circle::{
    HarmonicEngine, HarmonicRequest, HarmonicSetup, HarmonicSolution, HarmonicSums, MoverSums, NoiseSums,
    SumPart, beams_with_power, harmonic_beams, harmonic_cost, nominal_orbit, solve_regularised,
};
use crate::imaging::cost::{ChannelData, EngineCost};
use crate::imaging::method::{MapEquations, MapMethod, MapSums, NewChannel, NewOrRefused, same_method};
use crate::imaging::request::{MapRequest, SolvedMap};
use crate::imaging::{AccumulationError, Added, MapConfig, NormalEngine, NormalSums};
use crate::imaging::{SolveError, SumCounts};
use crate::ranks::{RankShare, Ranks};
use crate::sky::healpix::pixel_area_sr;

/// Maps over spherical harmonics.
pub(in crate::imaging) struct CircleMaps;

impl MapMethod for CircleMaps {
    fn create(&self, channel: &NewChannel<'_>) -> Result<NewOrRefused<Box<dyn MapSums>>, AccumulationError> {
        let NewChannel { config, instrument, placed, frequency_hz, weight_max, share } = *channel;
        let (moon_radius_m, baseline_m_max) = (instrument.moon_radius_m, config.baseline_m_max(frequency_hz));
        let Some(orbit) = nominal_orbit(placed, config.limits) else {
            return Ok(Err(VisibilityReason::NoDirection));
        };
        // Positions are untrusted: an orbit inside the Moon, or smaller than the longest baseline, is refused. Later data may still create
        // the engine.
        if orbit.radius_m <= moon_radius_m.max(baseline_m_max) {
            return Ok(Err(VisibilityReason::OffAltitude));
        }
        let engine = HarmonicEngine::new(HarmonicSetup {
            l_max: config.degree(),
            frequency_hz,
            baseline_m_max,
            moon_radius_m,
            response: instrument.response,
            orbit,
            companion_seed: config.companion_seed,
            weight_max,
        })?
        .with_ranks(&share.part.as_ref().map_or_else(|| share.ranks.clone(), SumPart::ranks));
        if !config.movers.is_empty() && (share.part.is_some() || share.ranks.is_distributed()) {
            return Err(AccumulationError::Movers {
                what: "parts of the sums (several ranks, or memory for all of them)",
            });
        }
        let movers = (!config.movers.is_empty())
            .then(|| MoverSums::new(&engine, &config.movers, instrument.epoch_tai_s));
        let seeds = &share.realisation_seeds;
        let realisations = (!seeds.is_empty()).then(|| NoiseSums::new(&engine, seeds));
        Ok(Ok(Box::new(CircleSums { engine, realisations, movers, part: share.part.clone() })))
    }

    fn load(
        &self,
        _config: &MapConfig,
        from: &mut dyn Read,
        _folder: Option<&Path>,
        (part, ranks): (RankShare, &Ranks),
    ) -> Result<Box<dyn MapSums>, AccumulationError> {
        let engine = HarmonicEngine::restore_part(from, part, ranks)?;
        Ok(Box::new(CircleSums { engine, realisations: None, movers: None, part: None }))
    }

    fn cost(&self, map: &MapConfig, data: ChannelData) -> EngineCost {
        harmonic_cost(map, data)
    }
}

/// The sums of a channel, with those of additional noise realisations and of bodies that move.
struct CircleSums {
    engine: HarmonicEngine,
    realisations: Option<NoiseSums>,
    movers: Option<MoverSums>,
    /// The part of the sums that this reading of the data makes.
    part: Option<SumPart>,
}

impl MapSums for CircleSums {
    fn add(&mut self, placed: &PlacedVisibilities) -> Result<Added, AccumulationError> {
        let added = self.engine.add(placed)?;
        if let Some(realisations) = &mut self.realisations {
            realisations.add(&self.engine, placed);
        }
        if let Some(movers) = &mut self.movers {
            movers.add(&self.engine, placed);
        }
        Ok(added)
    }

    fn remove(&mut self, placed: &PlacedVisibilities) -> Result<Added, AccumulationError> {
        if let Some(realisations) = &mut self.realisations {
            realisations.remove(&self.engine, placed);
        }
        if let Some(movers) = &mut self.movers {
            movers.remove(&self.engine, placed);
        }
        self.engine.remove(placed)
    }

    fn merge(&mut self, other: Box<dyn MapSums>) -> Result<(), AccumulationError> {
        self.engine.merge(same_method::<Self>(other)?.engine)
    }

    fn join(&mut self, other: Box<dyn MapSums>) -> Result<(), AccumulationError> {
        self.engine.join(same_method::<Self>(other)?.engine)
    }

    fn save(&mut self, out: &mut dyn Write, _segments: SegmentFolder<'_>) -> Result<(), AccumulationError> {
        self.engine.checkpoint(out)
    }

    fn counts(&self) -> SumCounts {
        self.engine.counts()
    }

    fn snapshot(&mut self) -> Result<Box<dyn MapEquations>, AccumulationError> {
        Ok(Box::new(self.engine.sums()))
    }

    fn finish(self: Box<Self>) -> Result<Option<Box<dyn MapEquations>>, AccumulationError> {
        let sums = match (self.part, self.realisations) {
            (Some(part), _) => self.engine.finish_part(&part)?,
            (None, Some(noises)) => Some(self.engine.into_sums().with_noise_realisations(noises)),
            (None, None) => Some(self.engine.into_sums()),
        };
        let sums = match self.movers {
            Some(movers) => sums.map(|sums| sums.with_movers(movers)),
            None => sums,
        };
        Ok(sums.map(|sums| Box::new(sums) as Box<dyn MapEquations>))
    }
}

impl MapEquations for HarmonicSums {
    fn counts(&self) -> SumCounts {
        NormalSums::counts(self)
    }

    fn solve(mut self: Box<Self>, request: MapRequest<'_>) -> Result<Option<SolvedMap>, SolveError> {
        let settings = HarmonicRequest::of(&request);
        let (regulariser, prior, watch) = (&request.regulariser, request.prior.as_deref(), request.watch);
        let movers = self.take_movers(settings, regulariser, prior, watch)?;
        let start = request.last.take();
        let solved = solve_regularised(&self, settings, regulariser, prior, start.as_ref(), watch);
        if let Some(reason) = self.failure() {
            return Err(SolveError::Sums(reason.to_owned()));
        }
        let solved = match solved {
            Err(SolveError::NoPower) if !request.is_final => return Ok(None),
            solved => solved?,
        };
        if request.is_stopped() {
            return Ok(None);
        }
        let HarmonicSolution { map_k, noise_k, unknowns, diagnostics, uncertainty } = solved;
        let (mut beams, beam_pixels) = (Vec::new(), request.beam_pixels());
        if !beam_pixels.is_empty() {
            let watch = watch.beside_map();
            beams = match &uncertainty {
                // Beams use the R that was found from the data.
                Some(errors) => {
                    let r = errors.power.over_noise_k2().into_iter().map(f64::recip).collect();
                    beams_with_power(&self, settings, r, &beam_pixels, watch)?
                }
                None => {
                    let w_max = diagnostics.w_max.unwrap_or(0.0) / pixel_area_sr(request.nside);
                    harmonic_beams(&self, settings, (regulariser, w_max), &beam_pixels, watch)?
                }
            };
        }
        match (&request.setup.kept, request.is_final) {
            (_, false) => *request.last = Some(unknowns),
            (Some(kept), true) => kept.keep(request.channel, request.nside, *self),
            (None, true) => {}
        }
        Ok(Some(SolvedMap { map_k, noise_k, diagnostics, beams, refinement: None, uncertainty, movers }))
    }

    fn into_harmonic(self: Box<Self>) -> Result<Box<HarmonicSums>, &'static str> {
        Ok(self)
    }
}

impl HarmonicRequest {
    /// The settings of a map over harmonics.
    pub(in crate::imaging) fn of(request: &MapRequest<'_>) -> Self {
        let &MapRequest { epsilon, nside, setup, .. } = request;
        Self { epsilon, nside, rule: setup.rule, samples: request.samples(), probes: request.probes() }
    }
}
