//! What the ground leaves behind besides its sums.

use std::fmt;
use std::sync::{Arc, Mutex, PoisonError};

use serde::Serialize;

use super::{GroundError, Lookout};

use crate::calibration::{Completeness, SolvedGains};
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
    /// What was received, and what was wrong with it; while the stage works, as of a few steps ago.
    pub reception: Arc<Mutex<ReceptionCounters>>,
    /// Auto-correlations, by channel, daughter and time.
    pub autos: Arc<Mutex<Vec<AutoPower>>>,
    /// The gains that it finds, if it finds any.
    pub gains: Option<SolvedGains>,
    /// How its checkpoints went, at any time.
    pub saving: SharedSaving,
    /// Where visitors see it at work.
    pub lookout: Lookout,
}

/// How the checkpoints of a session went.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize)]
pub struct SavingReport {
    /// Checkpoints that were written.
    pub written: u64,
    /// Attempts that failed.
    pub failed: u64,
    /// Why the last attempt failed; `None` if it did not.
    pub unsaved: Option<String>,
}

impl fmt::Display for SavingReport {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match &self.unsaved {
            Some(reason) => write!(f, "state not saved, {} failed: {reason}", attempts(self.failed)),
            None => write!(f, "state saved; {} failed before", attempts(self.failed)),
        }
    }
}

fn attempts(count: u64) -> String {
    format!("{count} attempt{}", if count == 1 { "" } else { "s" })
}

/// The report on the checkpoints of a ground at work; clones share it.
#[derive(Clone, Debug, Default)]
pub struct SharedSaving(Arc<Mutex<Option<SavingReport>>>);

impl SharedSaving {
    /// The report so far; `None` without an archive.
    #[must_use]
    pub fn report(&self) -> Option<SavingReport> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }

    /// There is an archive.
    pub(super) fn begin(&self) {
        self.0.lock().unwrap_or_else(PoisonError::into_inner).get_or_insert_default();
    }

    /// Counts an attempt; returns whether the one before had failed.
    pub(super) fn update(&self, failure: Option<&GroundError>) -> bool {
        let mut report = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        let SavingReport { written, failed, unsaved } = report.get_or_insert_default();
        let failed_before = unsaved.is_some();
        *if failure.is_some() { failed } else { written } += 1;
        *unsaved = failure.map(ToString::to_string);
        failed_before
    }
}
