//! The ground stage that solves sums for maps.

use std::collections::HashMap;
use std::path::PathBuf;
use std::sync::Arc;

use crate::frames::Instrument;
use crate::imaging::anywhere::{AssumedInstrument, IterationFile, RefinedSums};
use crate::imaging::anywhere::{RefineRule, RefineSteps, Refinement, solve_refined};
use crate::imaging::circle::{
    HarmonicRequest, HarmonicSolution, HarmonicSums, harmonic_beams, solve_regularised,
};
use crate::imaging::pixel::{MatrixFreeSums, PixelExtras, PixelSolution, PixelSums, PointBeam};
use crate::imaging::pixel::{solve_matrix_free, solve_pixels_with, solve_pixels_with_power};
use crate::imaging::solver::NamedWatch;
use crate::imaging::{Diagnostics, Regulariser, Samples, SolveError, SolveWatch, StoppingRule, Uncertainty};
use crate::imaging::{NormalSums, Snapshot, SnapshotData, SumCounts};
use crate::runtime::{Outlet, Stage, Units};
use crate::sky::healpix::{pixel_area_sr, pixel_count, pixel_of};
use crate::units::vector::direction;
use crate::units::{ChannelId, PerChannel};

/// A map of one channel.
pub struct Solution {
    /// Instrument.
    pub instrument: Arc<Instrument>,
    /// Channel.
    pub channel: ChannelId,
    /// Number of the snapshot in its channel, from 1.
    pub number: u32,
    /// Whether it is from all data; see also [`Solution::is_final_map`].
    pub is_final: bool,
    /// Mission times of its first and last data, s.
    pub span_s: [f64; 2],
    /// Number of visibilities in its sums.
    pub visibilities: u64,
    /// nside of the maps.
    pub nside: usize,
    /// Map, K, HEALPix RING, ecliptic.
    pub map_k: Vec<f64>,
    /// Noise-only map, from simulated noise with the data's weights, K.
    pub noise_k: Vec<f64>,
    /// Effective beams at the requested directions.
    pub beams: Vec<PointBeam>,
    /// Regularisation and convergence.
    pub diagnostics: Diagnostics,
    /// The iterations of its refinement and the remaining residuals; only with `map.refine`.
    pub refinement: Option<Refinement>,
    /// Errors of the map, and the sky's power that determines R; only with R from the data.
    pub uncertainty: Option<Uncertainty>,
}

impl Solution {
    /// Whether it is from all data and has converged.
    #[must_use]
    pub fn is_final_map(&self) -> bool {
        self.is_final && self.has_converged()
    }

    /// Whether its refinement has converged; true without refinement.
    #[must_use]
    pub fn has_converged(&self) -> bool {
        self.refinement.as_ref().is_none_or(|refinement| refinement.convergence.converged)
    }
}

/// Number of values that ranks compare before they solve.
const AGREED_VALUES: usize = 7;

/// Settings of the solving stage.
#[derive(Clone, Debug)]
pub struct SolverSetup {
    /// epsilon of R = epsilon W_max I.
    pub epsilon: PerChannel<f64>,
    /// Regulariser R by channel. The last one also holds for all further channels; the identity if there is none. Pixel maps support R from
    /// the data and the identity.
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
    /// Stopping rule of iterative solutions: harmonic maps, and matrix-free pixel maps.
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
    /// Receives progress and can interrupt a solution.
    pub watch: SolveWatch,
}

impl SolverSetup {
    /// The pixels of the requested beams.
    fn beam_pixels(&self, nside: usize) -> Vec<usize> {
        let pixel = |&[longitude_deg, latitude_deg]: &[f64; 2]| {
            pixel_of(nside, direction(longitude_deg, latitude_deg))
        };
        self.beams_deg.iter().map(pixel).collect()
    }

    /// The regulariser of a channel.
    #[must_use]
    #[doc(hidden)]
    pub fn regulariser(&self, channel: usize) -> Regulariser {
        self.regularisers.get(channel).or(self.regularisers.last()).cloned().unwrap_or_default()
    }
}

