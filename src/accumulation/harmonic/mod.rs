//! The harmonic engine: sums on tori, from which BtN^-1B acts on harmonic coefficients.
//!
//! On a common circular orbit every row of B is one rotation of a pattern that depends on the baseline's length
//! alone (see [`mod@crate::response::harmonic`]). A row at baseline u is interpolated from nodes u_k by a compact
//! kernel, `B = sum_k kappa(u_k - u) B_k`, so
//!
//! ```text
//! BtN^-1B = sum_{k k'} B_k^t [ sum_t w_t kappa_k kappa_k' at (alpha_t, gamma_t) ] B_k'
//! ```
//!
//! and the bracket, a weight for every pair of neighbouring nodes on a torus in alpha and gamma, is all that has to be
//! summed. On the torus it multiplies pointwise. Its grid is fine enough for the products of two
//! functions of degree `l_max`, so the weights are spread by kernels whose spectra are flat over their band.
//!
//! The sums are additive: they can be merged and subtracted, and their size does not grow with the data. They are
//! exact: with M the power of four not below `weight_max`, weights are rounded to `2^-30 M` and data to
//! `2^-19 sqrt(M)`, those above 2^21 of these to 21 bits; see the module `exact`.

mod blocks;
mod checkpoint;
mod coverage;
mod exact;
mod grid;
mod operator;
mod setup;
mod spread;
mod sums;
#[cfg(test)]
mod tests;
mod tori;

use std::sync::{Arc, OnceLock};

use rayon::prelude::*;

pub use blocks::{OrderBlocks, OrderFactors};
pub use coverage::{GeometryCoverage, GeometrySurvey};
pub use grid::SPREAD_MULTIPLY_ADDS;
pub use setup::{ApplicationSize, HarmonicMemory, HarmonicSetup, L_MAX, application_size, memory, orbit_of};
pub use sums::{HarmonicSums, coefficients, unknowns};

use super::harmonic::exact::{ExactTori, Quanta};
use super::harmonic::grid::Grids;
use super::harmonic::operator::Operator;
use super::harmonic::spread::Pending;
use super::noise::companion_noise;
use super::scale::{Scale, Totals};
use super::{AccumulationError, Added, Direction, NormalEngine, Refusal, SumCounts};
use crate::frames::PlacedVisibilities;
use crate::response::harmonic::PairOrientation;

/// Visibilities that are spread together: enough to keep all cores busy over the nodes, little memory.
const BATCH: usize = 16_384;

/// Sums weights and data on tori; each visibility costs some thousand multiply-adds, whatever the map's size.
#[derive(Debug)]
pub struct HarmonicEngine {
    setup: HarmonicSetup,
    scale: Scale,
    grids: Arc<Grids>,
    tables: Arc<OnceLock<Operator>>,
    tori: ExactTori,
    /// All that were put in, also those that wait.
    totals: Totals,
    pending: Vec<Pending>,
    /// What is to become of those that wait.
    direction: Direction,
}

impl HarmonicEngine {
    /// An empty engine. Memory is taken as baselines of more lengths arrive.
    ///
    /// # Errors
    /// [`AccumulationError::Setup`].
    pub fn new(setup: HarmonicSetup) -> Result<Self, AccumulationError> {
        setup.check()?;
        let grids = Arc::new(setup.grids());
        Ok(Self {
            scale: Scale::new(setup.weight_max)?,
            tables: Arc::new(OnceLock::new()),
            tori: ExactTori::zeros(&grids),
            grids,
            totals: Totals::default(),
            pending: Vec::with_capacity(BATCH),
            direction: Direction::In,
            setup,
        })
    }

    /// Setup.
    #[must_use]
    pub fn setup(&self) -> &HarmonicSetup {
        &self.setup
    }

    /// Where a visibility goes, or why it cannot.
    fn place(&self, placed: &PlacedVisibilities, k: usize) -> Result<Pending, Refusal> {
        let setup = &self.setup;
        let orientation = PairOrientation::of(placed.r_i_m[k], placed.r_j_m[k])?;
        let pair = setup.orbit.pair(&orientation, setup.wavelength_m())?;
        if orientation.baseline_m > setup.baseline_m_max {
            return Err(Refusal::TooLong);
        }
        let (weight, mut value) = (placed.weight[k], placed.value_k_sr[k]);
        self.scale.check(value, weight, setup.weight_max)?;
        if pair.reversed {
            value = value.conj();
        }
        let noise = companion_noise(setup.companion_seed, placed, k) * weight.sqrt();
        Ok(Pending {
            alpha_rad: pair.state.node_rad - std::f64::consts::FRAC_PI_2,
            gamma_rad: pair.state.phase_rad + std::f64::consts::FRAC_PI_2,
            u: pair.state.baseline_wavelengths,
            weight,
            sides: [weight * value.re, weight * value.im, noise.re, noise.im],
        })
    }

