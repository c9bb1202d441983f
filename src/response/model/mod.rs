//! Noise-free visibilities and auto-correlation powers of a given sky.
//!
//! [`VisibilityModel`] is the interface, for one sky at one frequency. [`DirectSum`] sums over the sky's pixels,
//! [`HarmonicSum`] uses spherical harmonics on a common circle, [`GeneralSum`] anywhere; [`WithReflection`] adds the image of the sky in
//! a flat Moon, [`WithSphereReflection`] in a round one, [`AntennaSum`] antennas that differ, [`WithEmission`] the Moon's own emission, [`BandAverage`] averages over a channel,
//! [`TimeAverage`] over integrations, and [`ModelPlan`] chooses by cost. Equal arguments give equal results, whatever the threads.

mod antennas;
mod band_average;
mod choice;
mod direct;
mod emission;
mod general;
mod harmonic;
mod mirror;
mod reflection;
mod time_average;

pub use antennas::{AntennaPatterns, AntennaSum};
pub use band_average::BandAverage;
pub use choice::{Load, ModelChoice, ModelKind, ModelPlan, degrees_seen};
pub use direct::{DirectMoments, DirectSum};
pub use emission::WithEmission;
pub use general::GeneralSum;
pub use harmonic::{HarmonicSum, HarmonicSumSetup};
pub use mirror::WithSphereReflection;
pub use reflection::WithReflection;
pub use time_average::TimeAverage;

use num_complex::Complex64;
use thiserror::Error;

use super::general::RowsRefusal;
use super::harmonic::HarmonicError;
use super::pixel::Comb;
use crate::array::scaled_baseline;
use crate::units::vector::Vec3;
use crate::units::{Dimension, Pair};

/// Positions of the two daughters of a pair.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct PairPosition {
    /// Position of daughter i, m.
    pub r_i_m: Vec3,
    /// Position of daughter j, m.
    pub r_j_m: Vec3,
    /// Orbital phase swept during the integration, rad; 0 for an instant.
    pub span_rad: f64,
    /// Pair and mission time, s, of positions along an orbit; consecutive ones of a pair may be interpolated from each other.
    pub at: Option<(Pair, f64)>,
}

/// Position of one daughter, for its auto-correlation power.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct DaughterPosition {
    /// Position, m.
    pub r_m: Vec3,
    /// Normal of the orbit, a unit vector; dipoles point along it.
    pub normal_hat: Vec3,
    /// Daughter, from 0, and mission time, s, where antennas differ.
    pub at: Option<(u8, f64)>,
}

/// Why a prediction failed.
#[derive(Clone, Debug, Error, PartialEq)]
#[non_exhaustive]
pub enum ModelError {
    /// A pair departs too far from the orbit of the model.
    #[error(
        "visibility model at {}: {refusal}; set spacecraft.model = \"direct\" for such an array",
        Dimension::Frequency.show(*frequency_hz)
    )]
    Geometry {
        /// Frequency, Hz.
        frequency_hz: f64,
        /// The quantity that departs.
        refusal: RowsRefusal,
    },
    /// The harmonic model failed.
    #[error("visibility model at {}: {source}", Dimension::Frequency.show(*frequency_hz))]
    Harmonic {
        /// Frequency, Hz.
        frequency_hz: f64,
        /// Its error.
        source: HarmonicError,
    },
    /// Two daughters with dipoles in the same or in opposite directions from the Moon's centre.
    #[error(
        "visibility model at {}: two daughters in the same or in opposite directions from the Moon's \
         centre do not define the orbital plane that their dipoles are normal to",
        Dimension::Frequency.show(*frequency_hz)
    )]
    NoPlane {
        /// Frequency, Hz.
        frequency_hz: f64,
    },
    /// A model of instants was asked for an average over integrations.
    #[error(
        "visibility model at {}: an average over an integration of a model of instants",
        Dimension::Frequency.show(*frequency_hz)
    )]
    Smearing {
        /// Frequency, Hz.
        frequency_hz: f64,
    },
}

/// Predicts the visibilities of one sky at one frequency.
///
/// Equal arguments give equal results, whatever the threads and earlier calls.
pub trait VisibilityModel: Send + Sync {
    /// Preferred number of visibilities a call; smaller calls cost more a visibility.
    fn batch(&self) -> usize {
        1
    }

    /// Predicts one noise-free visibility V_ij (K sr) for each position; `out` has the length of `positions`. Fastest
    /// for consecutive integrations of one pair after another.
    ///
    /// # Errors
    /// [`ModelError`] for positions that the model does not cover.
    fn predict(&mut self, positions: &[PairPosition], out: &mut [Complex64]) -> Result<(), ModelError>;

    /// Predicts the auto-correlation power `Int T A S dn` (K sr) of each daughter; `out` has the length of `daughters`.
    ///
    /// # Errors
    /// As [`Self::predict`].
    fn predict_powers(&mut self, daughters: &[DaughterPosition], out: &mut [f64]) -> Result<(), ModelError>;

    /// Whether daughters at one place have different powers.
    fn has_own_antennas(&self) -> bool {
        false
    }

    /// Predicts the visibilities (K sr) of each position at the frequencies of `comb`: `comb.count` values a position.
    ///
    /// By default a scaled baseline stands for another frequency.
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
            positions.iter().flat_map(|pair| factors.clone().map(|factor| pair.scaled(factor))).collect();
        self.predict(&apart, out)
    }
}

/// Means of a model's predictions: each of `positions` is a part of the mean at a place of `out`, with a weight.
fn predict_means(
    model: &mut dyn VisibilityModel,
    positions: &[PairPosition],
    parts: &[(usize, f64)],
    out: &mut [Complex64],
) -> Result<(), ModelError> {
    let mut values = vec![Complex64::ZERO; positions.len()];
    model.predict(positions, &mut values)?;
    out.fill(Complex64::ZERO);
    for ((place, weight), value) in parts.iter().zip(values) {
        out[*place] += weight * value;
    }
    Ok(())
}

impl PairPosition {
    /// The pair with its baseline scaled by `factor`, see [`scaled_baseline`].
    #[must_use]
    pub fn scaled(&self, factor: f64) -> Self {
        let (r_i_m, r_j_m) = scaled_baseline(self.r_i_m, self.r_j_m, factor);
        Self { r_i_m, r_j_m, ..*self }
    }
}
