//! The harmonic engine: sums on tori, from which BtN^-1B acts on harmonic coefficients.
//!
//! On a common circular orbit every row of B is one rotation of a pattern that depends on the baseline's length
//! alone (see [`mod@crate::array::harmonic`]). A row at baseline u is interpolated from nodes u_k by a compact
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
//! The sums are additive: they can be merged and subtracted, and their size does not grow with the data.

mod blocks;
mod checkpoint;
mod coverage;
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

use self::spread::Pending;
use self::tori::Tori;
use super::noise::companion_noise;
use super::{AccumulationError, Added, NormalEngine, Refusal, SumCounts};
use crate::array::harmonic::PairOrientation;
use crate::frames::PlacedVisibilities;

/// Visibilities that are spread together: enough to keep all cores busy over the nodes, little memory.
const BATCH: usize = 16_384;

/// Whether visibilities are put in or taken out.
#[derive(Clone, Copy)]
enum Direction {
    In,
    Out,
}

/// Sums weights and data on tori; each visibility costs some thousand multiply-adds, whatever the map's size.
#[derive(Debug)]
pub struct HarmonicEngine {
    sums: HarmonicSums,
    pending: Vec<Pending>,
}

impl HarmonicEngine {
    /// An empty engine. Memory is taken as baselines of more lengths arrive.
    ///
    /// # Errors
    /// [`AccumulationError::Setup`].
    pub fn new(setup: HarmonicSetup) -> Result<Self, AccumulationError> {
        setup.check()?;
        let grids = Arc::new(setup.grids());
        Ok(Self::with(HarmonicSums {
            setup,
            tables: Arc::new(OnceLock::new()),
            tori: Tori::zeros(&grids),
            grids,
            counts: SumCounts::default(),
            right: OnceLock::new(),
            noise: OnceLock::new(),
        }))
    }

    fn with(sums: HarmonicSums) -> Self {
        Self { sums, pending: Vec::with_capacity(BATCH) }
    }

    /// Setup.
    #[must_use]
    pub fn setup(&self) -> &HarmonicSetup {
        &self.sums.setup
    }

    /// Where a visibility goes, or why it cannot.
    fn place(&self, placed: &PlacedVisibilities, k: usize) -> Result<Pending, Refusal> {
        let setup = &self.sums.setup;
        let orientation = PairOrientation::of(placed.r_i_m[k], placed.r_j_m[k])?;
        let pair = setup.orbit.pair(&orientation, setup.wavelength_m())?;
        if orientation.baseline_m > setup.baseline_m_max {
            return Err(Refusal::TooLong);
        }
        let (weight, mut value) = (placed.weight[k], placed.value_k_sr[k]);
        if !(value.re.is_finite() && value.im.is_finite() && weight > 0.0 && weight.is_finite()) {
            return Err(Refusal::NotFinite);
        }
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

    /// Takes out what another engine of the same setup holds: the inverse of [`NormalEngine::merge`], to rounding.
    ///
    /// # Errors
    /// [`AccumulationError::Mismatch`] if the setups differ.
    pub fn subtract(&mut self, other: Self) -> Result<(), AccumulationError> {
        self.combine(other, -1.0)
    }

    fn combine(&mut self, mut other: Self, sign: f64) -> Result<(), AccumulationError> {
        if self.sums.setup != other.sums.setup {
            return Err(AccumulationError::Mismatch {
                what: "degrees, frequencies, baselines, orbits or seeds",
            });
        }
        self.settle();
        other.settle();
        self.sums.tori.merge(&self.sums.grids, &other.sums.tori, sign as f32);
        let (counts, others) = (&mut self.sums.counts, other.sums.counts);
        counts.weight += sign * others.weight;
        counts.visibilities = if sign < 0.0 {
            counts.visibilities.saturating_sub(others.visibilities)
        } else {
            counts.visibilities + others.visibilities
        };
        Ok(())
    }

    fn take(
        &mut self,
        placed: &PlacedVisibilities,
        direction: Direction,
    ) -> Result<Added, AccumulationError> {
        let setup = &self.sums.setup;
        if placed.frequency_hz != setup.frequency_hz {
            let (expected_hz, found_hz) = (setup.frequency_hz, placed.frequency_hz);
            return Err(AccumulationError::Frequency { expected_hz, found_hz });
        }
        let mut added = Added::default();
        let found: Vec<_> = (0..placed.len()).into_par_iter().map(|k| self.place(placed, k)).collect();
        for found in found {
            match found {
                Ok(mut pending) => {
                    let counts = &mut self.sums.counts;
                    added.visibilities += 1;
                    match direction {
                        Direction::In => counts.visibilities += 1,
                        Direction::Out => {
                            counts.visibilities = counts.visibilities.saturating_sub(1);
                            pending.weight = -pending.weight;
                            pending.sides = pending.sides.map(|side| -side);
                        }
                    }
                    self.sums.counts.weight += pending.weight;
                    self.pending.push(pending);
                }
                Err(reason) => added.refuse(reason),
            }
            if self.pending.len() >= BATCH {
                self.settle();
            }
        }
        Ok(added)
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
            self.sums.tori.add(&self.sums.grids, &self.pending);
            self.pending.clear();
        }
    }

    fn merge(&mut self, other: Self) -> Result<(), AccumulationError> {
        self.combine(other, 1.0)
    }

    fn counts(&self) -> SumCounts {
        self.sums.counts
    }

    fn sums(&self) -> HarmonicSums {
        let mut sums = self.sums.clone();
        sums.tori.add(&sums.grids, &self.pending);
        sums.tori.fold(&sums.grids);
        sums
    }

    fn into_sums(mut self) -> HarmonicSums {
        self.settle();
        self.sums.tori.fold(&self.sums.grids);
        self.sums
    }

    fn checkpoint(&self, out: &mut dyn std::io::Write) -> Result<(), AccumulationError> {
        checkpoint::write(self, out)
    }

    fn restore(from: &mut dyn std::io::Read) -> Result<Self, AccumulationError> {
        checkpoint::read(from)
    }
}
