//! Noise-free visibilities and auto-correlation powers of a given sky.
//!
//! [`VisibilityModel`] is the interface, for one sky at one frequency; [`ModelPlan`] chooses an implementation by cost.
//!
//! | model | predicts |
//! |---|---|
//! | [`DirectSum`] | sums over the sky's pixels |
//! | [`AntennaSum`] | direct sums with an antenna of its own for each daughter |
//! | [`HarmonicSum`] | sums over spherical harmonics, for satellites on one circle |
//! | [`GeneralSum`] | sums over spherical harmonics, for satellites at any positions |
//! | [`WithFlatReflection`], [`WithSphereReflection`] | another model plus the sky reflected by a flat or a spherical Moon |
//! | [`WithEmission`] | another model plus the Moon's thermal emission |
//! | [`WithinBaselines`] | another model, and nothing on longer baselines |
//! | [`BandAverage`], [`TimeAverage`] | means of another model over a channel or an integration |

mod antennas;
mod band_average;
mod choice;
mod direct;
mod emission;
mod flat_reflection;
mod general;
mod harmonic;
mod sphere_reflection;
mod time_average;
mod within;

pub use antennas::{AntennaPatterns, AntennaSum};
pub use band_average::BandAverage;
pub use choice::{ModelChoice, ModelKind, ModelPlan, Workload, l_max_of_fringes};
pub use direct::{DirectMoments, DirectSum};
pub use emission::WithEmission;
pub use flat_reflection::WithFlatReflection;
pub use general::GeneralSum;
pub use harmonic::{HarmonicSum, HarmonicSumSetup};
pub use sphere_reflection::WithSphereReflection;
pub use time_average::TimeAverage;
pub use within::WithinBaselines;

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
    /// Pair and mission time, s, if known; a model may then interpolate between consecutive positions of a pair.
    pub pair_time: Option<(Pair, f64)>,
}

/// Position of one daughter, for its auto-correlation power.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct DaughterPosition {
    /// Position, m.
    pub r_m: Vec3,
    /// Normal of the orbit, a unit vector; dipoles point along it.
    pub normal_hat: Vec3,
    /// Daughter (counted from 0) and mission time, s; needed where antennas differ.
    pub daughter_time: Option<(u8, f64)>,
}

/// Why a prediction failed.
#[derive(Clone, Debug, Error, PartialEq)]
#[non_exhaustive]
pub enum ModelError {
    /// The model does not cover the positions of a pair.
    #[error(
        "visibility model at {}: {refusal}; set spacecraft.model = \"direct\" for such an array",
        Dimension::Frequency.show(*frequency_hz)
    )]
    Geometry {
        /// Frequency, Hz.
        frequency_hz: f64,
        /// Reason of the refusal.
        refusal: RowsRefusal,
    },
    /// The harmonic model failed.
    #[error("visibility model at {}: {source}", Dimension::Frequency.show(*frequency_hz))]
    Harmonic {
        /// Frequency, Hz.
        frequency_hz: f64,
        /// Error of the harmonic model.
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
    /// A model of instantaneous visibilities was given an integration.
    #[error(
        "visibility model at {}: this model is instantaneous, but a position spans an integration; average it over time",
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
    /// Preferred number of visibilities per call; smaller calls cost more per visibility.
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

    /// Whether antennas differ, so that daughters at the same position have different powers.
    fn has_individual_antennas(&self) -> bool {
        false
    }

    /// Predicts the visibilities (K sr) of each position at the frequencies of `comb`: `comb.count` values per position.
    ///
    /// The default implementation scales the baseline in place of the frequency.
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
        let scaled: Vec<PairPosition> =
            positions.iter().flat_map(|pair| factors.clone().map(|factor| pair.scaled(factor))).collect();
        self.predict(&scaled, out)
    }
}

/// Writes weighted means of a model's predictions: `terms` gives the index in `out` and the weight of each position.
fn predict_means(
    model: &mut dyn VisibilityModel,
    positions: &[PairPosition],
    terms: &[(usize, f64)],
    out: &mut [Complex64],
) -> Result<(), ModelError> {
    let mut values = vec![Complex64::ZERO; positions.len()];
    model.predict(positions, &mut values)?;
    out.fill(Complex64::ZERO);
    for ((index, weight), value) in terms.iter().zip(values) {
        out[*index] += weight * value;
    }
    Ok(())
}

impl PairPosition {
    /// Scales the baseline of the pair by `factor`, see [`scaled_baseline`].
    #[must_use]
    pub fn scaled(&self, factor: f64) -> Self {
        let (r_i_m, r_j_m) = scaled_baseline(self.r_i_m, self.r_j_m, factor);
        Self { r_i_m, r_j_m, ..*self }
    }
}
