//! The results of the ground stage other than its sums.

use std::fmt;
use std::sync::atomic::{AtomicBool, AtomicU64};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use serde::Serialize;

use super::{GroundError, LiveView};

use crate::calibration::{Completeness, FoundBursts, SolvedGains};
use crate::downlink::ReceptionCounters;
use crate::frames::{AutoPower, VisibilityReason};
use crate::runtime::Ledger;
use crate::units::vector::Vec3;

/// A total power, and where its daughter was, m.
pub type PlacedPower = (AutoPower, Vec3);

/// The results of the ground stage other than its sums. Clones share them; they are complete once the stage has finished.
#[derive(Clone, Debug, Default)]
pub struct GroundOutcome {
    /// Accounting of every visibility.
    pub ledger: Ledger<VisibilityReason>,
    /// Whether the ledger is known to be complete.
    pub completeness: Arc<Mutex<Completeness>>,
    /// Counters of received data and faults. While the stage works, they may lag by a few steps.
    pub reception: Arc<Mutex<ReceptionCounters>>,
    /// Auto-correlations, by channel, daughter and time.
    pub autos: Arc<Mutex<Vec<AutoPower>>>,
    /// Those with known positions, m, in the same order; `None` if nobody asked for them ([`Ground::with_placed_autos`](super::Ground)).
    pub placed_autos: Option<Arc<Mutex<Vec<PlacedPower>>>>,
    /// The solved gains; `None` if gains are not solved for.
    pub gains: Option<SolvedGains>,
    /// The bursts of point sources found in any session.
    pub bursts: FoundBursts,
    /// Bytes of held visibilities. While the stage works, they may lag by a few steps.
    pub waiting_bytes: Arc<AtomicU64>,
    /// The report on checkpoints, up to date at any time.
    pub saving: SharedSaving,
    /// The view for page visitors.
    pub live_view: LiveView,
    /// Whether a cancelled run left data that were received out of the sums.
    pub left_data: Arc<AtomicBool>,
}

/// Age of the oldest unsaved packet at which a checkpoint is due.
const UNSAVED_AGE_MAX: Duration = Duration::from_secs(60);

/// Minimum pause before the next checkpoint that is due by age.
const PAUSE_MIN: Duration = Duration::from_secs(10);

/// Pause after a checkpoint in units of the time that it took, so that checkpoints due by age take at most a tenth of the time.
const PAUSE_FACTOR: u32 = 9;

/// Report on the checkpoints of a session.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct SavingReport {
    /// Checkpoints that were written.
    pub written: u64,
    /// Attempts that failed.
    pub failed: u64,
    /// Why the last attempt failed; `None` if it did not.
    pub unsaved: Option<String>,
    /// Bytes received since the newest checkpoint, those in the raw archive included; 0 if no packet among them is new.
    pub unsaved_bytes: u64,
    /// Age of the oldest packet that is in no checkpoint, s; 0 if all packets are.
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

/// The report on the checkpoints of a running ground stage. Clones share it.
#[derive(Clone, Debug, Default)]
pub struct SharedSaving(Arc<Mutex<Option<SavingProgress>>>);

#[derive(Debug, Default)]
struct SavingProgress {
    report: SavingReport,
    received: u64,
    /// Bytes received before the newest checkpoint.
    saved: u64,
    /// Arrival of the oldest packet that is in no checkpoint.
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
        let SavingProgress { report, received, saved, unsaved_since, written_at, .. } = saving.as_ref()?;
        let age_s = |since: &Instant| since.elapsed().as_secs_f64();
        let unsaved_bytes = if unsaved_since.is_some() { received.saturating_sub(*saved) } else { 0 };
        Some(SavingReport {
            unsaved_bytes,
            unsaved_s: unsaved_since.as_ref().map_or(0.0, age_s),
            checkpoint_s: written_at.as_ref().map(age_s),
            ..report.clone()
        })
    }

    /// Notes the number of bytes received so far. `has_new` says whether a packet among them is in no checkpoint.
    pub(super) fn note_received(&self, bytes: u64, has_new: bool) {
        if let Some(saving) = &mut *self.lock() {
            saving.received = bytes;
            if has_new {
                saving.unsaved_since.get_or_insert_with(Instant::now);
            } else {
                (saving.unsaved_since, saving.saved) = (None, bytes);
            }
        }
    }

    /// Whether a checkpoint is due by the age of unsaved packets.
    pub(super) fn is_old(&self) -> bool {
        let saving = self.lock();
        let Some(saving) = &*saving else { return false };
        saving.unsaved_since.is_some_and(|since| since.elapsed() >= UNSAVED_AGE_MAX)
            && saving.not_before.is_none_or(|instant| Instant::now() >= instant)
    }

    fn lock(&self) -> MutexGuard<'_, Option<SavingProgress>> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Starts the report, as there is an archive.
    pub(super) fn begin(&self) {
        self.lock().get_or_insert_default();
    }

    /// Counts an attempt to write a checkpoint. Returns whether the previous attempt had failed.
    pub(super) fn count_attempt(&self, failure: Option<&GroundError>, begun: Instant) -> bool {
        let mut saving = self.lock();
        let saving = saving.get_or_insert_default();
        let now = Instant::now();
        // The pause applies after a failure as well.
        let pause = begun.elapsed().saturating_mul(PAUSE_FACTOR).max(PAUSE_MIN);
        saving.not_before = now.checked_add(pause);
        if failure.is_none() {
            (saving.saved, saving.unsaved_since, saving.written_at) = (saving.received, None, Some(now));
        }
        let SavingReport { written, failed, unsaved, .. } = &mut saving.report;
        let failed_before = unsaved.is_some();
        *if failure.is_some() { failed } else { written } += 1;
        *unsaved = failure.map(ToString::to_string);
        failed_before
    }
}
