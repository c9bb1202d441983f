//! The ground stage that turns sums into maps.

use std::collections::HashMap;
use std::path::PathBuf;
use std::sync::Arc;

use crate::frames::Instrument;
use crate::imaging::anywhere::{AssumedInstrument, PassFile, RefinedSums};
use crate::imaging::anywhere::{RefineRule, RefineSteps, Refinement, solve_refined};
use crate::imaging::circle::{
    HarmonicRequest, HarmonicSolution, HarmonicSums, harmonic_beams, solve_regularised,
};
use crate::imaging::pixel::{MatrixFreeSums, PixelExtras, PixelSolution, PixelSums, PointBeam};
use crate::imaging::pixel::{solve_matrix_free, solve_pixels_with, solve_pixels_with_power};
use crate::imaging::solver::NamedWatch;
use crate::imaging::{Diagnostics, Regulariser, Samples, SolveError, SolveWatch, StoppingRule, Uncertainty};
use crate::imaging::{NormalSums, Snapshot, SnapshotSums, SumCounts};
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
    /// Whether it is from all data. Whether it may be called final is [`Solution::is_final_map`].
    pub is_final: bool,
    /// First and last mission time of its data, s.
    pub span_s: [f64; 2],
    /// Visibilities in the sums.
    pub visibilities: u64,
    /// nside of the maps.
    pub nside: usize,
    /// Map, K, HEALPix RING, ecliptic.
    pub map_k: Vec<f64>,
    /// Map of noise alone, made from noise of the data's weights, K.
    pub noise_k: Vec<f64>,
    /// Effective beams, if directions were asked for.
    pub beams: Vec<PointBeam>,
    /// Regularisation and convergence.
    pub diagnostics: Diagnostics,
    /// How it was refined, and the residuals that remain; only with `map.refine`.
    pub refinement: Option<Refinement>,
    /// Errors of the map, and the sky's power that R is from; only with R from the data.
    pub uncertainty: Option<Uncertainty>,
}

impl Solution {
    /// Whether it may be called final: from all data and, where it was refined, converged.
    #[must_use]
    pub fn is_final_map(&self) -> bool {
        self.is_final && self.has_converged()
    }

    /// Whether its refinement, if there was one, has converged: more passes would change the map.
    #[must_use]
    pub fn has_converged(&self) -> bool {
        self.refinement.as_ref().is_none_or(|refinement| refinement.convergence.converged)
    }
}

/// Numbers in which ranks agree before they solve.
const QUESTIONS: usize = 7;

/// Regularisation and prior, by channel.
#[derive(Clone, Debug)]
pub struct SolverSetup {
    /// epsilon of R = epsilon W_max I.
    pub epsilon: PerChannel<f64>,
    /// What R is, by channel. The last holds for the channels beyond; the identity if there is none. Pixels have R from the data or the
    /// identity.
    pub regularisers: Vec<Regulariser>,
    /// Ecliptic longitudes and latitudes, degrees, at which a final map's effective beam is solved for.
    pub beams_deg: Vec<[f64; 2]>,
    /// Uniform prior, K.
    pub prior_k: PerChannel<f64>,
    /// Prior maps by channel, K, at the map's nside; empty for none.
    pub prior_maps: Vec<Vec<f64>>,
    /// Share of the sky's power that the Moon is taken to reflect: visibilities are divided by 1 + this.
    pub moon_reflection: f64,
    /// When the iteration of a map stops, of harmonics or of pixels without their matrix.
    pub rule: StoppingRule,
    /// When the refinement of a harmonic map stops.
    pub refine: RefineRule,
    /// What rows are made with in it.
    pub assumed: AssumedInstrument,
    /// Folder in which the passes of a refinement leave their solution, so that one that was interrupted can go on; `None` for
    /// nowhere.
    pub passes: Option<PathBuf>,
    /// Random probes for the traces of a final map, where its matrix is too large to be held; 0 for no traces.
    pub trace_probes: usize,
    /// Maps as likely as a final map that are drawn beside it, with R from the data.
    pub samples: Samples,
    /// Receives progress, and may interrupt.
    pub watch: SolveWatch,
}

impl SolverSetup {
    /// Pixels at which beams are wanted.
    fn beam_pixels(&self, nside: usize) -> Vec<usize> {
        let pixel = |&[longitude_deg, latitude_deg]: &[f64; 2]| {
            pixel_of(nside, direction(longitude_deg, latitude_deg))
        };
        self.beams_deg.iter().map(pixel).collect()
    }

    /// R of a channel.
    #[must_use]
    #[doc(hidden)]
    pub fn regulariser(&self, channel: usize) -> Regulariser {
        self.regularisers.get(channel).or(self.regularisers.last()).cloned().unwrap_or_default()
    }
}

/// Solves every snapshot.
pub struct Solver {
    setup: SolverSetup,
    solved: u64,
    last: LastSolutions,
}

