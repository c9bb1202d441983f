//! The ground stage that turns sums into maps.

use std::collections::HashMap;
use std::path::PathBuf;
use std::sync::Arc;

use crate::frames::Instrument;
use crate::imaging::anywhere::PassFile;
use crate::imaging::anywhere::RowBelief;
use crate::imaging::anywhere::{RefineRule, RefineSteps, Refinement, solve_refined};
use crate::imaging::circle::harmonic_beams;
use crate::imaging::circle::{HarmonicRequest, solve_regularised};
use crate::imaging::pixel::solve_remade;
use crate::imaging::pixel::{PixelExtras, PointBeam, solve_pixels_with, solve_pixels_with_power};
use crate::imaging::{Diagnostics, Regulariser, SolveError, SolveWatch, StoppingRule, Uncertainty};
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
    pub belief: RowBelief,
    /// Folder in which the passes of a refinement leave their solution, so that one that was interrupted can go on; `None` for
    /// nowhere.
    pub passes: Option<PathBuf>,
    /// Random probes for the traces of a final map, where its matrix is too large to be held; 0 for no traces.
    pub trace_probes: usize,
    /// Maps as likely as a final map that are drawn beside it, with R from the data.
    pub samples: usize,
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
    /// The last iterative solution of each channel, from which the next starts.
    last: HashMap<ChannelId, [Vec<f64>; 2]>,
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

impl Stage for Solver {
    type In = Snapshot;
    type Out = Solution;
    type Error = SolveError;