/// A stage that solves every snapshot.
pub struct Solver {
    setup: SolverSetup,
    solved: u64,
    last_solutions: LastSolutions,
}

impl Solver {
    /// Creates the stage.
    #[must_use]
    pub fn new(setup: SolverSetup) -> Self {
        Self { setup, solved: 0, last_solutions: HashMap::new() }
    }

    /// The prior of a channel, scaled up by the factor that [`Solver::without_reflection`] divides by.
    fn prior(&self, channel: usize, pixels: usize) -> Option<Vec<f64>> {
        let factor = 1.0 + self.setup.moon_reflection;
        if let Some(map) = self.setup.prior_maps.get(channel) {
            return Some(map.iter().map(|value| factor * value).collect());
        }
        let level_k = self.setup.prior_k.get(channel).filter(|&level_k| level_k != 0.0)?;
        Some(vec![factor * level_k; pixels])
    }

    /// Divides a map by 1 + xi_R. A solution is linear in visibilities and prior together, so this equals the map of divided visibilities.
    fn without_reflection(&self, mut map_k: Vec<f64>) -> Vec<f64> {
        let factor = 1.0 + self.setup.moon_reflection;
        map_k.iter_mut().for_each(|value| *value /= factor);
        map_k
    }
}

/// A map with its diagnostics.
struct SolvedMap {
    map_k: Vec<f64>,
    noise_k: Vec<f64>,
    diagnostics: Diagnostics,
    beams: Vec<PointBeam>,
    refinement: Option<Refinement>,
    uncertainty: Option<Uncertainty>,
}

impl SolvedMap {
    fn from_pixels(solved: PixelSolution, uncertainty: Option<Uncertainty>) -> Self {
        let PixelSolution { map_k, noise_k, diagnostics, beams } = solved;
        Self { map_k, noise_k, diagnostics, beams, refinement: None, uncertainty }
    }
}

/// The settings for solving one snapshot.
struct Request<'a> {
    setup: &'a SolverSetup,
    channel: ChannelId,
    nside: usize,
    is_final: bool,
    epsilon: f64,
    prior: Option<Vec<f64>>,
    /// Pixels of the requested beams.
    beam_pixels: Vec<usize>,
    watch: NamedWatch<'a>,
}

/// The last iterative solution of each channel, from which its next one starts.
type LastSolutions = HashMap<ChannelId, [Vec<f64>; 2]>;

