//! What the ground leaves behind besides its sums.

use std::fmt;
use std::sync::atomic::AtomicU64;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use serde::Serialize;

use super::{GroundError, LiveView};

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
    /// Bytes of visibilities that wait for their positions; while the stage works, as of a few steps ago.
    pub waiting_bytes: Arc<AtomicU64>,
    /// How its checkpoints went, at any time.
    pub saving: SharedSaving,
    /// Where visitors see it at work.
    pub live_view: LiveView,
}

/// A checkpoint is due once what came first after the last one is so old.
const AGE_MAX: Duration = Duration::from_secs(60);

/// Least time between two that are due by age.
const RETRY: Duration = Duration::from_secs(10);

/// A checkpoint that is due by age takes no more than a tenth of the time.
const REST: u32 = 9;

/// How the checkpoints of a session went.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct SavingReport {
    /// Checkpoints that were written.
    pub written: u64,
    /// Attempts that failed.
    pub failed: u64,
    /// Why the last attempt failed; `None` if it did not.
    pub unsaved: Option<String>,
    /// Bytes that were received since the newest checkpoint, if a packet among them is new; those that came in a raw archive too.
    pub unsaved_bytes: u64,
    /// Age of the oldest packet that no checkpoint holds, s; 0 if all are held.
    pub unsaved_s: f64,
    /// Age of the newest checkpoint of this session, s.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub checkpoint_s: Option<f64>,
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
pub struct SharedSaving(Arc<Mutex<Option<Saving>>>);

/// Shared source of a [`SavingReport`].
#[derive(Debug, Default)]
struct Saving {
    report: SavingReport,
    /// Bytes received, and how many of them the newest checkpoint holds.
    received: u64,
    held: u64,
    /// When the first packet came that no checkpoint holds.
    unsaved_since: Option<Instant>,
    written_at: Option<Instant>,
    /// Time before which no checkpoint is due by age.
    not_before: Option<Instant>,
}

impl SharedSaving {
    /// The report so far; `None` without an archive.
    #[must_use]
    pub fn report(&self) -> Option<SavingReport> {
        let saving = self.lock();
        let Saving { report, received, held, unsaved_since, written_at, .. } = saving.as_ref()?;
        let age_s = |since: &Instant| since.elapsed().as_secs_f64();
        let unsaved_bytes = if unsaved_since.is_some() { received.saturating_sub(*held) } else { 0 };
        Some(SavingReport {
            unsaved_bytes,
            unsaved_s: unsaved_since.as_ref().map_or(0.0, age_s),
            checkpoint_s: written_at.as_ref().map(age_s),
            ..report.clone()
        })
    }

    /// So many bytes have been received; `has_new` if there is a packet among them that no checkpoint holds.
    pub(super) fn note_received(&self, bytes: u64, has_new: bool) {
        if let Some(saving) = &mut *self.lock() {
            saving.received = bytes;
            match has_new {
                true => drop(saving.unsaved_since.get_or_insert_with(Instant::now)),
                false => (saving.unsaved_since, saving.held) = (None, bytes),
            }
        }
    }

    /// Whether a checkpoint is due because of the age of what none holds.
    pub(super) fn is_old(&self) -> bool {
        let saving = self.lock();
        let Some(saving) = &*saving else { return false };
        saving.unsaved_since.is_some_and(|since| since.elapsed() >= AGE_MAX)
            && saving.not_before.is_none_or(|instant| Instant::now() >= instant)
    }

    fn lock(&self) -> MutexGuard<'_, Option<Saving>> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// There is an archive.
    pub(super) fn begin(&self) {
        self.lock().get_or_insert_default();
    }

    /// Counts an attempt that was begun at an instant; returns whether the one before had failed.
    pub(super) fn update(&self, failure: Option<&GroundError>, begun: Instant) -> bool {
        let mut saving = self.lock();
        let saving = saving.get_or_insert_default();
        let now = Instant::now();
        // After a failure not at once, either.
        let pause = begun.elapsed().saturating_mul(REST).max(RETRY);
        saving.not_before = now.checked_add(pause);
        if failure.is_none() {
            (saving.held, saving.unsaved_since, saving.written_at) = (saving.received, None, Some(now));
        }
        let SavingReport { written, failed, unsaved, .. } = &mut saving.report;
        let failed_before = unsaved.is_some();
        *if failure.is_some() { failed } else { written } += 1;
        *unsaved = failure.map(ToString::to_string);
        failed_before
    }
}
