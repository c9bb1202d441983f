//! The status of a run for `/api/status`. It uses the terms of `summary.json` where they exist.

use std::collections::BTreeMap;
use std::time::{SystemTime, UNIX_EPOCH};

use serde::Serialize;

use super::map_cache::ChannelStatus;
use super::stage_rates::StageRate;
use crate::calibration::Completeness;
use crate::downlink::ReceptionCounters;
use crate::downlink::transport::packet_archive::ArchiveReport;
use crate::downlink::transport::socket::ListenReport;
use crate::frames::VisibilityReason;
use crate::ground::SavingReport;
use crate::products::ProductsReport;
use crate::runtime::{LedgerReport, StageProgress, TimingSummary};

/// Now, in seconds since 1970-01-01 UTC.
pub(super) fn unix_s() -> f64 {
    SystemTime::now().duration_since(UNIX_EPOCH).map_or(0.0, |since| since.as_secs_f64())
}

/// Phase of a run.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub(super) enum Phase {
    /// The run is being prepared.
    #[default]
    Starting,
    Running,
    /// The run is complete or was cancelled.
    Ended,
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

/// Status of the input queue of a stage.
#[derive(Clone, Copy, Debug, Serialize)]
pub(super) struct QueueStatus {
    pub(super) capacity: usize,
    pub(super) depth: usize,
    depth_max: usize,
}

/// Status of a stage.
#[derive(Clone, Debug, Serialize)]
pub(super) struct StageStatus {
    pub(super) name: String,
    pub(super) items_in: u64,
    pub(super) items_out: u64,
    pub(super) units: u64,
    pub(super) unit: &'static str,
    /// Units per second over the last seconds, or over the whole run after its end.
    units_per_s: f64,
    /// Fraction of that time in which the stage worked.
    pub(super) busy: f64,
    pub(super) ended: bool,
    pub(super) queue: Option<QueueStatus>,
    working: TimingSummary,
    since_source: TimingSummary,
}

/// Status of the stages. The input of a stage is the output of the one before it in the list.
pub(super) fn stages_of(progress: &[StageProgress], rates: &[StageRate]) -> Vec<StageStatus> {
    let items_before = |k: usize| k.checked_sub(1).map_or(0, |before| progress[before].items_out);
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
            // The counters of two threads are not read at the same instant, hence the limits.
            depth: (items_before(k).saturating_sub(stage.items_in) as usize).min(capacity),
            depth_max: stage.queue_depth_max,
        }),
        working: stage.working.summary(),
        since_source: stage.since_source.summary(),
    };
    progress.iter().zip(rates).enumerate().map(stage).collect()
}

/// Status of the solution in progress.
#[derive(Clone, Debug, Serialize)]
pub(super) struct SolverStatus {
    pub(super) what: String,
    pub(super) iteration: usize,
    pub(super) residual: f64,
    pub(super) target: f64,
    /// Estimated time left, s, if the residual keeps falling at the same rate.
    pub(super) left_s: Option<f64>,
}

/// The ledger of visibilities so far. `sampled` and `unaccounted` are null until the end of a run.
#[derive(Clone, Debug)]
pub(super) struct LedgerStatus {
    pub(super) report: LedgerReport<VisibilityReason>,
    /// Number of sampled visibilities, and of those without an entry, which is zero if the ledger balances.
    pub(super) sampled: Option<(u64, i128)>,
}

impl LedgerStatus {
    /// The status of a ledger; `is_over`: the run has ended.
    pub(super) fn new(report: LedgerReport<VisibilityReason>, is_over: bool) -> Self {
        let sampled = is_over.then(|| (report.sampled, report.unaccounted()));
        Self { report, sampled }
    }
}

impl Serialize for LedgerStatus {
    fn serialize<S: serde::Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        let mut fields = serde_json::to_value(&self.report).map_err(serde::ser::Error::custom)?;
        fields["sampled"] = self.sampled.map(|(sampled, _)| sampled).into();
        fields["unaccounted"] =
            self.sampled.and_then(|(_, unaccounted)| i64::try_from(unaccounted).ok()).into();
        fields.serialize(serializer)
    }
}

/// Status of the senders.
#[derive(Clone, Debug, Serialize)]
pub(super) struct ListenerStatus {
    pub(super) open: usize,
    /// Bytes read from all senders.
    pub(super) bytes: u64,
    /// Bytes read that the ground segment has not processed yet.
    pub(super) backlog_bytes: u64,
    /// Time since the last valid packet from any sender, s; null before the first of this session.
    pub(super) silence_s: Option<f64>,
    /// Time since the last valid packet from each station, s; null before the first of this session.
    pub(super) station_silence_s: BTreeMap<String, Option<f64>>,
    pub(super) archive: Option<ArchiveReport>,
    /// Counters of connections, datagrams and stations.
    pub(super) report: ListenReport,
}

/// Counters of HTTP connections and requests.
#[derive(Clone, Copy, Debug, Default, Serialize)]
pub(super) struct VisitorStatus {
    pub(super) open: u64,
    pub(super) refused: u64,
    /// Connections closed by the server because they were silent, slow or not HTTP.
    pub(super) cut: u64,
    pub(super) requests: u64,
}

#[derive(Clone, Debug, Serialize)]
pub(super) struct Status {
    pub(super) version: &'static str,
    pub(super) name: String,
    /// Part of the chain that runs: `whole`, `ground` or `space`.
    pub(super) segment: &'static str,
    pub(super) phase: Phase,
    /// Why the run failed.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(super) error: Option<String>,
    pub(super) cancelled: bool,
    /// Time of this status, seconds since 1970-01-01 UTC.
    pub(super) unix_s: f64,
    pub(super) up_s: f64,
    /// Time from the server's start to the end of the run, or until now, s.
    pub(super) elapsed_s: f64,
    pub(super) stages: Vec<StageStatus>,
    pub(super) solving: Option<SolverStatus>,
    pub(super) ledger: Option<LedgerStatus>,
    /// Whether the ledger is complete; null until the end of a run.
    pub(super) completeness: Option<Completeness>,
    pub(super) reception: Option<ReceptionCounters>,
    /// Bytes of visibilities that wait for their positions.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(super) waiting_bytes: Option<u64>,
    /// Number of bursts of point sources found, in any session; `None` where they are not looked for.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(super) bursts: Option<u64>,
    /// Number of alerts of bursts before their passes ended, in this session.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(super) burst_alerts: Option<u64>,
    /// Number of further ones, counted only, as their passes had had eight in their channels.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(super) burst_alerts_untold: Option<u64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(super) listening: Option<ListenerStatus>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(super) saving: Option<SavingReport>,
    /// State of the product files, if a failure to write them does not end the run.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(super) products: Option<ProductsReport>,
    pub(super) channels: Vec<ChannelStatus>,
    pub(super) has_state: bool,
    pub(super) visitors: VisitorStatus,
}