/// Each method returns `None` for an intermediate map that was interrupted, or that the data do not determine yet.
impl Request<'_> {
    /// The count for a final map, 0 for an intermediate one.
    fn if_final(&self, count: usize) -> usize {
        if self.is_final { count } else { 0 }
    }

    fn is_stopped(&self) -> bool {
        !self.watch.may_continue() && !self.is_final
    }

    fn samples(&self) -> Samples {
        if self.is_final { self.setup.samples } else { Samples::default() }
    }

    fn harmonic_request(&self) -> HarmonicRequest {
        let samples = self.samples();
        let probes = self.if_final(self.setup.trace_probes);
        HarmonicRequest { epsilon: self.epsilon, nside: self.nside, rule: self.setup.rule, samples, probes }
    }

    fn pixels_with_power(&self, sums: &PixelSums) -> Result<Option<SolvedMap>, SolveError> {
        let samples = self.samples();
        let prior = self.prior.as_deref();
        match solve_pixels_with_power(sums, prior, samples, &self.beam_pixels, self.watch) {
            Err(SolveError::Interrupted) => Ok(None),
            Err(SolveError::NoPower) if !self.is_final => Ok(None),
            solved => solved.map(|(solved, errors)| Some(SolvedMap::from_pixels(solved, Some(errors)))),
        }
    }

    fn pixels(&self, sums: PixelSums) -> Result<Option<SolvedMap>, SolveError> {
        let probes = self.if_final(self.setup.trace_probes);
        let extras = PixelExtras { probes, beams: &self.beam_pixels };
        match solve_pixels_with(sums, self.epsilon, self.prior.as_deref(), extras, self.watch) {
            Err(SolveError::Interrupted) => Ok(None),
            // The first data, or forged data, may not determine a map. A later snapshot has more data, so only a final failure is an error.
            Err(SolveError::NotPositive { .. }) if !self.is_final => Ok(None),
            solved => solved.map(|solved| Some(SolvedMap::from_pixels(solved, None))),
        }
    }

    fn harmonics(
        &self,
        sums: &HarmonicSums,
        regulariser: Regulariser,
        last: &mut LastSolutions,
    ) -> Result<Option<SolvedMap>, SolveError> {
        let request = self.harmonic_request();
        let (prior, start) = (self.prior.as_deref(), last.remove(&self.channel));
        let solved = solve_regularised(sums, request, &regulariser, prior, start.as_ref(), self.watch);
        if let Some(reason) = sums.failure() {
            return Err(SolveError::Sums(reason.to_owned()));
        }
        let solved = match solved {
            Err(SolveError::NoPower) if !self.is_final => return Ok(None),
            solved => solved?,
        };
        if self.is_stopped() {
            return Ok(None);
        }
        let HarmonicSolution { map_k, noise_k, unknowns, diagnostics, uncertainty } = solved;
        let mut beams = Vec::new();
        if !self.beam_pixels.is_empty() {
            let w_max = diagnostics.w_max.unwrap_or(0.0) / pixel_area_sr(self.nside);
            // Beams use the R that was found from the data.
            let power_k2 = uncertainty.as_ref().map(|errors| errors.power.over_noise_k2());
            let epsilon = if power_k2.is_some() { 1.0 } else { self.epsilon };
            let regulariser = power_k2.map_or(regulariser, Regulariser::Wiener);
            let request = HarmonicRequest { epsilon, ..request };
            beams = harmonic_beams(sums, request, (&regulariser, w_max), &self.beam_pixels, self.watch)?;
        }
        if !self.is_final {
            last.insert(self.channel, unknowns);
        }
        Ok(Some(SolvedMap { map_k, noise_k, diagnostics, beams, refinement: None, uncertainty }))
    }

    fn matrix_free(
        &self,
        sums: &MatrixFreeSums,
        last: &mut LastSolutions,
    ) -> Result<Option<SolvedMap>, SolveError> {
        // A final solution starts from zero, so that its bits do not depend on intermediate maps.
        let start = last.remove(&self.channel).filter(|_| !self.is_final);
        let (prior, rule) = (self.prior.as_deref(), self.setup.rule);
        let (solved, unknowns) = match solve_matrix_free(sums, self.epsilon, prior, start, rule, self.watch) {
            Err(SolveError::Interrupted) => return Ok(None),
            solved => solved?,
        };
        if self.is_stopped() {
            return Ok(None);
        }
        if !self.is_final {
            last.insert(self.channel, unknowns);
        }
        Ok(Some(SolvedMap::from_pixels(solved, None)))
    }

    /// Refines a map; `fingerprint` identifies the data, so that a saved solution of other data is not used.
    fn refined(&self, sums: &RefinedSums, fingerprint: &[i64]) -> Result<Option<SolvedMap>, SolveError> {
        let request = HarmonicRequest { probes: 0, ..self.harmonic_request() };
        let fingerprint = [fingerprint, &[self.epsilon.to_bits().cast_signed()]].concat();
        let file = self
            .setup
            .iteration_folder
            .as_ref()
            .map(|folder| IterationFile::new(folder, self.channel, &fingerprint));
        // An intermediate map would not help: it is the circle's, with which the iteration starts anyway.
        let start = file.as_ref().and_then(IterationFile::read);
        let mut save = |x: [&[f64]; 2]| {
            if let Some(file) = &file {
                file.write(x);
            }
        };
        let steps = RefineSteps { start, save: &mut save };
        let regulariser = self.setup.regulariser(usize::from(self.channel.0));
        let (rule, prior) = ((self.setup.refine, &regulariser), self.prior.as_deref());
        let (solved, found) = match solve_refined(sums, request, rule, prior, steps, self.watch) {
            Err(SolveError::Interrupted) => return Ok(None),
            solved => solved?,
        };
        // Only an interrupted solution is resumed.
        if let Some(file) = file.filter(|_| self.watch.may_continue()) {
            file.remove();
        }
        let HarmonicSolution { map_k, noise_k, diagnostics, uncertainty, .. } = solved;
        let (beams, refinement) = (Vec::new(), Some(found));
        Ok(Some(SolvedMap { map_k, noise_k, diagnostics, beams, refinement, uncertainty }))
    }
}

