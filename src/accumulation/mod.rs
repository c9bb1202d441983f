//! Normal equations, summed as data arrives.
//!
//! An engine turns placed visibilities into `BtN^-1B` and `BtN^-1V` in whatever form serves it; the
//! solver asks for no more than their action on a vector. [`PixelEngine`] holds the matrix itself.
//! Uses [`crate::frames`], [`mod@crate::array`], [`crate::sky`].

mod checkpoint;
mod config;
mod error;
mod pixel;
mod stage;
mod tiles;

pub use config::{MapConfig, MapConfigError};
pub use error::AccumulationError;
pub use pixel::{PixelEngine, PixelSetup, PixelSums};
pub use stage::{Accumulator, Snapshot};
pub use tiles::{Columns, SymmetricTiles, TILE};

use serde::Serialize;

use crate::frames::PlacedVisibilities;

/// What an engine or its sums hold.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, bincode::Encode, bincode::Decode)]
pub struct SumCounts {
    /// Visibilities in the sums.
    pub visibilities: u64,
    /// Sum of their weights, (K sr)^-2.
    pub weight: f64,
}

/// What became of the visibilities of one call; the two parts make up the call.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[must_use]
pub struct Added {
    /// Taken into the sums.
    pub visibilities: u64,
    /// Refused: their geometry lies outside what the engine covers.
    pub refused: u64,
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
