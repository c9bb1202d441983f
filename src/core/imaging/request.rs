//! Settings of the maps' solution, and the map that it gives.

use std::path::PathBuf;
use std::sync::{Arc, Mutex, PoisonError};

use super::anywhere::{AssumedInstrument, RefineRule, Refinement};
use super::circle::{HarmonicSums, MoverFluxes};
use super::solver::{Diagnostics, NamedWatch, PointBeam, SolveWatch, StoppingRule};
use super::{Regulariser, Samples, Uncertainty};
use crate::frames::Instrument;
use crate::sky::healpix::pixel_of;
use crate::units::vector::direction;
use crate::units::{ChannelId, PerChannel};

/// Settings of the solving stage.
#[derive(Clone, Debug)]
pub struct SolverSetup {
    /// epsilon of R = epsilon W_max I.
    pub epsilon: PerChannel<f64>,
    /// Regulariser R by channel. The last one also holds for all further channels; the identity if there is none.
    pub regularisers: Vec<Regulariser>,
    /// Ecliptic longitudes and latitudes, degrees, for which the effective beam of a final map is computed.
    pub beams_deg: Vec<[f64; 2]>,
    /// Uniform prior, K.
    pub prior_k: PerChannel<f64>,
    /// Prior maps by channel, K, at the map's nside; empty for none.
    pub prior_maps: Vec<Vec<f64>>,
    /// Frequencies that the files of the prior maps state, Hz.
    pub prior_hz: Vec<Option<f64>>,
    /// Assumed reflectivity of the Moon: visibilities are divided by 1 plus this.
    pub moon_reflection: f64,
    /// Stopping rule of iterative solutions: harmonic maps, and pixel maps without a matrix or whose R depends on the degree.
    pub rule: StoppingRule,
    /// Stopping rule of the refinement of a harmonic map.
    pub refine: RefineRule,
    /// Instrument that the rows of a refined map assume.
    pub assumed: AssumedInstrument,
    /// Folder in which each iteration of a refinement saves its solution, so that an interrupted one can resume; `None` to save nothing.
    pub iteration_folder: Option<PathBuf>,
    /// Random probes for the traces of a final map whose matrix is too large to store; 0 for no traces.
    pub trace_probes: usize,
    /// Number of posterior samples of a final map; with R from the data.
    pub samples: Samples,
    /// Keeps the sums of final maps over harmonics after they are solved; `None` to free them.
    pub kept: Option<KeptSums>,
    /// Receives progress and can interrupt a solution.
    pub watch: SolveWatch,
}

/// Sums of final maps over harmonics, each with its channel and nside, in the order in which they were solved. Clones share them.
#[derive(Clone, Debug, Default)]
pub struct KeptSums(Arc<Mutex<Vec<(ChannelId, usize, HarmonicSums)>>>);

impl KeptSums {
    pub(super) fn keep(&self, channel: ChannelId, nside: usize, sums: HarmonicSums) {
        self.0.lock().unwrap_or_else(PoisonError::into_inner).push((channel, nside, sums));
    }

    /// Takes all that was kept.
    #[must_use]
    pub fn take(&self) -> Vec<(ChannelId, usize, HarmonicSums)> {
        std::mem::take(&mut self.0.lock().unwrap_or_else(PoisonError::into_inner))
    }
}

impl SolverSetup {
    /// The regulariser of a channel.
    #[must_use]
    #[doc(hidden)]
    pub fn regulariser(&self, channel: usize) -> Regulariser {
        self.regularisers.get(channel).or(self.regularisers.last()).cloned().unwrap_or_default()
    }
}

/// The unknowns of a map and its noise map, from which the next solution of the channel starts.
pub type LastSolution = Option<[Vec<f64>; 2]>;

/// The settings for solving one snapshot.
pub struct MapRequest<'a> {
    /// Settings of all channels.
    pub setup: &'a SolverSetup,
    /// Instrument.
    pub instrument: &'a Instrument,
    /// Channel.
    pub channel: ChannelId,
    /// nside of the map.
    pub nside: usize,
    /// Whether it is of all data.
    pub is_final: bool,
    /// epsilon of the channel.
    pub epsilon: f64,
    /// R of the channel.
    pub regulariser: Regulariser,
    /// Prior map, K.
    pub prior: Option<Vec<f64>>,
    /// Identifies the data, so that a saved solution of other data is not used.
    pub fingerprint: &'a [i64],
    /// The last iterative solution of the channel.
    pub last: &'a mut LastSolution,
    /// Receives progress and can interrupt the solution.
    pub watch: NamedWatch<'a>,
}

impl MapRequest<'_> {
    /// The pixels of the requested beams: only a final map has any.
    pub(super) fn beam_pixels(&self) -> Vec<usize> {
        let beams = if self.is_final { &self.setup.beams_deg[..] } else { &[] };
        beams.iter().map(|&[lon_deg, lat_deg]| pixel_of(self.nside, direction(lon_deg, lat_deg))).collect()
    }

    /// Number of probes for traces, of a final map only.
    pub(super) fn probes(&self) -> usize {
        if self.is_final { self.setup.trace_probes } else { 0 }
    }

    /// Samples of a final map.
    pub(super) fn samples(&self) -> Samples {
        if self.is_final { self.setup.samples } else { Samples::default() }
    }

    /// Whether an intermediate map was interrupted.
    pub(super) fn is_stopped(&self) -> bool {
        !self.is_final && !self.watch.may_continue()
    }
}

/// A map with its diagnostics.
pub struct SolvedMap {
    /// Map, K.
    pub map_k: Vec<f64>,
    /// Noise-only map, K.
    pub noise_k: Vec<f64>,
    /// Regularisation and convergence.
    pub diagnostics: Diagnostics,
    /// Requested beams.
    pub beams: Vec<PointBeam>,
    /// Iterations of a refined map.
    pub refinement: Option<Refinement>,
    /// Errors, with R from the data.
    pub uncertainty: Option<Uncertainty>,
    /// Fluxes of the bodies that were solved for beside it.
    pub movers: Option<MoverFluxes>,
}