impl Solver {
    /// A solving stage.
    #[must_use]
    pub fn new(setup: SolverSetup) -> Self {
        Self { setup, solved: 0, last: HashMap::new() }
    }

    /// The prior of the map that [`Solver::reduced`] divides by the same factor.
    fn prior(&self, channel: usize, pixels: usize) -> Option<Vec<f64>> {
        let factor = 1.0 + self.setup.moon_reflection;
        if let Some(map) = self.setup.prior_maps.get(channel) {
            return Some(map.iter().map(|value| factor * value).collect());
        }
        let level_k = self.setup.prior_k.get(channel).filter(|&level_k| level_k != 0.0)?;
        Some(vec![factor * level_k; pixels])
    }

    /// The map of visibilities divided by 1 + xi_R: a solution is linear in visibilities and prior together.
    fn reduced(&self, mut map_k: Vec<f64>) -> Vec<f64> {
        let factor = 1.0 + self.setup.moon_reflection;
        map_k.iter_mut().for_each(|value| *value /= factor);
        map_k
    }
}

/// A map with its diagnostics.
struct Solved {
    map_k: Vec<f64>,
    noise_k: Vec<f64>,
    diagnostics: Diagnostics,
    beams: Vec<PointBeam>,
    refinement: Option<Refinement>,
    uncertainty: Option<Uncertainty>,
}

impl Solved {
    fn of_pixels(solved: PixelSolution, uncertainty: Option<Uncertainty>) -> Self {
        let PixelSolution { map_k, noise_k, diagnostics, beams } = solved;
        Self { map_k, noise_k, diagnostics, beams, refinement: None, uncertainty }
    }
}

/// A snapshot of a channel that is to be solved.
struct Request<'a> {
    setup: &'a SolverSetup,
    channel: ChannelId,
    nside: usize,
    is_final: bool,
    epsilon: f64,
    prior: Option<Vec<f64>>,
    /// Pixels at which beams are wanted.
    beam_pixels: Vec<usize>,
    watch: NamedWatch<'a>,
}

/// The last iterative solution of each channel, from which the next starts.
type LastSolutions = HashMap<ChannelId, [Vec<f64>; 2]>;

/// Each method gives nothing for a map on the way that was interrupted, or that its data do not determine yet.
impl Request<'_> {
    /// Numbers that only a final map is worth.
    fn if_final(&self, count: usize) -> usize {
        if self.is_final { count } else { 0 }
    }

    fn samples(&self) -> Samples {
        if self.is_final { self.setup.samples } else { Samples::default() }
    }

    fn is_stopped(&self) -> bool {
        !self.watch.goes_on() && !self.is_final
    }

    fn harmonic_request(&self) -> HarmonicRequest {
        let samples = self.samples();
        let probes = self.if_final(self.setup.trace_probes);
        HarmonicRequest { epsilon: self.epsilon, nside: self.nside, rule: self.setup.rule, samples, probes }
    }

    fn pixels_with_power(&self, sums: &PixelSums) -> Result<Option<Solved>, SolveError> {
        let samples = self.samples();
        let prior = self.prior.as_deref();
        match solve_pixels_with_power(sums, prior, samples, &self.beam_pixels, self.watch) {
            Err(SolveError::Interrupted) => Ok(None),
            Err(SolveError::NoPower) if !self.is_final => Ok(None),
            solved => solved.map(|(solved, errors)| Some(Solved::of_pixels(solved, Some(errors)))),
        }
    }

    fn pixels(&self, sums: PixelSums) -> Result<Option<Solved>, SolveError> {
        let probes = self.if_final(self.setup.trace_probes);
        let extras = PixelExtras { probes, beams: &self.beam_pixels };
        match solve_pixels_with(sums, self.epsilon, self.prior.as_deref(), extras, self.watch) {
            Err(SolveError::Interrupted) => Ok(None),
            // The first data alone, or what a stranger sent, may not determine a map. The next snapshot has more; that the
            // last one fails is an error.
            Err(SolveError::NotPositive { .. }) if !self.is_final => Ok(None),
            solved => solved.map(|solved| Some(Solved::of_pixels(solved, None))),
        }
    }

    fn harmonics(
        &self,
        sums: &HarmonicSums,
        regulariser: Regulariser,
        last: &mut LastSolutions,
    ) -> Result<Option<Solved>, SolveError> {
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
            // One over the power that was found.
            let found = uncertainty.as_ref().map(|errors| errors.power.over_noise_k2());
            let epsilon = if found.is_some() { 1.0 } else { self.epsilon };
            let regulariser = found.map_or(regulariser, Regulariser::Wiener);
            let request = HarmonicRequest { epsilon, ..request };
            beams = harmonic_beams(sums, request, (&regulariser, w_max), &self.beam_pixels, self.watch)?;
        }
        if !self.is_final {
            last.insert(self.channel, unknowns);
        }
        Ok(Some(Solved { map_k, noise_k, diagnostics, beams, refinement: None, uncertainty }))
    }

    fn matrix_free(
        &self,
        sums: &MatrixFreeSums,
        last: &mut LastSolutions,
    ) -> Result<Option<Solved>, SolveError> {
        // The final one begins at nothing: its bits are then those of the data, whatever maps there were on the way.
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
        Ok(Some(Solved::of_pixels(solved, None)))
    }

    /// `data` are numbers by which a solution on disk is known to be of these data.
    fn refined(&self, sums: &RefinedSums, data: &[i64]) -> Result<Option<Solved>, SolveError> {
        let request = HarmonicRequest { probes: 0, ..self.harmonic_request() };
        let of = [data, &[self.epsilon.to_bits().cast_signed()]].concat();
        let file = self.setup.passes.as_ref().map(|folder| PassFile::new(folder, self.channel, &of));
        // Not from a map on the way: that is the circle's, with which the iteration begins anyway.
        let start = file.as_ref().and_then(PassFile::read);
        let mut passed = |x: [&[f64]; 2]| {
            if let Some(file) = &file {
                file.write(x);
            }
        };
        let steps = RefineSteps { start, passed: &mut passed };
        let regulariser = self.setup.regulariser(usize::from(self.channel.0));
        let (rule, prior) = ((self.setup.refine, &regulariser), self.prior.as_deref());
        let (solved, found) = match solve_refined(sums, request, rule, prior, steps, self.watch) {
            Err(SolveError::Interrupted) => return Ok(None),
            solved => solved?,
        };
        // Whoever makes it again wants it from its beginning, unless it was interrupted.
        if let Some(file) = file.filter(|_| self.watch.goes_on()) {
            file.remove();
        }
        let HarmonicSolution { map_k, noise_k, diagnostics, uncertainty, .. } = solved;
        let (beams, refinement) = (Vec::new(), Some(found));
        Ok(Some(Solved { map_k, noise_k, diagnostics, beams, refinement, uncertainty }))
    }
}

