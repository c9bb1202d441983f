//! What the ground leaves behind besides its sums.

use std::sync::{Arc, Mutex};

use crate::calibration::Completeness;
use crate::downlink::ReceptionCounters;
use crate::frames::{AutoPower, VisibilityReason};
use crate::runtime::Ledger;

/// What the ground leaves behind besides its sums; complete once its stage has finished. Clones share it.
#[derive(Clone, Debug, Default)]
pub struct GroundOutcome {
    /// What became of every visibility.
    pub ledger: Ledger<VisibilityReason>,
    /// Whether the ledger is known to be complete.
    pub completeness: Arc<Mutex<Completeness>>,
    /// What was received, and what was wrong with it.
    pub reception: Arc<Mutex<ReceptionCounters>>,
    /// Auto-correlations, by channel, daughter and time.
    pub autos: Arc<Mutex<Vec<AutoPower>>>,
}
