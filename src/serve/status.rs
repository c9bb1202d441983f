//! The state of a run, as `/api/status` tells it: the terms of `summary.json` where they exist.

use serde::Serialize;

use super::pulse::StageRate;
use super::shelf::ChannelStatus;
use crate::calibration::Completeness;
use crate::downlink::ReceptionCounters;
use crate::downlink::transport::packet_archive::ArchiveReport;
use crate::downlink::transport::socket::ListenReport;
use crate::frames::VisibilityReason;
use crate::ground::SavingReport;
use crate::products::ProductsReport;
use crate::runtime::{LedgerReport, StageProgress, TimingSummary};

/// Where a run is.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub(super) enum Phase {
    /// It is being prepared.
    #[default]
    Starting,
    /// Data flow.
    Running,
    /// It has ended well, or was ended.
    Ended,
    /// It has failed.
    Failed,
}

impl Phase {
    pub(super) const ALL: [Self; 4] = [Self::Starting, Self::Running, Self::Ended, Self::Failed];

    pub(super) fn name(self) -> &'static str {
        match self {
            Self::Starting => "starting",
            Self::Running => "running",
            Self::Ended => "ended",
            Self::Failed => "failed",
        }
    }
}

/// The queue before a stage.
#[derive(Clone, Copy, Debug, Serialize)]
pub(super) struct QueueStatus {
    /// Items that it can hold.
    pub(super) capacity: usize,
    /// Items in it.
    pub(super) depth: usize,
    /// Greatest number of items found in it.
    depth_max: usize,
}

/// A stage.
#[derive(Clone, Debug, Serialize)]
pub(super) struct StageStatus {
    pub(super) name: String,
    pub(super) items_in: u64,
    pub(super) items_out: u64,
    pub(super) units: u64,
    pub(super) unit: &'static str,
    /// Units per second, over the last seconds; after the run over all of it.
    units_per_s: f64,
    /// Share of that time in which it worked.
    pub(super) busy: f64,
    pub(super) ended: bool,
    pub(super) queue: Option<QueueStatus>,
    working: TimingSummary,
    since_source: TimingSummary,
}

/// The stages with their queues. A stage reads what the one before it in the list writes.
pub(super) fn stages_of(progress: &[StageProgress], rates: &[StageRate]) -> Vec<StageStatus> {
    let before = |k: usize| k.checked_sub(1).map_or(0, |before| progress[before].items_out);
    let stage = |(k, (stage, rate)): (usize, (&StageProgress, &StageRate))| StageStatus {
        name: stage.name.clone(),
        items_in: stage.items_in,
        items_out: stage.items_out,
        units: stage.units.count,
        unit: stage.units.name,
        units_per_s: rate.units_per_s,
        busy: rate.busy,
        ended: stage.ended,
        queue: stage.queue_capacity.map(|capacity| QueueStatus {
            capacity,
            // Counters of two threads, read one after the other.
            depth: (before(k).saturating_sub(stage.items_in) as usize).min(capacity),
            depth_max: stage.queue_depth_max,
        }),
        working: stage.working.summary(),
        since_source: stage.since_source.summary(),
    };
    progress.iter().zip(rates).enumerate().map(stage).collect()
}

/// The solution in progress.
#[derive(Clone, Debug, Serialize)]
pub(super) struct SolverStatus {
    pub(super) what: String,
    pub(super) iteration: usize,
    pub(super) residual: f64,
    pub(super) target: f64,
    /// Time left if the residual keeps falling at the same rate, s.
    pub(super) left_s: Option<f64>,
}

/// The ledger of visibilities so far. How many were sampled is known at the end of a run: until then that and the rest are null.
#[derive(Clone, Debug)]
pub(super) struct LedgerStatus {
    pub(super) report: LedgerReport<VisibilityReason>,
    /// Visibilities that were sampled, and those without an entry, zero unless the ledger does not close.
    pub(super) sampled: Option<(u64, i128)>,
}

impl LedgerStatus {
    /// The status of a run that has ended, or goes on.
    pub(super) fn of(report: LedgerReport<VisibilityReason>, is_over: bool) -> Self {
        let sampled = is_over.then(|| (report.sampled, report.unaccounted()));
        Self { report, sampled }
    }
}

impl Serialize for LedgerStatus {
    fn serialize<S: serde::Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        let mut fields = serde_json::to_value(&self.report).map_err(serde::ser::Error::custom)?;
        fields["sampled"] = self.sampled.map(|(sampled, _)| sampled).into();
        fields["unaccounted"] = self.sampled.and_then(|(_, rest)| i64::try_from(rest).ok()).into();
        fields.serialize(serializer)
    }
}

/// Senders and their backlog.
#[derive(Clone, Debug, Serialize)]
pub(super) struct ListenerStatus {
    /// Open connections.
    pub(super) open: usize,
    /// Bytes read from all.
    pub(super) bytes: u64,
    /// Bytes read that the ground has not taken yet.
    pub(super) backlog_bytes: u64,
    /// Time since the last sound packet from anyone, s; null before the first of this session.
    pub(super) silence_s: Option<f64>,
    /// The raw archive, if there is one.
    pub(super) archive: Option<ArchiveReport>,
    /// Connections that have ended.
    pub(super) report: ListenReport,
}

/// Connections of browsers and programs.
#[derive(Clone, Copy, Debug, Default, Serialize)]
pub(super) struct VisitorStatus {
    pub(super) open: u64,
    pub(super) refused: u64,
    /// Closed by the server: silent, slow, or not HTTP.
    pub(super) cut: u64,
    pub(super) requests: u64,
}

/// All of it.
#[derive(Clone, Debug, Serialize)]
pub(super) struct Status {
    pub(super) version: &'static str,
    pub(super) name: String,
    /// Which part of the chain runs: `whole`, `ground` or `space`.
    pub(super) segment: &'static str,
    pub(super) phase: Phase,
    /// Why it failed.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(super) error: Option<String>,
    /// Whether it was told to end early.
    pub(super) cancelled: bool,
    /// Since the server's start, s.
    pub(super) up_s: f64,
    /// Since the server's start, to the end of the run if it has ended, s.
    pub(super) elapsed_s: f64,
    pub(super) stages: Vec<StageStatus>,
    pub(super) solving: Option<SolverStatus>,
    pub(super) ledger: Option<LedgerStatus>,
    /// Known at the end.
    pub(super) completeness: Option<Completeness>,
    pub(super) reception: Option<ReceptionCounters>,
    /// Bytes of visibilities that wait for their positions.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(super) waiting_bytes: Option<u64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(super) listening: Option<ListenerStatus>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(super) saving: Option<SavingReport>,
    /// How the files of maps go, of a ground that goes on without them.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(super) products: Option<ProductsReport>,
    pub(super) channels: Vec<ChannelStatus>,
    /// Whether `/api/gaps` answers.
    pub(super) has_state: bool,
    pub(super) visitors: VisitorStatus,
}
