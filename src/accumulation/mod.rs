//! Normal equations, summed as data arrives.
//!
//! An engine turns placed visibilities into `BtN^-1B` and `BtN^-1V` in whatever form serves it; the
//! solver asks for no more than their action on a vector. [`PixelEngine`] holds the matrix itself;
//! [`harmonic::HarmonicEngine`] holds what makes the matrix act on spherical harmonics.
//! Uses [`crate::frames`], [`mod@crate::array`], [`crate::sky`].

mod checked;
mod checkpoint;
mod config;
mod error;
pub mod harmonic;
mod noise;
mod pixel;
mod stage;
mod tiles;

pub use config::{EngineKind, MapConfig, MapConfigError};
pub use error::AccumulationError;
pub use pixel::{PixelEngine, PixelSetup, PixelSums};
pub use stage::{Accumulator, AccumulatorState, Snapshot, Sums};
pub use tiles::{Columns, SymmetricTiles, TILE};

use std::collections::BTreeMap;

use serde::Serialize;
use thiserror::Error;

use crate::array::harmonic::GeometryRefusal;
use crate::frames::PlacedVisibilities;

/// What an engine or its sums hold.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, bincode::Encode, bincode::Decode)]
pub struct SumCounts {
    /// Visibilities in the sums.
    pub visibilities: u64,
    /// Sum of their weights, (K sr)^-2.
    pub weight: f64,
}

/// Why an engine does not take a visibility.
#[derive(Clone, Copy, Debug, Error, PartialEq, Eq, Hash, PartialOrd, Ord)]
#[non_exhaustive]
pub enum Refusal {
    /// Its satellites are not where the engine's basis needs them.
    #[error(transparent)]
    Geometry(#[from] GeometryRefusal),
    /// Its baseline is longer than the engine was made for.
    #[error("baseline beyond the engine's limit")]
    TooLong,
    /// Its value or weight is no number that can be summed.
    #[error("value or weight not finite, or weight not positive")]
    NotFinite,
}

impl Refusal {
    /// The reason as the ledger names it.
    #[must_use]
    pub fn reason(self) -> &'static str {
        match self {
            Self::Geometry(GeometryRefusal::NotFinite) => "refused by the engine: a position is not finite",
            Self::Geometry(GeometryRefusal::Degenerate) => {
                "refused by the engine: the baseline has no direction"
            }
            Self::Geometry(GeometryRefusal::Inclination) => "refused by the engine: out of the orbit's plane",
            Self::Geometry(GeometryRefusal::Altitude) => "refused by the engine: off the orbit's altitude",
            Self::Geometry(GeometryRefusal::UnequalRadii) => {
                "refused by the engine: unequal altitudes of a pair"
            }
            Self::TooLong => "refused by the engine: baseline beyond its limit",
            Self::NotFinite => "refused by the engine: value or weight not finite, or weight not positive",
        }
    }
}

/// What became of the visibilities of one call; the two parts make up the call.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
#[must_use]
pub struct Added {
    /// Taken into the sums.
    pub visibilities: u64,
    /// Refused, by reason.
    pub refused: BTreeMap<Refusal, u64>,
}

impl Added {
    fn refuse(&mut self, reason: Refusal) {
        *self.refused.entry(reason).or_default() += 1;
    }
}

/// Takes visibilities of one channel, one block after another.
///
/// The sums depend on the order of the visibilities, in their last bits, but neither on how they come in
/// blocks nor on threads, nor on whether [`NormalEngine::sums`] was called on the way.
pub trait NormalEngine: Send {
    /// The form of the sums.
    type Sums: NormalSums;

    /// Adds visibilities.
    ///
    /// # Errors
    /// A block that is none of this engine's channel. Geometry that the engine does not cover is
    /// counted as refused instead.
    fn add(&mut self, placed: &PlacedVisibilities) -> Result<Added, AccumulationError>;

    /// Takes out visibilities that were added: the inverse of [`NormalEngine::add`].
    ///
    /// What the engine would refuse to add is refused here too, and counted; that the others were ever added is
    /// for the caller to know.
    ///
    /// # Errors
    /// As [`NormalEngine::add`].
    fn remove(&mut self, placed: &PlacedVisibilities) -> Result<Added, AccumulationError>;

    /// Adds what waits for company, if anything does; changes no bit of the sums.
    fn settle(&mut self) {}

    /// Adds what another engine of the same setup holds.
    ///
    /// # Errors
    /// [`AccumulationError::Mismatch`] if the setups differ.
    fn merge(&mut self, other: Self) -> Result<(), AccumulationError>
    where
        Self: Sized;

    /// What is in the engine.
    fn counts(&self) -> SumCounts;

    /// A copy of the sums of all visibilities so far.
    fn sums(&self) -> Self::Sums;

    /// The sums of all visibilities, without a copy.
    fn into_sums(self) -> Self::Sums
    where
        Self: Sized;

    /// Writes all that is needed to go on later, with a checksum.
    ///
    /// # Errors
    /// What the writer says.
    fn checkpoint(&self, out: &mut dyn std::io::Write) -> Result<(), AccumulationError>;

    /// An engine as [`NormalEngine::checkpoint`] wrote it; it goes on to the same bits.
    ///
    /// # Errors
    /// Data that is damaged, cut short, or of another version.
    fn restore(from: &mut dyn std::io::Read) -> Result<Self, AccumulationError>
    where
        Self: Sized;
}

/// Normal equations of one channel, ready to be solved.
pub trait NormalSums: Send {
    /// Number of unknowns: pixels or harmonic coefficients.
    fn unknowns(&self) -> usize;

    /// `y = BtN^-1B x`; both of length [`NormalSums::unknowns`].
    fn apply(&self, x: &[f64], y: &mut [f64]);

    /// `BtN^-1V`.
    fn right_hand_side(&self) -> &[f64];

    /// `BtN^-1n` for noise n of the data's own weights: the right-hand side of a noise-only map.
    fn noise_side(&self) -> &[f64];

    /// What is in the sums.
    fn counts(&self) -> SumCounts;
}