impl Stage for Solver {
    type In = Snapshot;
    type Out = Solution;
    type Error = SolveError;

    fn step(&mut self, snapshot: Snapshot, out: &mut Outlet<Solution>) -> Result<(), SolveError> {
        let Snapshot { instrument, channel, number, is_final, span_s, nside, data } = snapshot;
        let SumCounts { visibilities, weight, .. } = data.counts();
        let identity = [i64::from(channel.0), i64::from(number), i64::from(is_final), visibilities as i64];
        let values = [span_s[0], span_s[1], weight].map(|x| x.to_bits().cast_signed());
        let fingerprint = [identity.as_slice(), &values].concat();
        if !self.setup.watch.agrees(&fingerprint) {
            return Err(SolveError::Ranks);
        }
        let index = usize::from(channel.0);
        let epsilon = self.setup.epsilon.get(index).ok_or(SolveError::NoEpsilon(channel))?;
        let prior = self.prior(index, pixel_count(nside));
        let frequency_hz = instrument.channels.get(index).map_or(0.0, |c| c.frequency_hz);
        if let Some(&Some(prior_hz)) = self.setup.prior_hz.get(index)
            && (prior_hz - frequency_hz).abs() > 1e-6 * frequency_hz
        {
            return Err(SolveError::PriorFrequency { channel, prior_hz, data_hz: frequency_hz });
        }
        let name = format!("{:.3} MHz", frequency_hz / 1e6);
        let (setup, last) = (&self.setup, &mut self.last_solutions);
        // An intermediate map must not take time from a final one.
        let watch = setup.watch.named(&name).with_priority(is_final);
        if !watch.may_continue() {
            return Ok(());
        }
        let beam_pixels = if is_final { setup.beam_pixels(nside) } else { Vec::new() };
        let assumed = AssumedInstrument {
            satellites: instrument.satellites.into(),
            epoch_tai_s: instrument.epoch_tai_s,
            ..setup.assumed.clone()
        };
        let request = Request { setup, channel, nside, is_final, epsilon, prior, beam_pixels, watch };
        let regulariser = setup.regulariser(index);
        let solved = match data {
            SnapshotData::Pixel(sums) if regulariser == Regulariser::Data => request.pixels_with_power(&sums),
            SnapshotData::Pixel(sums) => request.pixels(sums),
            SnapshotData::Harmonic(sums) => request.harmonics(&sums, regulariser, last),
            SnapshotData::MatrixFree(visibilities) => request.matrix_free(&visibilities.into_sums()?, last),
            SnapshotData::Refined(archive) => request.refined(&archive.into_sums(&assumed)?, &fingerprint),
        };
        let Some(solved) = solved? else { return Ok(()) };
        let SolvedMap { map_k, noise_k, diagnostics, beams, refinement, uncertainty } = solved;
        self.solved += 1;
        out.push(Solution {
            instrument,
            channel,
            number,
            is_final,
            span_s,
            visibilities,
            nside,
            map_k: self.without_reflection(map_k),
            noise_k: self.without_reflection(noise_k),
            beams,
            diagnostics,
            refinement,
            uncertainty: uncertainty.map(|errors| errors.divided_by(1.0 + self.setup.moon_reflection)),
        });
        Ok(())
    }

    fn finish(&mut self, _out: &mut Outlet<Solution>) -> Result<(), SolveError> {
        // Other ranks might still have a snapshot to solve.
        if self.setup.watch.agrees(&[-1; AGREED_VALUES]) { Ok(()) } else { Err(SolveError::Ranks) }
    }

    fn units(&self) -> Units {
        Units::of(self.solved, "maps")
    }
}
