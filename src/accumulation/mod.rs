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
mod exact;
pub mod harmonic;
mod noise;
mod pixel;
mod scale;
mod stage;
mod tiles;

pub use config::{EngineKind, MapConfig};
pub use error::AccumulationError;
pub use pixel::{PixelEngine, PixelSetup, PixelSums};
pub use scale::automatic_weight_max;
pub use stage::{Accumulator, AccumulatorState, Snapshot, Sums};
pub use tiles::{Columns, SymmetricTiles, TILE};

use std::collections::BTreeMap;

use serde::Serialize;

use crate::frames::{PlacedVisibilities, VisibilityReason};
use crate::response::harmonic::GeometryRefusal;

/// What an engine or its sums hold.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, bincode::Encode, bincode::Decode)]
pub struct SumCounts {
    /// Visibilities in the sums.
    pub visibilities: u64,
    /// Sum of their weights, (K sr)^-2.
    pub weight: f64,
}

/// Why an engine does not take a visibility.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
#[non_exhaustive]
pub enum Refusal {
    /// Its satellites are not where the engine's basis needs them.
    Geometry(GeometryRefusal),
    /// Its baseline is longer than the engine was made for.
    TooLong,
    /// Its value or weight cannot be summed.
    NotFinite,
    /// Its weight, or its value in units of its noise, is more than the sums have room for.
    OutOfRange,
    /// The sums have no room for more weight.
    Full,
}

impl From<GeometryRefusal> for Refusal {
    fn from(refusal: GeometryRefusal) -> Self {
        Self::Geometry(refusal)
    }
}

/// The reason in the ledger.
impl From<Refusal> for VisibilityReason {
    fn from(refusal: Refusal) -> Self {
        match refusal {
            Refusal::Geometry(GeometryRefusal::NotFinite) => Self::PositionNotFinite,
            Refusal::Geometry(GeometryRefusal::Degenerate) => Self::NoDirection,
            Refusal::Geometry(GeometryRefusal::Inclination) => Self::OutOfPlane,
            Refusal::Geometry(GeometryRefusal::Altitude) => Self::OffAltitude,
            Refusal::Geometry(GeometryRefusal::UnequalRadii) => Self::UnequalAltitudes,
            Refusal::TooLong => Self::BaselineBeyondEngine,
            Refusal::NotFinite => Self::ValueNotFinite,
            Refusal::OutOfRange => Self::WeightOutOfRange,
            Refusal::Full => Self::SumsFull,
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

/// Whether visibilities are put in or taken out.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Direction {
    In,
    Out,
}

impl Direction {
    fn sign(self) -> f64 {
        match self {
            Self::In => 1.0,
            Self::Out => -1.0,
        }
    }
}

/// Takes visibilities of one channel, one block after another.
///
/// Sums are exact: each term is rounded once, by a rule that looks at its own visibility alone, to a multiple of a
/// quantum that the setup fixes, and the multiples are added as integers. So the sums, and the bytes of a checkpoint,
/// depend on which visibilities are in them and on nothing else: not on their order, blocks or threads, not on how
/// engines were merged, nor on what was put in and taken out again.
pub trait NormalEngine: Send {
    /// The form of the sums.
    type Sums: NormalSums;

    /// Adds visibilities.
    ///
    /// # Errors
    /// A block that is none of this engine's channel. Geometry that the engine does not cover is
    /// counted as refused instead.
    fn add(&mut self, placed: &PlacedVisibilities) -> Result<Added, AccumulationError>;

    /// Takes out visibilities that were added: the exact inverse of [`NormalEngine::add`].
    ///
    /// What the engine would refuse to add is refused here too, and counted; that the others were ever added is
    /// for the caller to know.
    ///
    /// # Errors
    /// As [`NormalEngine::add`]; or more is to be taken out than there is.
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

    /// Takes out what another engine of the same setup holds: the exact inverse of [`NormalEngine::merge`].
    ///
    /// # Errors
    /// [`AccumulationError::Mismatch`] if the setups differ; or more is to be taken out than there is.
    fn subtract(&mut self, other: Self) -> Result<(), AccumulationError>
    where
        Self: Sized;

    /// What is in the engine.
    fn counts(&self) -> SumCounts;

    /// A copy of the sums of all visibilities so far.
    fn sums(&mut self) -> Self::Sums;

    /// The sums of all visibilities, without a copy.
    fn into_sums(self) -> Self::Sums
    where
        Self: Sized;

    /// Writes all that is needed to go on later, with a checksum.
    ///
    /// # Errors
    /// What the writer says.
    fn checkpoint(&mut self, out: &mut dyn std::io::Write) -> Result<(), AccumulationError>;

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
