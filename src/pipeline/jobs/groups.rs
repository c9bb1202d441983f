//! Maps of many channels, group by group: the downlink is read once a group, so that the sums of a few channels are in memory
//! at a time. Maps and ledger are those of all channels at once. A group that is mapped stays mapped: a run that was cancelled goes
//! on with the next one.

use std::cell::RefCell;
use std::fs;
use std::path::{Path, PathBuf};
use std::time::SystemTime;

use super::group_steps::{GroupStep, GroupStepWatcher, MapStep};
use super::simulation_groups::simulate_in_groups;
use crate::downlink::FileSource;
use crate::files::write_atomically;
use crate::ground::{Collector, Ground, GroundConfig, WAIT_BYTES};
use crate::imaging::ChannelGroup;
use crate::imaging::circle::SumPart;
use crate::pipeline::config::{Config, MemoryLimit, PipelineError, Plan};
use crate::pipeline::cost::{GroupSize, MapGroup, RunGroups, groups_of};
use crate::pipeline::graph::run::{finish, ground_alone, lock_products, summarise, write_settings};
use crate::pipeline::graph::summary::GroupRecord;
use crate::pipeline::graph::{RunScope, RunSummary, Watched, downlink_file, space_segment};
use crate::products::{ProductsError, Truth};
use crate::runtime::Cancel;

/// Receives what is about to be read, and the handles of its graph, which is about to run.
pub type GroupWatcher<'a> = &'a mut dyn FnMut(MapStep, Watched);

/// Groups of the channels that the first of `files` describes, in their order.
///
/// Nothing is known of the length of the mission, so that the sums of the harmonic engine count as complete.
///
/// # Errors
/// A file that cannot be read twice, or describes no instrument; settings that do not fit it; a channel for which alone
/// there is too little memory.
pub fn channel_groups(
    files: &[PathBuf],
    config: &Config,
    size: GroupSize,
    limit: Option<MemoryLimit>,
) -> Result<Vec<MapGroup>, PipelineError> {
    if let Some(path) = files.iter().find(|path| !path.is_file()) {
        return Err(PipelineError::NotRepeatable { path: path.clone() });
    }
    let mut described = None;
    for path in files {
        described = Collector::instrument_of(path)?;
        if described.is_some() {
            break;
        }
    }
    let Some(described) = described else {
        let path = files.first().cloned().unwrap_or_default();
        return Err(PipelineError::NoInstrument { path });
    };
    let settings = config.ground(WAIT_BYTES);
    settings.fits(&described)?;
    groups_of(&settings.described(&described)?, config, size, limit)
}

/// As [`replay`](crate::pipeline::replay) of files, group by group. When it is cancelled, the maps of the groups before stay, and those
/// of a first group; a later call with the same files, settings and folder goes on with the next group.
///
/// # Errors
/// Those of a replay; files that change on the way.
pub fn replay_in_groups(
    files: &[PathBuf],
    config: &Config,
    groups: &[MapGroup],
    out: &Path,
    cancel: &Cancel,
    watch: GroupWatcher<'_>,
) -> Result<RunSummary, PipelineError> {
    let _lock = lock_products(config, out)?;
    let readings = GroupReadings { scope: RunScope::Ground, files, config, groups, out };
    let summary = readings.run(&|_| Ok(Truth::unknown()), cancel, watch)?;
    finish(summary, out)
}

/// Settings for maps, group by group, of the same files.
struct GroupReadings<'a> {
    scope: RunScope,
    files: &'a [PathBuf],
    config: &'a Config,
    groups: &'a [MapGroup],
    out: &'a Path,
}

