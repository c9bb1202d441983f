//! Maps from visibilities: normal equations, accumulated as data arrive, and their regularised solution
//! `T = (BtN^-1B + R)^-1 BtN^-1 (V - B T_p) + T_p`. R is `1 / C_l` with the sky's angular power C_l estimated from the data ([`SkyPower`]);
//! or `epsilon W_max I`, W_max the largest eigenvalue of `BtN^-1B` (the paper, Sect. 4.1); or another [`Regulariser`].
//!
//! Each map method has a folder with its sums and their solution. `pixel` forms the matrix over pixels, or computes its rows again for each
//! product. [`circle`] applies the matrix to spherical harmonics, for satellites on one circular orbit; [`anywhere`] refines its maps with
//! rows of B at the true positions; `joint` solves for several channels together.
//!
//! The methods share `exact` (integer sums, whose bits depend only on which visibilities they hold, and the checkpoint format), `solver`
//! (conjugate gradients, eigenvalues, traces) and `power` (C_l from the data). `stage` holds the two pipeline stages, [`Accumulator`] and
//! [`Solver`]. Uses [`crate::frames`], [`mod@crate::array`], [`crate::response`], [`crate::sky`].

mod antennas;
#[doc(hidden)]
pub mod anywhere;
mod assumed_instrument;
mod beyond;
#[doc(hidden)]
pub mod circle;
mod config;
#[doc(hidden)]
pub mod cost;
mod error;
mod exact;
#[doc(hidden)]
pub mod joint;
mod method;
mod methods;
mod pixel;
mod power;
#[doc(hidden)]
pub mod rates;
mod regulariser;
mod request;
mod sensitivity;
mod solve_error;
mod solver;
mod stage;
mod unknowns;
#[doc(hidden)]
pub mod zoom;

#[doc(hidden)]
pub use beyond::read_power;
#[doc(hidden)]
pub use circle::{
    EVEN_SHARE, HarmonicRequest, HarmonicSolution, NOISES_TOGETHER, WHOLE_UNKNOWNS_MAX, harmonic_beams,
    solve_noises, solve_regularised,
};
pub use config::MapConfig;
#[doc(hidden)]
pub use config::{ChannelGroup, EngineKind, MatrixKind, Method, REFINED, RefineConfig, RegulariserChoice};
pub use error::AccumulationError;
pub use exact::ExactEngine;
#[doc(hidden)]
pub use exact::automatic_weight_max;
#[doc(hidden)]
pub use pixel::{
    Cholesky, ColumnBlock, MatrixFreeSums, MatrixFreeVisibilities, NotPositive, PixelExtras, SymmetricTiles,
    TILE, solve_matrix_free, solve_pixels_with, solve_pixels_with_power,
};
pub use pixel::{PixelEngine, PixelSetup, PixelSolution, PixelSums, solve_pixels};
#[doc(hidden)]
pub use power::{GainUncertainty, Sample, Samples, SkyPower, Uncertainty};
#[doc(hidden)]
pub use regulariser::Regulariser;
#[doc(hidden)]
pub use request::{KeptSums, SolverSetup};
#[doc(hidden)]
pub use sensitivity::{DegreeSensitivity, SensitivitySums};
pub use solve_error::SolveError;
pub use solver::Diagnostics;
#[doc(hidden)]
pub use solver::{
    Convergence, Estimate, Fit, LargestEigenvalue, NamedWatch, PointBeam, STORED_MAX, SolutionClock,
    SolveWatch, Solving, SolvingPart, StoppingRule, Traces, UnsupportedEpsilon, W_MAX_EXACT,
    largest_eigenvalue, probed_traces, traces,
};
#[doc(hidden)]
pub use stage::{Accumulator, AccumulatorState, Snapshot, Solution, Solver};

use std::collections::BTreeMap;

use serde::Serialize;

use crate::frames::{PlacedVisibilities, VisibilityReason};
use crate::response::harmonic::GeometryRefusal;

/// Number, total weight and power of the visibilities in an engine or its sums.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, bincode::Encode, bincode::Decode)]
pub struct SumCounts {
    /// Visibilities in the sums.
    pub visibilities: u64,
    /// Sum of their weights, (K sr)^-2.
    pub weight: f64,
    /// `V'N^-1V`, the sum of their squared moduli times weights.
    pub power: f64,
}

/// Why an engine refuses a visibility.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
#[non_exhaustive]
pub enum Refusal {
    /// The engine does not cover the positions of its satellites.
    Geometry(GeometryRefusal),
    /// Its baseline is longer than the engine's limit.
    TooLong,
    /// Its value or weight is not finite, or its weight is not positive.
    NotFinite,
    /// Its weight, or its value in units of its noise, exceeds the range of the sums.
    OutOfRange,
    /// The sums have no room for more weight.
    Full,
}

impl From<GeometryRefusal> for Refusal {
    fn from(refusal: GeometryRefusal) -> Self {
        Self::Geometry(refusal)
    }
}

/// Converts a refusal to its reason in the ledger.
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

/// The result of adding or removing visibilities, each of which is either accepted or refused.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
#[must_use]
pub struct Added {
    /// Number of visibilities that were added to the sums, or removed from them.
    pub visibilities: u64,
    /// Number of refused visibilities by reason.
    pub refused: BTreeMap<Refusal, u64>,
}

impl Added {
    pub(in crate::imaging) fn refuse(&mut self, reason: Refusal) {
        *self.refused.entry(reason).or_default() += 1;
    }
}

