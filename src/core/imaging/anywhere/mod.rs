//! Iterative refinement of maps with the rows of B at the true positions: stored visibilities, and harmonic sums on the nearest circular
//! orbit as the preconditioner.

mod archive;
mod archived;
mod cost;
mod iterations;
mod refinement;
mod segments;
mod solve;
mod subspace;
mod sums;
mod with_power;

pub use super::assumed_instrument::{AssumedAntenna, AssumedInstrument};
pub use archive::{REFINED_VISIBILITY_BYTES, VisibilityArchive};
pub use archived::RefinedSetup;
pub(super) use cost::refined_cost;
pub(super) use iterations::IterationFile;
pub use refinement::{ChiSquares, Refinement};
pub use segments::{ARCHIVED_BYTES, ArchiveSegment, SegmentFolder};
pub use solve::{RefineRule, RefineSteps, solve_refined};
pub use sums::{Departures, RefinedData, RefinedSums, orbit_phase_deg};