impl GroupReadings<'_> {
    /// Maps the groups that no earlier call has.
    fn run(
        &self,
        truth: &dyn Fn(&ChannelGroup) -> Result<Truth, PipelineError>,
        cancel: &Cancel,
        watch: GroupWatcher<'_>,
    ) -> Result<RunSummary, PipelineError> {
        let Self { scope, files, config, groups, out } = *self;
        let mut done: Vec<GroupRecord> = Vec::new();
        let mut last: Option<RunSummary> = None;
        for (number, MapGroup { channels: group, parts }) in groups.iter().enumerate() {
            let (path, key) = (out.join(record_name(group)), self.key(group));
            let is_last = number + 1 == groups.len();
            // The summary is that of the last pass, which is always made.
            if let Some(record) = GroupRecord::read(&path, key, out).filter(|_| !is_last) {
                done.push(record);
                continue;
            }
            let mut step = MapStep { group: number, part: 0, parts: *parts };
            let mut part = (*parts > 1).then(|| SumPart::first(*parts, out));
            let ended = loop {
                let next = part.as_ref().and_then(SumPart::next);
                let settings = GroundConfig {
                    group: Some(group.clone()),
                    part: part.take(),
                    ..config.ground(WAIT_BYTES)
                };
                let (source, ground) = (FileSource::open(files)?, Ground::new(&settings)?);
                // Only with the last part there is a map.
                let truth = if next.is_some() { Truth::unknown() } else { truth(group)? };
                let mut watch = |watched| watch(step, watched);
                let ended = ground_alone(truth, source, config, ground, out, cancel, &mut watch)?;
                if next.is_none() || cancel.is_cancelled() {
                    break ended;
                }
                part = next;
                step.part += 1;
            };
            let powers = ended.powers();
            let mut pass = summarise(scope, config, out, ended)?;
            if number > 0 {
                // Each pass takes the auto-correlations of all channels; they count in the first.
                pass.ledger.accumulated = pass.ledger.accumulated.saturating_sub(powers);
            }
            let is_cut = pass.cancelled;
            if let Some(before) = done.pop_if(|_| is_cut) {
                // Its maps hold less data than those before, and no ledger could be common to both.
                pass.channels.iter().flat_map(|channel| &channel.files).for_each(|file| {
                    let _ = fs::remove_file(out.join(file));
                });
                (pass.ledger, pass.channels) = (before.ledger, before.channels);
            }
            let sampled = done.last().map(|before| before.ledger.sampled);
            if let Some(before) = sampled.filter(|before| *before != pass.ledger.sampled) {
                return Err(PipelineError::FilesChanged { before, now: pass.ledger.sampled });
            }
            if let Some(before) = last.take() {
                pass.earlier_reports = before.earlier_reports;
                pass.earlier_reports.push(before.report);
            }
            if !is_cut && !is_last {
                let record = GroupRecord::of(&pass, out)?;
                record.write(&path, key)?;
                done.push(record);
            }
            last = Some(pass);
            if is_cut {
                break;
            }
        }
        let Some(mut summary) = last else {
            return Err(PipelineError::NotInGroups { found: "no channel", expected: "at least one" });
        };
        for record in done.into_iter().rev() {
            summary = summary.after(record);
        }
        if !summary.cancelled {
            // Whoever repeats the command wants all of it again.
            groups.iter().for_each(|group| {
                let _ = fs::remove_file(out.join(record_name(&group.channels)));
            });
        }
        Ok(summary)
    }

    /// Calls with the same number can go on where one of them was cancelled.
    fn key(&self, group: &ChannelGroup) -> u64 {
        let Self { files, config, .. } = self;
        let file = |path: &PathBuf| {
            let found = fs::metadata(path).ok();
            let changed = found.as_ref().and_then(|found| found.modified().ok());
            let since = changed.and_then(|time| time.duration_since(SystemTime::UNIX_EPOCH).ok());
            (path.clone(), found.map(|found| found.len()), since)
        };
        let files: Vec<_> = files.iter().map(file).collect();
        let channels: Vec<u16> = group.iter().map(|channel| channel.0).collect();
        let hashes = (config.space_hash(), config.ground_hash());
        let text =
            format!("{} {hashes:?} {files:?} {channels:?} {:?}", env!("CARGO_PKG_VERSION"), config.products);
        crc_fast::checksum(crc_fast::CrcAlgorithm::Crc64Nvme, text.as_bytes())
    }
}

/// Simulates the channels and maps them in `out`, group by group: first all visibilities, then the maps.
///
/// Leaves the products of [`run`](crate::pipeline::run()), byte for byte but for times and the number of readings in the summary; `None` if it was cancelled
/// before there was a downlink. After a cancellation the same call goes on: groups that are simulated or mapped stay as they are.
///
/// # Errors
/// Those of a run.
pub fn run_in_groups(
    plan: &Plan,
    groups: &RunGroups,
    out: &Path,
    cancel: &Cancel,
    watch: GroupStepWatcher<'_>,
) -> Result<Option<RunSummary>, PipelineError> {
    let config = &plan.config;
    let _lock = lock_products(config, out)?;
    write_settings(config, out)?;
    let RunGroups { simulated, mapped } = groups;
    let file = out.join(downlink_file(config.downlink.format));
    let marker = out.join(SIMULATED);
    let is_made = |key: String| fs::read(&marker).is_ok_and(|found| found == key.as_bytes());
    if !is_made(downlink_key(plan, &file)) {
        let reports = simulate_in_groups(plan, simulated, &file, cancel, watch)?;
        if reports.last().is_some_and(|report| report.cancelled) {
            return Ok(None);
        }
        write_atomically(&marker, downlink_key(plan, &file).as_bytes())
            .map_err(|source| ProductsError::Write { path: marker.clone(), source })?;
    }
    let watch = RefCell::new(watch);
    let truth = |group: &ChannelGroup| {
        group.iter().try_fold(Truth::unknown(), |truth, &channel| {
            (watch.borrow_mut())(GroupStep::Sky(channel), None);
            Ok(truth.with(channel, &space_segment::sky(plan, channel)?, config.map_shape())?)
        })
    };
    let files = [file];
    let readings = GroupReadings { scope: RunScope::Whole, files: &files, config, groups: mapped, out };
    let summary = readings.run(&truth, cancel, &mut |step, watched| {
        (watch.borrow_mut())(GroupStep::Mapped(step), Some(watched));
    })?;
    let summary = finish(summary, out)?;
    if !summary.cancelled {
        let _ = fs::remove_file(&marker);
    }
    Ok(Some(summary))
}

/// Name of the file that says that the downlink of a run in groups is whole, and of what.
const SIMULATED: &str = ".simulated";

/// Key and length of a downlink.
fn downlink_key(plan: &Plan, file: &Path) -> String {
    let config = &plan.config;
    let bytes = fs::metadata(file).map_or(0, |found| found.len());
    format!("{} {:016x} {:?} {bytes}", env!("CARGO_PKG_VERSION"), config.space_hash(), config.downlink)
}

/// Name of the file that keeps what a summary says of a group that is mapped.
fn record_name(group: &ChannelGroup) -> String {
    let channels: Vec<String> = group.iter().map(ToString::to_string).collect();
    let crc = crc_fast::checksum(crc_fast::CrcAlgorithm::Crc32Iscsi, channels.join(",").as_bytes());
    format!(".group-{crc:08x}")
}
