//! Iterative refinement of maps with the rows of B at the true positions: stored visibilities, and harmonic sums on the nearest circular
//! orbit as the preconditioner.

mod archive;
mod archived;
mod assumed_instrument;
mod cost;
mod iterations;
mod method;
mod refinement;
mod segments;
mod solve;
mod subspace;
mod sums;
mod with_power;

pub use archive::{REFINED_VISIBILITY_BYTES, VisibilityArchive};
pub use archived::RefinedSetup;
pub use assumed_instrument::{AssumedAntenna, AssumedInstrument};
pub(super) use method::{ArchiveUse, ArchivedSums, RefinedMaps};
pub use refinement::{ChiSquares, Refinement};
pub use segments::{ArchiveSegment, HELD_BYTES, SegmentFolder};
pub use solve::{RefineRule, RefineSteps, solve_refined};
pub use sums::{Departures, RefinedData, RefinedSums, orbit_phase_deg};