    fn quanta(&self) -> Quanta {
        Quanta::new(self.scale)
    }

    /// Puts visibilities in or takes them out.
    fn take(
        &mut self,
        placed: &PlacedVisibilities,
        direction: Direction,
    ) -> Result<Added, AccumulationError> {
        let (expected_hz, found_hz) = (self.setup.frequency_hz, placed.frequency_hz);
        if found_hz != expected_hz {
            return Err(AccumulationError::Frequency { expected_hz, found_hz });
        }
        let found: Vec<_> = (0..placed.len()).into_par_iter().map(|k| self.place(placed, k)).collect();
        let one = |pending: &Pending| Totals::one(self.scale, pending.weight);
        let totals = found
            .iter()
            .flatten()
            .try_fold(self.totals, |totals, pending| totals.and(one(pending), direction));
        self.totals = totals.ok_or(AccumulationError::NothingHeld(placed.channel))?;
        if self.direction != direction {
            self.settle();
            self.direction = direction;
        }
        let mut added = Added::default();
        for found in found {
            match found {
                Ok(pending) => {
                    added.visibilities += 1;
                    self.pending.push(pending.times(direction.sign()));
                }
                Err(reason) => added.refuse(reason),
            }
            if self.pending.len() >= BATCH {
                self.settle();
            }
        }
        Ok(added)
    }

    fn combine(&mut self, mut other: Self, direction: Direction) -> Result<(), AccumulationError> {
        if self.setup != other.setup {
            return Err(AccumulationError::Mismatch {
                what: "degrees, frequencies, baselines, orbits, seeds or greatest weights",
            });
        }
        self.totals = self.totals.and(other.totals, direction).ok_or(AccumulationError::Range)?;
        self.settle();
        other.settle();
        self.tori.combine(&self.grids, &other.tori, direction);
        Ok(())
    }

    fn with(&self, tori: tori::Tori) -> HarmonicSums {
        HarmonicSums {
            setup: self.setup,
            grids: Arc::clone(&self.grids),
            tables: Arc::clone(&self.tables),
            tori,
            counts: self.totals.counts(self.scale),
            right: OnceLock::new(),
            noise: OnceLock::new(),
        }
    }
}

impl NormalEngine for HarmonicEngine {
    type Sums = HarmonicSums;

    fn add(&mut self, placed: &PlacedVisibilities) -> Result<Added, AccumulationError> {
        self.take(placed, Direction::In)
    }

    fn remove(&mut self, placed: &PlacedVisibilities) -> Result<Added, AccumulationError> {
        self.take(placed, Direction::Out)
    }

    fn settle(&mut self) {
        if !self.pending.is_empty() {
            let quanta = self.quanta();
            self.tori.add((&self.grids, quanta), &self.pending, self.direction);
            self.pending.clear();
        }
    }

    fn merge(&mut self, other: Self) -> Result<(), AccumulationError> {
        self.combine(other, Direction::In)
    }

    fn subtract(&mut self, other: Self) -> Result<(), AccumulationError> {
        self.combine(other, Direction::Out)
    }

    fn counts(&self) -> SumCounts {
        self.totals.counts(self.scale)
    }

    fn sums(&mut self) -> HarmonicSums {
        self.settle();
        self.with(self.tori.values(&self.grids, self.quanta()))
    }

    fn into_sums(mut self) -> HarmonicSums {
        self.settle();
        let tori = std::mem::take(&mut self.tori);
        self.with(tori.into_values(&self.grids, self.quanta()))
    }

    fn checkpoint(&mut self, out: &mut dyn std::io::Write) -> Result<(), AccumulationError> {
        self.settle();
        checkpoint::write(self, out)
    }

    fn restore(from: &mut dyn std::io::Read) -> Result<Self, AccumulationError> {
        checkpoint::read(from)
    }
}
