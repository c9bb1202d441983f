//! The end of a run: its results, their summary, and joint maps if it makes them.

use std::path::Path;
use std::sync::PoisonError;
use std::sync::atomic::Ordering;

use super::ground_segment::{SOLVE, SegmentOutcome};
use super::joint::JointData;
use super::live_gains::GainsWriter;
use super::sample_summary::SampleSummary;
use super::summary::{RunScope, RunSummary};
use crate::calibration::BurstSummary;
use crate::downlink::transport::socket::Listening;
use crate::frames::AutoPower;
use crate::imaging::{KeptSums, SolveWatch};
use crate::pipeline::config::{Config, PipelineError, Plan};
use crate::products::{WrittenProducts, write_autos};
use crate::ranks::Ranks;
use crate::runtime::{Cancel, Report};
use crate::units::vector::Vec3;

/// Results of a run that ended without a failure.
pub(in crate::pipeline) struct FinishedGraph {
    report: Report,
    outcome: SegmentOutcome,
    listening: Option<Listening>,
    samples: Option<SampleSummary>,
    /// Whether a signal ended its source, or left data or maps out.
    pub(in crate::pipeline) is_incomplete: bool,
}

impl FinishedGraph {
    /// The results of a graph without samples. A run is cancelled by any signal before this, also after its source had ended.
    pub(super) fn new(
        mut report: Report,
        outcome: SegmentOutcome,
        listening: Option<Listening>,
        cancel: &Cancel,
    ) -> Self {
        let left_data = outcome.ground.left_data.load(Ordering::Relaxed);
        let lacks_maps = || report.stage(SOLVE).is_some_and(|solve| solve.items_out < solve.items_in);
        let is_incomplete = report.cancelled || (cancel.is_cancelled() && (left_data || lacks_maps()));
        report.cancelled |= cancel.is_cancelled();
        Self { report, outcome, listening, samples: None, is_incomplete }
    }

    /// With the samples' statistics.
    pub(super) fn with_samples(self, samples: Option<SampleSummary>) -> Self {
        Self { samples, ..self }
    }

    /// Takes the total powers with their positions, if they were asked for.
    fn take_placed_autos(&self) -> Vec<(AutoPower, Vec3)> {
        let placed = self.outcome.ground.placed_autos.as_ref();
        placed.map_or_else(Vec::new, |placed| {
            std::mem::take(&mut placed.lock().unwrap_or_else(PoisonError::into_inner))
        })
    }

    pub(in crate::pipeline) fn autocorrelation_count(&self) -> u64 {
        self.outcome.ground.autos.lock().unwrap_or_else(PoisonError::into_inner).len() as u64
    }
}

/// Collects the summary of a run; the first rank writes it.
pub(super) fn collect_and_write_summary(
    segment: RunScope,
    ranks: &Ranks,
    config: &Config,
    out: &Path,
    finished: FinishedGraph,
) -> Result<RunSummary, PipelineError> {
    if ranks.is_distributed() && finished.is_incomplete {
        return Err(PipelineError::RankInterrupted);
    }
    if ranks.is_first() {
        let keeps_packets = finished.listening.as_ref().is_some_and(|listening| listening.archive.is_some());
        let written = write_summary(collect_summary(segment, config, out, finished)?, out);
        return written.map_err(|error| match error {
            PipelineError::Unsaved { summary, reason, .. } => {
                PipelineError::Unsaved { summary, reason, is_archived: keeps_packets }
            }
            error => error,
        });
    }
    let FinishedGraph { report, outcome, .. } = finished;
    let reception = outcome.ground.reception.lock().unwrap_or_else(PoisonError::into_inner).clone();
    let ledger = outcome.ground.ledger.balanced_report()?;
    Ok(RunSummary::new(segment, config, report, ledger, reception, Vec::new()))
}

/// Makes the joint maps of a run that was not interrupted, and collects and writes its summary.
pub(super) fn map_jointly(
    plan: &Plan,
    out: &Path,
    finished: FinishedGraph,
    sums: KeptSums,
    (cancel, watch): (&Cancel, &SolveWatch),
) -> Result<RunSummary, PipelineError> {
    let powers = finished.take_placed_autos();
    let mut summary = collect_summary(RunScope::Whole, &plan.config, out, finished)?;
    if summary.cancelled || summary.channels.is_empty() {
        return write_summary(summary, out);
    }
    // The maps of the channels are there, whatever becomes of the joint ones; those of an earlier run go.
    summary.write(out)?;
    match (JointData { sums, powers }).map(plan, out, cancel, watch) {
        Ok(found) => {
            summary.cancelled = found.is_none();
            summary.joint = found;
            write_summary(summary, out)
        }
        Err(error) => write_summary(summary, out).and(Err(error)),
    }
}

/// Collects the summary of a run, and writes the auto-correlations and gains.
pub(in crate::pipeline) fn collect_summary(
    segment: RunScope,
    config: &Config,
    out: &Path,
    finished: FinishedGraph,
) -> Result<RunSummary, PipelineError> {
    let FinishedGraph { report, outcome, listening, samples, .. } = finished;
    let SegmentOutcome { ground, written } = outcome;
    let mut reception = ground.reception.lock().unwrap_or_else(PoisonError::into_inner).clone();
    let WrittenProducts { channels, intermediate_files } =
        written.lock().unwrap_or_else(PoisonError::into_inner).clone();
    let ledger = ground.ledger.balanced_report()?;
    let listening = listening.map(|listening| listening.report());
    if let Some(report) = &listening {
        report.complete(&mut reception);
    }
    let mut autos = ground.autos.lock().unwrap_or_else(PoisonError::into_inner);
    write_autos(&mut autos, out, config.products.pictures)?;
    let mut summary = RunSummary::new(segment, config, report, ledger, reception, channels);
    summary.intermediate_files = intermediate_files;
    (summary.listening, summary.samples) = (listening, samples);
    summary.completeness = ground.completeness.lock().unwrap_or_else(PoisonError::into_inner).clone();
    summary.saving = ground.saving.report();
    let bursts = &ground.bursts;
    summary.bursts = BurstSummary::new(bursts.choice(), bursts.list(), bursts.searched());
    let gains = ground.gains.as_ref().map(|gains| GainsWriter::new(config, out).write(gains));
    summary.calibration = gains.transpose()?;
    Ok(summary)
}

/// Writes the summary of a run.
///
/// # Errors
/// A summary that cannot be written; a last checkpoint that could not be saved; no visibility for any map.
pub(in crate::pipeline) fn write_summary(
    summary: RunSummary,
    out: &Path,
) -> Result<RunSummary, PipelineError> {
    let path = summary.write(out)?;
    if let Some(reason) = summary.saving.as_ref().and_then(|saving| saving.unsaved.clone()) {
        return Err(PipelineError::Unsaved { summary: path, reason, is_archived: false });
    }
    if summary.channels.is_empty() && !summary.cancelled {
        return Err(PipelineError::NoMap { summary: path, ledger: Box::new(summary.ledger) });
    }
    Ok(summary)
}
