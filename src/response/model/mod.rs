//! What the array would measure without noise.

mod band_average;
mod choice;
mod direct;
mod harmonic;

pub use band_average::BandAverage;
pub use choice::{Load, ModelChoice, ModelKind, ModelPlan};
pub use direct::DirectSum;
pub use harmonic::{HarmonicSetup, HarmonicSum};

use num_complex::Complex64;
use thiserror::Error;

use super::harmonic::{GeometryRefusal, HarmonicError};
use super::pixel::Comb;
use crate::array::stretched;
use crate::units::vector::Vec3;

/// Where the two daughters of a pair are.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct PairPosition {
    /// Position of daughter i, m.
    pub r_i_m: Vec3,
    /// Position of daughter j, m.
    pub r_j_m: Vec3,
    /// Orbital phase swept while the visibility is averaged, rad; 0 for an instant.
    pub span_rad: f64,
}

/// Where one daughter is, to be heard by herself.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct DaughterPosition {
    /// Position, m.
    pub r_m: Vec3,
    /// Normal of the orbit, a unit vector; dipoles point along it.
    pub normal_hat: Vec3,
}

/// Why visibilities cannot be predicted.
#[derive(Clone, Debug, Error, PartialEq)]
#[non_exhaustive]
pub enum ModelError {
    /// A pair off the orbit that the model holds for.
    #[error(
        "visibility model at {frequency_hz} Hz: {refusal}; set spacecraft.model = \"direct\" for such an array"
    )]
    Geometry {
        /// Frequency, Hz.
        frequency_hz: f64,
        /// What is not covered.
        refusal: GeometryRefusal,
    },
    /// The harmonic model refused.
    #[error("visibility model at {frequency_hz} Hz: {source}")]
    Harmonic {
        /// Frequency, Hz.
        frequency_hz: f64,
        /// What it said.
        source: HarmonicError,
    },
    /// Two daughters in one direction from the Moon's centre, with dipoles.
    #[error(
        "visibility model at {frequency_hz} Hz: two daughters in one direction from the Moon's centre, or opposite each \
         other, have no orbital plane for their dipoles to stand on"
    )]
    NoPlane {
        /// Frequency, Hz.
        frequency_hz: f64,
    },
    /// Averages over integrations were asked of a model that has instants only.
    #[error(
        "visibility model at {frequency_hz} Hz: direct sums are of instants; set spacecraft.model = \"harmonic\" \
         or spacecraft.smear_integrations = false"
    )]
    Smearing {
        /// Frequency, Hz.
        frequency_hz: f64,
    },
}

/// A sky at one frequency, seen by the array: visibilities of any pair.
///
/// Equal arguments give equal results, whatever the threads and whatever was asked before.
pub trait VisibilityModel: Send + Sync {
    /// How many visibilities it likes to be asked for at once; fewer cost more each.
    fn batch(&self) -> usize {
        1
    }

    /// Predicts one visibility V_ij (K sr) without noise for each position; `out` has the length of `positions`. Fastest
    /// for consecutive integrations of one pair after another.
    ///
    /// # Errors
    /// [`ModelError`], for positions that the model does not cover.
    fn predict(&mut self, positions: &[PairPosition], out: &mut [Complex64]) -> Result<(), ModelError>;

    /// Predicts the power `Int T A S dn` (K sr) that each of the daughters hears by herself; `out` has the length of
    /// `daughters`.
    ///
    /// # Errors
    /// As [`Self::predict`].
    fn predict_powers(&mut self, daughters: &[DaughterPosition], out: &mut [f64]) -> Result<(), ModelError>;

    /// Predicts the visibilities (K sr) of each position at the frequencies of `comb`: `comb.count` for one position
    /// after another.
    ///
    /// A pair stands in for itself at another frequency by being moved apart, unless the model knows better.
    ///
    /// # Errors
    /// As [`Self::predict`].
    fn predict_comb(
        &mut self,
        positions: &[PairPosition],
        comb: Comb,
        out: &mut [Complex64],
    ) -> Result<(), ModelError> {
        let factors = (0..comb.count).map(|k| 1.0 + comb.first + comb.step * k as f64);
        let apart: Vec<PairPosition> =
            positions.iter().flat_map(|pair| factors.clone().map(|factor| pair.stretched(factor))).collect();
        self.predict(&apart, out)
    }
}

impl PairPosition {
    /// The pair moved apart, as [`stretched`] has it.
    #[must_use]
    pub fn stretched(&self, factor: f64) -> Self {
        let (r_i_m, r_j_m) = stretched(self.r_i_m, self.r_j_m, factor);
        Self { r_i_m, r_j_m, span_rad: self.span_rad }
    }
}