/// Accumulates the visibilities of one channel, block by block.
///
/// Sums are exact: each term is rounded once, by a rule that depends only on its own visibility, to a multiple of a
/// quantum that the setup fixes, and the multiples are added as integers. Therefore the sums, and the bytes of a
/// checkpoint, depend only on which visibilities are in them: not on their order, blocks or threads, nor on how engines
/// were merged, nor on what was added and removed again.
pub trait NormalEngine: Send {
    /// The form of the sums.
    type Equations: NormalSums;

    /// Adds visibilities.
    ///
    /// # Errors
    /// The block has another frequency, or arrays of unequal lengths. A visibility that the engine does not cover, or has no room for, is no
    /// error but counted as refused.
    fn add(&mut self, placed: &PlacedVisibilities) -> Result<Added, AccumulationError>;

    /// Removes visibilities that were added: the exact inverse of [`NormalEngine::add`].
    ///
    /// A visibility that the engine would not add is counted as refused here too. The caller must ensure that the others
    /// were added.
    ///
    /// # Errors
    /// The block has another frequency, or arrays of unequal lengths; or [`AccumulationError::NothingHeld`] if the engine holds less than is
    /// to be removed. The engine is then unchanged.
    fn remove(&mut self, placed: &PlacedVisibilities) -> Result<Added, AccumulationError>;

    /// Adds pending visibilities to the sums now instead of with the next batch, with the same bits.
    #[doc(hidden)]
    fn flush(&mut self);

    /// Adds the sums of another engine of the same setup.
    ///
    /// # Errors
    /// [`AccumulationError::Mismatch`] if the setups differ; [`AccumulationError::Range`] if the sums have no room for both.
    fn merge(&mut self, other: Self) -> Result<(), AccumulationError>
    where
        Self: Sized;

    /// Removes the sums of another engine of the same setup: the exact inverse of [`NormalEngine::merge`].
    ///
    /// # Errors
    /// [`AccumulationError::Mismatch`] if the setups differ; [`AccumulationError::Range`] if the engine holds less.
    #[doc(hidden)]
    fn subtract(&mut self, other: Self) -> Result<(), AccumulationError>
    where
        Self: Sized;

    /// Number, weight and power of the visibilities in the engine.
    fn counts(&self) -> SumCounts;

    /// The sums of all visibilities so far, as a copy.
    #[doc(hidden)]
    fn sums(&mut self) -> Self::Equations;

    /// The sums of all visibilities, without a copy.
    fn into_sums(self) -> Self::Equations
    where
        Self: Sized;

    /// Writes everything that is needed to resume, with a checksum.
    ///
    /// # Errors
    /// The writer's.
    #[doc(hidden)]
    fn checkpoint(&mut self, out: &mut dyn std::io::Write) -> Result<(), AccumulationError>;

    /// Reads an engine that [`NormalEngine::checkpoint`] wrote, with the same bits.
    ///
    /// # Errors
    /// The data is damaged, truncated, or of another format.
    #[doc(hidden)]
    fn restore(from: &mut dyn std::io::Read) -> Result<Self, AccumulationError>
    where
        Self: Sized;
}

/// Normal equations of one channel, ready to be solved.
pub trait NormalSums: Send {
    /// Number of unknowns: pixels or harmonic coefficients.
    fn unknowns(&self) -> usize;

    /// Computes `y = BtN^-1B x`; both have length [`NormalSums::unknowns`].
    fn apply(&self, x: &[f64], y: &mut [f64]);

    /// Computes `BtN^-1B x` for each x with the bits of [`NormalSums::apply`], in one reading of the sums where that saves time.
    #[doc(hidden)]
    fn apply_all(&self, x: &[&[f64]]) -> Vec<Vec<f64>> {
        let product = |x: &&[f64]| {
            let mut y = vec![0.0; x.len()];
            self.apply(x, &mut y);
            y
        };
        x.iter().map(product).collect()
    }

    /// The right-hand side `BtN^-1V`.
    fn right_hand_side(&self) -> &[f64];

    /// The right-hand side `BtN^-1n` of the noise-only map, n being simulated noise with the data's weights.
    #[doc(hidden)]
    fn noise_right_hand_side(&self) -> &[f64];

    /// The right-hand sides `BtN^-1e` of draws of the errors e of the data by their gains; none where these are not known, or not summed.
    #[doc(hidden)]
    fn gain_error_right_hand_sides(&self) -> &[Vec<f64>] {
        &[]
    }

    /// What these errors are expected to add to [`SumCounts::power`].
    #[doc(hidden)]
    fn gain_error_power(&self) -> f64 {
        0.0
    }

    /// Number, weight and power of the visibilities in the sums.
    fn counts(&self) -> SumCounts;

    /// The accuracy of the eigenvalues of `BtN^-1B`.
    #[doc(hidden)]
    fn accuracy(&self) -> Accuracy;

    /// Why sums on disk could not be read, if so; products are NaN from then on.
    #[doc(hidden)]
    fn failure(&self) -> Option<&str> {
        None
    }
}

/// The error of an eigenvalue W of `BtN^-1B` from rounding and approximations of an engine: `relative` W + `absolute` W_max. The values of
/// the harmonic engine were measured against rows in f64; those of the pixel engine are estimates.
#[derive(Clone, Copy, Debug, PartialEq)]
#[doc(hidden)]
pub struct Accuracy {
    /// Error relative to the eigenvalue itself.
    pub relative: f64,
    /// Error relative to the largest eigenvalue; much smaller eigenvalues are not significant.
    pub absolute: f64,
}
