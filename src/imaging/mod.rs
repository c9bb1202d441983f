//! Maps from visibilities: normal equations, summed as data arrive, and their regularised solution
//! `T = (BtN^-1B + R)^-1 BtN^-1 (V - B T_p) + T_p` with `R_l = 1 / C_l`, C_l the sky's angular power as the data have it ([`SkyPower`]);
//! or `R = epsilon W_max I`, W_max the largest eigenvalue of `BtN^-1B` (the paper, Sect. 4), or another [`Regulariser`].
//!
//! Each map method is a folder, with its sums and their solution. `pixel` forms the matrix itself, or makes its rows again for each
//! product; [`circle`] makes the matrix act on spherical harmonics, for satellites on one circular orbit; [`anywhere`] refines its
//! maps with rows at the true positions; `joint` solves for several channels of its sums together.
//!
//! Methods share `exact` (sums as integers, whose bits depend only on which visibilities are in them, and checkpoints), `solver`
//! (conjugate gradients, eigenvalues, traces) and `power` (the sky's angular power). `stage` holds the two stages of the pipeline,
//! [`Accumulator`] and [`Solver`]. Uses [`crate::frames`], [`mod@crate::array`], [`crate::response`], [`crate::sky`].

mod antennas;
#[doc(hidden)]
pub mod anywhere;
#[doc(hidden)]
pub mod circle;
mod config;
pub(crate) mod cost;
mod error;
mod exact;
#[doc(hidden)]
pub mod joint;
mod pixel;
mod power;
pub(crate) mod rates;
mod regulariser;
mod solver;
mod stage;

#[doc(hidden)]
pub use circle::{
    HarmonicRequest, HarmonicSolution, NOISES_TOGETHER, harmonic_beams, solve_harmonics, solve_noises,
    solve_regularised,
};
pub use config::MapConfig;
#[doc(hidden)]
pub use config::{ChannelGroup, EngineKind, MatrixKind, REFINED, RefineConfig, RegulariserChoice};
pub use error::AccumulationError;
pub use exact::ExactEngine;
#[doc(hidden)]
pub use exact::automatic_weight_max;
#[doc(hidden)]
pub use pixel::{
    Cholesky, ColumnBlock, MatrixFreeSums, MatrixFreeVisibilities, NotPositive, PixelExtras, PointBeam,
    SymmetricTiles, TILE, solve_matrix_free, solve_pixels_with, solve_pixels_with_power,
};
pub use pixel::{Diagnostics, PixelEngine, PixelSetup, PixelSolution, PixelSums, solve_pixels};
#[doc(hidden)]
pub use power::{SkyPower, Uncertainty};
#[doc(hidden)]
pub use regulariser::Regulariser;
pub use solver::SolveError;
#[doc(hidden)]
pub use solver::{
    Convergence, Estimate, Fit, HELD_MAX, LargestEigenvalue, NamedWatch, SolveWatch, Solving, SolvingPart,
    Spectrum, StoppingRule, Traces, UnsupportedEpsilon, W_MAX_EXACT, effective_beam, largest_eigenvalue,
    noise_variance, probed_traces, regularisation, spectrum, traces,
};
#[doc(hidden)]
pub use stage::{Accumulator, AccumulatorState, Snapshot, SnapshotSums, Solution, Solver, SolverSetup};

use std::collections::BTreeMap;

use serde::Serialize;

use crate::frames::{PlacedVisibilities, VisibilityReason};
use crate::response::harmonic::GeometryRefusal;

/// Number, weight and power of the visibilities in an engine or its sums.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, bincode::Encode, bincode::Decode)]
pub struct SumCounts {
    /// Visibilities in the sums.
    pub visibilities: u64,
    /// Sum of their weights, (K sr)^-2.
    pub weight: f64,
    /// `V'N^-1V`: the sum of their squares times weights.
    pub power: f64,
}

