//! The ground stage that turns sums into maps.

use std::sync::Arc;

use super::{Diagnostics, SolveError, solve_pixels};
use crate::accumulation::{NormalSums, Snapshot};
use crate::frames::Instrument;
use crate::runtime::{Outlet, Stage, Units};
use crate::units::{ChannelId, PerChannel};

/// A map of one channel and what goes with it.
pub struct Solution {
    /// Instrument.
    pub instrument: Arc<Instrument>,
    /// Channel.
    pub channel: ChannelId,
    /// Number of the snapshot in its channel, from 1.
    pub number: u32,
    /// Whether all data is in it.
    pub is_final: bool,
    /// First and last mission time of the data in it, s.
    pub span_s: [f64; 2],
    /// Visibilities in it.
    pub visibilities: u64,
    /// nside of the maps.
    pub nside: usize,
    /// Map, K, HEALPix RING, ecliptic.
    pub map_k: Vec<f64>,
    /// Map of noise alone, made from noise of the data's weights, K.
    pub noise_k: Vec<f64>,
    /// Regularisation, and how the solution was found.
    pub diagnostics: Diagnostics,
}

/// Regularisation and prior, by channel.
#[derive(Clone, Debug)]
pub struct SolverSetup {
    /// epsilon of R = epsilon W_max I.
    pub epsilon: PerChannel<f64>,
    /// Uniform prior, K.
    pub prior_k: PerChannel<f64>,
    /// Prior maps by channel, K, at the map's nside; empty for none.
    pub prior_maps: Vec<Vec<f64>>,
}

/// Solves every snapshot that comes.
pub struct Solver {
    setup: SolverSetup,
    solved: u64,
}

impl Solver {
    /// A solving stage.
    #[must_use]
    pub fn new(setup: SolverSetup) -> Self {
        Self { setup, solved: 0 }
    }

    fn prior(&self, channel: usize, pixels: usize) -> Option<Vec<f64>> {
        if let Some(map) = self.setup.prior_maps.get(channel) {
            return Some(map.clone());
        }
        let level_k = self.setup.prior_k.get(channel).filter(|&level_k| level_k != 0.0)?;
        Some(vec![level_k; pixels])
    }
}

impl Stage for Solver {
    type In = Snapshot;
    type Out = Solution;
    type Error = SolveError;

    fn step(&mut self, snapshot: Snapshot, out: &mut Outlet<Solution>) -> Result<(), SolveError> {
        let Snapshot { instrument, channel, number, is_final, span_s, sums } = snapshot;
        let index = usize::from(channel.0);
        let epsilon = self.setup.epsilon.get(index).ok_or(SolveError::NoEpsilon(channel))?;
        let prior = self.prior(index, sums.unknowns());
        let visibilities = sums.counts.visibilities;
        let nside = sums.nside;
        let solved = solve_pixels(sums, epsilon, prior.as_deref())?;
        self.solved += 1;
        out.push(Solution {
            instrument,
            channel,
            number,
            is_final,
            span_s,
            visibilities,
            nside,
            map_k: solved.map_k,
            noise_k: solved.noise_k,
            diagnostics: solved.diagnostics,
        });
        Ok(())
    }

    fn units(&self) -> Units {
        Units::of(self.solved, "maps")
    }
}