    fn step(&mut self, snapshot: Snapshot, out: &mut Outlet<Solution>) -> Result<(), SolveError> {
        let Snapshot { instrument, channel, number, is_final, span_s, nside, sums } = snapshot;
        let SumCounts { visibilities, weight, .. } = sums.counts();
        let data = [span_s[0], span_s[1], weight].map(|x| x.to_bits().cast_signed());
        let which = [i64::from(channel.0), i64::from(number), i64::from(is_final), visibilities as i64];
        if !self.setup.watch.agrees(&[which.as_slice(), &data].concat()) {
            return Err(SolveError::Ranks);
        }
        let index = usize::from(channel.0);
        let epsilon = self.setup.epsilon.get(index).ok_or(SolveError::NoEpsilon(channel))?;
        let prior = self.prior(index, pixel_count(nside));
        let probes = if is_final { self.setup.trace_probes } else { 0 };
        let frequency_hz = instrument.channels.get(index).map_or(0.0, |c| c.frequency_hz);
        let name = format!("{:.3} MHz", frequency_hz / 1e6);
        // Maps on the way are not worth the time that the final ones need.
        let watch = self.setup.watch.named(&name).wanted(is_final);
        if !watch.goes_on() {
            return Ok(());
        }
        let (mut refinement, mut beams, mut uncertainty) = (None, Vec::new(), None);
        let samples = if is_final { self.setup.samples } else { 0 };
        let regulariser = self.setup.regulariser(index);
        let pixels: Vec<usize> = if is_final { self.setup.beam_pixels(nside) } else { Vec::new() };
        let (map_k, noise_k, diagnostics) = match sums {
            SnapshotSums::Pixel(sums) if regulariser == Regulariser::Data => {
                let solved = match solve_pixels_with_power(&sums, prior.as_deref(), samples, &pixels, watch) {
                    Err(SolveError::Interrupted) => return Ok(()),
                    Err(SolveError::NoPower) if !is_final => return Ok(()),
                    solved => solved?,
                };
                let (solved, errors) = solved;
                (beams, uncertainty) = (solved.beams, Some(errors));
                (solved.map_k, solved.noise_k, solved.diagnostics)
            }
            SnapshotSums::Pixel(sums) => {
                let extras = PixelExtras { probes, beams: &pixels };
                let solved = match solve_pixels_with(sums, epsilon, prior.as_deref(), extras, watch) {
                    Err(SolveError::Interrupted) => return Ok(()),
                    // The first data alone, or what a stranger sent, may not determine a map. The next snapshot has more; that the
                    // last one fails is an error.
                    Err(SolveError::NotPositive { .. }) if !is_final => return Ok(()),
                    solved => solved?,
                };
                beams = solved.beams;
                (solved.map_k, solved.noise_k, solved.diagnostics)
            }
            SnapshotSums::Harmonic(sums) => {
                let request = HarmonicRequest { epsilon, nside, rule: self.setup.rule, samples, probes };
                let start = self.last.remove(&channel);
                let (prior, start) = (prior.as_deref(), start.as_ref());
                let solved = solve_regularised(&sums, request, &regulariser, prior, start, watch);
                if let Some(reason) = sums.failure() {
                    return Err(SolveError::Sums(reason.to_owned()));
                }
                let solved = match solved {
                    Err(SolveError::NoPower) if !is_final => return Ok(()),
                    solved => solved?,
                };
                if !watch.goes_on() && !is_final {
                    return Ok(());
                }
                if !pixels.is_empty() {
                    let w_max = solved.diagnostics.w_max.unwrap_or(0.0) / pixel_area_sr(nside);
                    // One over the power that was found.
                    let found = solved.uncertainty.as_ref().map(|errors| errors.power.over_noise_k2());
                    let epsilon = if found.is_some() { 1.0 } else { epsilon };
                    let regulariser = found.map_or(regulariser, Regulariser::Wiener);
                    let request = HarmonicRequest { epsilon, ..request };
                    beams = harmonic_beams(&sums, request, (&regulariser, w_max), &pixels, watch)?;
                }
                uncertainty = solved.uncertainty;
                if !is_final {
                    self.last.insert(channel, solved.unknowns);
                }
                (solved.map_k, solved.noise_k, solved.diagnostics)
            }
            SnapshotSums::Remade(visibilities) => {
                let sums = visibilities.into_sums()?;
                // The final one begins at nothing: its bits are then those of the data, whatever maps there were on the way.
                let start = self.last.remove(&channel).filter(|_| !is_final);
                let rule = self.setup.rule;
                let (solved, unknowns) =
                    match solve_remade(&sums, epsilon, prior.as_deref(), start, rule, watch) {
                        Err(SolveError::Interrupted) => return Ok(()),
                        solved => solved?,
                    };
                if !watch.goes_on() && !is_final {
                    return Ok(());
                }
                if !is_final {
                    self.last.insert(channel, unknowns);
                }
                (solved.map_k, solved.noise_k, solved.diagnostics)
            }
            SnapshotSums::Refined(archive) => {
                let request =
                    HarmonicRequest { epsilon, nside, rule: self.setup.rule, samples: 0, probes: 0 };
                let sums = archive.into_sums(&self.setup.belief)?;
                let rule = (self.setup.refine, &regulariser);
                let of = [which.as_slice(), &data, &[epsilon.to_bits().cast_signed()]].concat();
                let file = self.setup.passes.as_ref().map(|folder| PassFile::new(folder, channel, &of));
                // Not from a map on the way: that is the circle's, with which the iteration begins anyway.
                let start = file.as_ref().and_then(PassFile::read);
                let mut passed = |x: [&[f64]; 2]| {
                    if let Some(file) = &file {
                        file.write(x);
                    }
                };
                let steps = RefineSteps { start, passed: &mut passed };
                let (solved, found) =
                    match solve_refined(&sums, request, rule, prior.as_deref(), steps, watch) {
                        Err(SolveError::Interrupted) => return Ok(()),
                        solved => solved?,
                    };
                // Whoever makes it again wants it from its beginning, unless it was interrupted.
                if let Some(file) = file.filter(|_| watch.goes_on()) {
                    file.remove();
                }
                refinement = Some(found);
                (solved.map_k, solved.noise_k, solved.diagnostics)
            }
        };
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