/// Why an engine refuses a visibility.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
#[non_exhaustive]
pub enum Refusal {
    /// The engine's basis does not cover the positions of its satellites.
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

/// Result of one call: each visibility was either accepted or refused.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
#[must_use]
pub struct Added {
    /// Accepted: now in the sums, or removed from them.
    pub visibilities: u64,
    /// Refused, by reason.
    pub refused: BTreeMap<Refusal, u64>,
}

impl Added {
    pub(in crate::imaging) fn refuse(&mut self, reason: Refusal) {
        *self.refused.entry(reason).or_default() += 1;
    }
}

/// Sums the visibilities of one channel, block by block.
///
/// Sums are exact: each term is rounded once, by a rule that looks at its own visibility alone, to a multiple of a
/// quantum that the setup fixes, and the multiples are added as integers. So the sums, and the bytes of a checkpoint,
/// depend on which visibilities are in them and on nothing else: not on their order, blocks or threads, not on how
/// engines were merged, nor on what was added and removed again.
pub trait NormalEngine: Send {
    /// The form of the sums.
    type Equations: NormalSums;

    /// Adds visibilities.
    ///
    /// # Errors
    /// A block of another frequency, or with arrays of unequal lengths. A visibility that the engine does not cover, or has no room for, is counted as
    /// refused instead.
    fn add(&mut self, placed: &PlacedVisibilities) -> Result<Added, AccumulationError>;

    /// Removes visibilities that were added: the exact inverse of [`NormalEngine::add`].
    ///
    /// A visibility that the engine would not add is refused here too, and counted. The caller has to know that the
    /// others were added.
    ///
    /// # Errors
    /// A block of another frequency, or with arrays of unequal lengths; or [`AccumulationError::NothingHeld`] if the engine holds less than is to be
    /// removed. Nothing changes then.
    fn remove(&mut self, placed: &PlacedVisibilities) -> Result<Added, AccumulationError>;

    /// Sums the pending visibilities now instead of with the next batch; the sums get the same bits either way.
    #[doc(hidden)]
    fn flush(&mut self);

    /// Adds the sums of another engine of the same setup.
    ///
    /// # Errors
    /// [`AccumulationError::Mismatch`] if the setups differ; [`AccumulationError::Range`] if there is no room for both.
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

    /// Number and weight of the visibilities in the engine.
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

    /// Reads an engine that [`NormalEngine::checkpoint`] wrote; it resumes to the same bits.
    ///
    /// # Errors
    /// Data that is damaged, truncated, or of another format.
    #[doc(hidden)]
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

    /// `BtN^-1B x` of each x, with the bits of [`NormalSums::apply`]; cheaper than one by one where reading the sums takes time.
    #[doc(hidden)]
    fn apply_all(&self, x: &[&[f64]]) -> Vec<Vec<f64>> {
        let product = |x: &&[f64]| {
            let mut y = vec![0.0; x.len()];
            self.apply(x, &mut y);
            y
        };
        x.iter().map(product).collect()
    }

    /// `BtN^-1V`.
    fn right_hand_side(&self) -> &[f64];

    /// `BtN^-1n` for noise n of the data's own weights: the right-hand side of a noise-only map.
    #[doc(hidden)]
    fn noise_right_hand_side(&self) -> &[f64];

    /// Number and weight of the visibilities in the sums.
    fn counts(&self) -> SumCounts;

    /// How well the eigenvalues of `BtN^-1B` are known.
    #[doc(hidden)]
    fn accuracy(&self) -> Accuracy;

    /// Why sums on disk could not be read: products are not numbers from then on.
    #[doc(hidden)]
    fn failure(&self) -> Option<&str> {
        None
    }
}

/// What rounding and the approximations of an engine leave open of an eigenvalue W of `BtN^-1B`: `relative` W + `absolute`
/// W_max. Those of the harmonic engine have been compared with rows one by one in f64; those of the other are estimates.
#[derive(Clone, Copy, Debug, PartialEq)]
#[doc(hidden)]
pub struct Accuracy {
    /// Of the eigenvalue itself.
    pub relative: f64,
    /// Of the largest one. Much smaller eigenvalues have no meaning.
    pub absolute: f64,
}
