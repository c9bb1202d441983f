//! Maps of many channels in groups, to save memory: the downlink is read once per group, and only the sums of its channels are in
//! memory.
//!
//! The maps and the ledger are identical to those of mapping all channels in one run. After a cancellation, the same call resumes
//! with the next group.

use std::cell::RefCell;
use std::fs;
use std::path::{Path, PathBuf};
use std::time::SystemTime;

use super::event::{JobEvent, JobWatcher, MapStep};
use super::simulation_groups::simulate_in_groups;
use super::step::{Outcome, Step, key_of};
use crate::downlink::FileSource;
use crate::ground::{Collector, Ground, GroundConfig, WAIT_BYTES};
use crate::imaging::ChannelGroup;
use crate::imaging::circle::SumPart;
use crate::pipeline::config::{Config, MemoryLimit, PipelineError, Plan};
use crate::pipeline::cost::{GroupSize, MapGroup, RunGroups, map_groups};
use crate::pipeline::graph::finish::{FinishedGraph, collect_summary, write_summary};
use crate::pipeline::graph::ground_segment::SOLVE;
use crate::pipeline::graph::run::{lock_products, run_ground, write_settings};
use crate::pipeline::graph::summary::GroupRecord;
use crate::pipeline::graph::{RunScope, RunSummary, downlink_file, space_segment};
use crate::products::Truth;
use crate::runtime::Cancel;

/// Divides the channels of the instrument that `files` describe into groups, in order.
///
/// The length of the mission is unknown, so the memory of the harmonic engine is estimated for its full size.
///
/// # Errors
/// A file that cannot be read twice; no description of the instrument; settings that do not fit it; a single channel whose sums do
/// not fit into memory.
pub fn channel_groups(
    files: &[PathBuf],
    config: &Config,
    size: GroupSize,
    limit: Option<MemoryLimit>,
) -> Result<Vec<MapGroup>, PipelineError> {
    if let Some(path) = files.iter().find(|path| !path.is_file()) {
        return Err(PipelineError::NotRepeatable { path: path.clone() });
    }
    let mut instrument = None;
    for path in files {
        instrument = Collector::instrument_of(path)?;
        if instrument.is_some() {
            break;
        }
    }
    let Some(instrument) = instrument else {
        let path = files.first().cloned().unwrap_or_default();
        return Err(PipelineError::NoInstrument { path });
    };
    let settings = config.ground(WAIT_BYTES);
    settings.fits(&instrument)?;
    map_groups(&settings.described(&instrument)?, config, size, limit)
}

/// Replays files group by group; see [`replay`](crate::pipeline::replay).
///
/// If it is cancelled, the maps of completed groups are kept, and those of the interrupted group only if it is the first. A later
/// call with the same files, settings and folder resumes with the next group.
///
/// # Errors
/// As [`replay`](crate::pipeline::replay); files that change between readings.
pub fn replay_in_groups(
    files: &[PathBuf],
    config: &Config,
    groups: &[MapGroup],
    out: &Path,
    cancel: &Cancel,
    watch: JobWatcher<'_>,
) -> Result<RunSummary, PipelineError> {
    let _lock = lock_products(config, out)?;
    let job = GroupedReplay { scope: RunScope::Ground, files, config, groups, out };
    let summary = job.run(&|_| Ok(Truth::unknown()), cancel, watch)?;
    write_summary(summary, out)
}

/// A replay of the same files for each group of channels.
struct GroupedReplay<'a> {
    scope: RunScope,
    files: &'a [PathBuf],
    config: &'a Config,
    groups: &'a [MapGroup],
    out: &'a Path,
}

