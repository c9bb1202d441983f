//! Maps with rows of B at the true positions: keeps every visibility, and refines the map of the nearest circle.

mod archive;
mod archived;
mod assumed_instrument;
mod iterations;
mod refinement;
mod segments;
mod solve;
mod subspace;
mod sums;

pub use archive::{REFINED_VISIBILITY_BYTES, VisibilityArchive};
pub use archived::RefinedSetup;
pub use assumed_instrument::{AssumedAntenna, AssumedInstrument};
pub(super) use iterations::PassFile;
pub use refinement::{ChiSquares, Refinement};
pub use segments::{ArchiveSegment, HELD_BYTES, SegmentPlace};
pub use solve::{RefineRule, RefineSteps, solve_refined};
pub use sums::{Departures, RefinedData, RefinedSums, orbit_phase_deg};
