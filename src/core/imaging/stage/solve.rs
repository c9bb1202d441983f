//! The ground stage that solves sums for maps.

use std::collections::HashMap;
use std::sync::Arc;

use super::snapshot::Snapshot;
use crate::frames::Instrument;
use crate::imaging::SolveError;
use crate::imaging::anywhere::Refinement;
use crate::imaging::circle::MoverFluxes;
use crate::imaging::request::{LastSolution, MapRequest, SolvedMap, SolverSetup};
use crate::imaging::solver::{Diagnostics, PointBeam};
use crate::imaging::{SumCounts, Uncertainty};
use crate::runtime::{Outlet, Stage, Units};
use crate::sky::healpix::pixel_count;
use crate::units::ChannelId;

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
    /// Whether cancellation ended its iterations early: the noise map is none, and there are no errors.
    pub is_interrupted: bool,
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
    /// Fluxes of the bodies that move, which the map is without; only of a final map with `map.movers`.
    pub movers: Option<MoverFluxes>,
}

impl Solution {
    /// Whether it is from all data and has converged.
    #[must_use]
    pub fn is_final_map(&self) -> bool {
        self.is_final && self.has_converged()
    }

    /// Whether it was not interrupted, and its refinement, if any, has converged.
    #[must_use]
    pub fn has_converged(&self) -> bool {
        !self.is_interrupted
            && self.refinement.as_ref().is_none_or(|refinement| refinement.convergence.converged)
    }

    /// What is to be said with a map that was interrupted.
    pub(crate) fn interruption(&self) -> Option<String> {
        let refined = self.refinement.as_ref().map(|refinement| refinement.convergence);
        let iterations = refined.or(self.diagnostics.convergence).map_or(0, |found| found.iterations);
        self.is_interrupted.then(|| format!("not converged: interrupted after {iterations} iterations"))
    }
}

/// Number of values that ranks compare before they solve.
const AGREED_VALUES: usize = 7;

/// A stage that solves every snapshot.
pub struct Solver {
    setup: SolverSetup,
    solved: u64,
    last_solutions: HashMap<ChannelId, LastSolution>,
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
        let setup = &self.setup;
        // An intermediate map must not take time from a final one.
        let watch = setup.watch.named(&name).of_final_map(is_final);
        if !watch.may_continue() {
            return Ok(());
        }
        setup.watch.begin();
        let solved = data.solve(MapRequest {
            setup,
            instrument: &instrument,
            channel,
            nside,
            is_final,
            epsilon,
            regulariser: setup.regulariser(index),
            prior,
            fingerprint: &fingerprint,
            last: self.last_solutions.entry(channel).or_default(),
            watch,
        });
        let Some(solved) = solved? else { return Ok(()) };
        let is_interrupted = self.setup.watch.was_cut();
        if is_interrupted && !is_final {
            return Ok(());
        }
        let SolvedMap { map_k, noise_k, diagnostics, mut beams, refinement, mut uncertainty, movers } =
            solved;
        if is_interrupted {
            // They are of equations that were not solved.
            beams.clear();
        }
        if is_interrupted || self.setup.watch.was_cut_beside() {
            uncertainty = None;
        }
        self.solved += 1;
        out.push(Solution {
            instrument,
            channel,
            number,
            is_final,
            is_interrupted,
            span_s,
            visibilities,
            nside,
            map_k: self.without_reflection(map_k),
            noise_k: self.without_reflection(noise_k),
            beams,
            diagnostics,
            refinement,
            uncertainty: uncertainty.map(|errors| errors.divided_by(1.0 + self.setup.moon_reflection)),
            movers: movers
                .filter(|_| !is_interrupted)
                .map(|fluxes| fluxes.divided_by(1.0 + self.setup.moon_reflection)),
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