impl Stage for Solver {
    type In = Snapshot;
    type Out = Solution;
    type Error = SolveError;

    fn step(&mut self, snapshot: Snapshot, out: &mut Outlet<Solution>) -> Result<(), SolveError> {
        let Snapshot { instrument, channel, number, is_final, span_s, nside, sums } = snapshot;
        let SumCounts { visibilities, weight, .. } = sums.counts();
        let which = [i64::from(channel.0), i64::from(number), i64::from(is_final), visibilities as i64];
        let data = [span_s[0], span_s[1], weight].map(|x| x.to_bits().cast_signed());
        let data = [which.as_slice(), &data].concat();
        if !self.setup.watch.agrees(&data) {
            return Err(SolveError::Ranks);
        }
        let index = usize::from(channel.0);
        let epsilon = self.setup.epsilon.get(index).ok_or(SolveError::NoEpsilon(channel))?;
        let prior = self.prior(index, pixel_count(nside));
        let frequency_hz = instrument.channels.get(index).map_or(0.0, |c| c.frequency_hz);
        let name = format!("{:.3} MHz", frequency_hz / 1e6);
        let (setup, last) = (&self.setup, &mut self.last);
        // Maps on the way are not worth the time that the final ones need.
        let watch = setup.watch.named(&name).wanted(is_final);
        if !watch.goes_on() {
            return Ok(());
        }
        let beam_pixels = if is_final { setup.beam_pixels(nside) } else { Vec::new() };
        let request = Request { setup, channel, nside, is_final, epsilon, prior, beam_pixels, watch };
        let regulariser = setup.regulariser(index);
        let solved = match sums {
            SnapshotSums::Pixel(sums) if regulariser == Regulariser::Data => request.pixels_with_power(&sums),
            SnapshotSums::Pixel(sums) => request.pixels(sums),
            SnapshotSums::Harmonic(sums) => request.harmonics(&sums, regulariser, last),
            SnapshotSums::MatrixFree(visibilities) => request.matrix_free(&visibilities.into_sums()?, last),
            SnapshotSums::Refined(archive) => request.refined(&archive.into_sums(&setup.assumed)?, &data),
        };
        let Some(solved) = solved? else { return Ok(()) };
        let Solved { map_k, noise_k, diagnostics, beams, refinement, uncertainty } = solved;
        self.solved += 1;
        out.push(Solution {
            instrument,
            channel,
            number,
            is_final,
            span_s,
            visibilities,
            nside,
            map_k: self.reduced(map_k),
            noise_k: self.reduced(noise_k),
            beams,
            diagnostics,
            refinement,
            uncertainty: uncertainty.map(|errors| errors.reduced(1.0 + self.setup.moon_reflection)),
        });
        Ok(())
    }

    fn finish(&mut self, _out: &mut Outlet<Solution>) -> Result<(), SolveError> {
        // Others may have one more to solve.
        if self.setup.watch.agrees(&[-1; QUESTIONS]) { Ok(()) } else { Err(SolveError::Ranks) }
    }

    fn units(&self) -> Units {
        Units::of(self.solved, "maps")
    }
}