impl GroupedReplay<'_> {
    /// Maps the groups that no earlier call has mapped; returns the merged summary.
    fn run(
        &self,
        truth: &dyn Fn(&ChannelGroup) -> Result<Truth, PipelineError>,
        cancel: &Cancel,
        watch: JobWatcher<'_>,
    ) -> Result<RunSummary, PipelineError> {
        let Self { scope, config, groups, out, .. } = *self;
        let mut done: Vec<GroupRecord> = Vec::new();
        let mut last: Option<RunSummary> = None;
        for (number, MapGroup { channels: group, parts }) in groups.iter().enumerate() {
            let (path, key) = (out.join(record_name(group)), self.resume_key(group));
            let is_last = number + 1 == groups.len();
            // The last group is always read, as its report goes into the summary.
            if let Some(record) = GroupRecord::read(&path, key, out).filter(|_| !is_last) {
                done.push(record);
                continue;
            }
            let finished =
                self.read_group(MapStep { number, part: 0, parts: *parts }, truth, cancel, watch)?;
            let (autocorrelations, is_incomplete) =
                (finished.autocorrelation_count(), finished.is_incomplete);
            let mut reading = collect_summary(scope, config, out, finished)?;
            if number > 0 {
                // Each reading accumulates the auto-correlations of all channels; only those of the first count.
                reading.ledger.accumulated = reading.ledger.accumulated.saturating_sub(autocorrelations);
            }
            let is_cancelled = reading.cancelled;
            let is_cut =
                is_incomplete || reading.channels.iter().any(|channel| channel.interrupted.is_some());
            if is_cut && let Some(before) = done.pop() {
                // The maps of this group hold less data than those of earlier groups, so the ledgers could not be merged.
                reading.channels.iter().flat_map(|channel| &channel.files).for_each(|file| {
                    let _ = fs::remove_file(out.join(file));
                });
                (reading.ledger, reading.channels) = (before.ledger, before.channels);
            }
            let sampled = done.last().map(|before| before.ledger.sampled);
            if let Some(before) = sampled.filter(|before| *before != reading.ledger.sampled) {
                return Err(PipelineError::FilesChanged { before, now: reading.ledger.sampled });
            }
            if let Some(before) = last.take() {
                reading.earlier_reports = before.earlier_reports;
                reading.earlier_reports.push(before.report);
            }
            if !is_cut && !is_last {
                let record = GroupRecord::new(&reading, out)?;
                record.write(&path, key)?;
                if is_cancelled {
                    // Maps of an earlier run stay for the groups that are left.
                    reading.report.cut.push(SOLVE.to_owned());
                } else {
                    done.push(record);
                }
            }
            last = Some(reading);
            if is_cancelled {
                break;
            }
        }
        let Some(mut summary) = last else {
            return Err(PipelineError::NotInGroups { found: "no channel", expected: "at least one" });
        };
        for record in done.into_iter().rev() {
            summary = summary.merged_with_earlier(record, config.calibration.bursts);
        }
        if !summary.cancelled {
            // All groups are mapped: a repeated command computes everything anew.
            groups.iter().for_each(|group| {
                let _ = fs::remove_file(out.join(record_name(&group.channels)));
            });
        }
        Ok(summary)
    }

    /// Reads the files for one group, once for each part of its sums; the last reading makes the maps.
    fn read_group(
        &self,
        mut step: MapStep,
        truth: &dyn Fn(&ChannelGroup) -> Result<Truth, PipelineError>,
        cancel: &Cancel,
        watch: JobWatcher<'_>,
    ) -> Result<FinishedGraph, PipelineError> {
        let Self { files, config, groups, out, .. } = *self;
        let group = &groups[step.number].channels;
        let mut part = (step.parts > 1).then(|| SumPart::first(step.parts, out));
        loop {
            let next = part.as_ref().and_then(SumPart::next);
            let settings =
                GroundConfig { group: Some(group.clone()), part: part.take(), ..config.ground(WAIT_BYTES) };
            let (source, ground) = (FileSource::open(files)?, Ground::new(&settings)?);
            let truth = if next.is_some() { Truth::unknown() } else { truth(group)? };
            let mut on_start = |view| watch(JobEvent::Map(step), Some(view));
            let finished = run_ground(truth, source, config, ground, out, cancel, &mut on_start)?;
            if next.is_none() || cancel.is_cancelled() {
                return Ok(finished);
            }
            part = next;
            step.part += 1;
        }
    }

    /// Hash of everything that must be unchanged for a cancelled call to be resumed.
    fn resume_key(&self, group: &ChannelGroup) -> u64 {
        let Self { files, config, .. } = self;
        let file = |path: &PathBuf| {
            let found = fs::metadata(path).ok();
            let modified = found.as_ref().and_then(|found| found.modified().ok());
            let since_1970 = modified.and_then(|time| time.duration_since(SystemTime::UNIX_EPOCH).ok());
            (path.clone(), found.map(|found| found.len()), since_1970)
        };
        let files: Vec<_> = files.iter().map(file).collect();
        let channels: Vec<u16> = group.iter().map(|channel| channel.0).collect();
        let hashes = (config.space_hash(), config.ground_hash());
        let version = env!("CARGO_PKG_VERSION");
        key_of(format!("{version} {hashes:?} {files:?} {channels:?} {:?}", config.products))
    }
}

/// Simulates the channels group by group, and then maps them group by group in `out`.
///
/// The products are identical to those of [`run`](crate::pipeline::run()), except for times and the number of readings in the summary.
/// Returns `None` if it was cancelled before the downlink was complete. After a cancellation the same call resumes: groups that are
/// simulated or mapped are kept.
///
/// # Errors
/// As [`run`](crate::pipeline::run()).
pub fn run_in_groups(
    plan: &Plan,
    groups: &RunGroups,
    out: &Path,
    cancel: &Cancel,
    watch: JobWatcher<'_>,
) -> Result<Option<RunSummary>, PipelineError> {
    let config = &plan.config;
    let _lock = lock_products(config, out)?;
    write_settings(config, out)?;
    let RunGroups { simulated, mapped } = groups;
    let file = out.join(downlink_file(config.downlink.format));
    let marker = out.join(SIMULATED);
    let outcome = Step::Downlink(marker.clone(), config, &file).run(|| {
        let reports = simulate_in_groups(plan, simulated, &file, cancel, watch)?;
        Ok(Outcome::of(reports.last().is_some_and(|report| report.cancelled)))
    })?;
    if outcome.is_cancelled() {
        return Ok(None);
    }
    let watch = RefCell::new(watch);
    let truth = |group: &ChannelGroup| {
        group.iter().try_fold(Truth::unknown(), |truth, &channel| {
            (watch.borrow_mut())(JobEvent::Sky(channel), None);
            Ok(truth.with(channel, &space_segment::sky(plan, channel)?, config.map_shape())?)
        })
    };
    let files = [file];
    let job = GroupedReplay { scope: RunScope::Whole, files: &files, config, groups: mapped, out };
    let summary = job.run(&truth, cancel, &mut |event, view| (watch.borrow_mut())(event, view))?;
    let summary = write_summary(summary, out)?;
    if !summary.cancelled {
        let _ = fs::remove_file(&marker);
    }
    Ok(Some(summary))
}

/// Name of the marker of a complete simulated downlink.
const SIMULATED: &str = ".simulated";

/// Name of the file that keeps the record of a mapped group.
fn record_name(group: &ChannelGroup) -> String {
    let channels: Vec<String> = group.iter().map(ToString::to_string).collect();
    let crc = crc_fast::checksum(crc_fast::CrcAlgorithm::Crc32Iscsi, channels.join(",").as_bytes());
    format!(".group-{crc:08x}")
}
