//! Simulation of more channels than memory has room for at a time: group by group to files beside the downlink, which is then made
//! of them. It has the same bytes as one of all channels at once.

use std::fs;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use super::group_steps::{GroupStep, GroupStepWatcher};
use crate::downlink::Recorder;
use crate::imaging::ChannelGroup;
use crate::mother::{Merger, SpoolReader, SpoolWriter};
use crate::pipeline::config::{PipelineError, Plan};
use crate::pipeline::graph::run;
use crate::pipeline::graph::{Watched, space_segment};
use crate::products::ProductsError;
use crate::runtime::{Cancel, Graph, Report};
use crate::sky::SkyMap;
use crate::units::ChannelId;

/// Name of the stage that puts visibilities aside.
const SPOOL: &str = "spool";
/// Name of the source that makes frames of what groups have left; it takes window by window.
pub const MERGE: &str = "merge";

impl Plan {
    /// Key by which stored visibilities are known to be of this plan.
    fn spool_key(&self) -> u64 {
        let text = format!("{} {:016x}", env!("CARGO_PKG_VERSION"), self.config.space_hash());
        crc_fast::checksum(crc_fast::CrcAlgorithm::Crc64Nvme, text.as_bytes())
    }
}

/// Where the visibilities of a group are put aside.
fn spool_path(file: &Path, group: &ChannelGroup) -> PathBuf {
    let end = |channel: Option<&ChannelId>| channel.map_or(0, |channel| channel.0);
    let mut name = file.as_os_str().to_owned();
    name.push(format!(".channels-{}-{}.spool", end(group.first()), end(group.last())));
    name.into()
}

/// As [`simulate`](crate::pipeline::simulate) to a file, group by group. Groups that an earlier call, which was cancelled, has put aside are
/// taken as they are; what was put aside is removed once the downlink is whole.
///
/// `watch` gets what is about to be done. The reports are of each that ran, and last of the downlink; the last one says whether all were cancelled.
///
/// # Errors
/// The first failure of any stage; another process that simulates to the same file.
pub fn simulate_in_groups(
    plan: &Plan,
    groups: &[ChannelGroup],
    file: &Path,
    cancel: &Cancel,
    watch: GroupStepWatcher<'_>,
) -> Result<Vec<Report>, PipelineError> {
    let key = plan.spool_key();
    run::write_instrument_truth(plan, file)?;
    // An unwritable place shows before anything is computed.
    let recorder = Recorder::create(file)?;
    let mut reports = Vec::new();
    for (number, group) in groups.iter().enumerate() {
        let path = spool_path(file, group);
        if SpoolReader::open(&path, key)?.is_some() {
            continue;
        }
        let writer = SpoolWriter::create(&path, key, plan.windows.len())?;
        let mut graph = Graph::new();
        let mut sky = |channel: ChannelId| {
            watch(GroupStep::Sky(channel), None);
            space_segment::sky(plan, channel)
        };
        let skies: Vec<Option<SkyMap>> = (0..plan.schedules.len())
            .map(|channel| ChannelId(channel as u16))
            .map(|channel| group.contains(&channel).then(|| sky(channel)).transpose())
            .collect::<Result<_, _>>()?;
        let present: Vec<Option<&SkyMap>> = skies.iter().map(Option::as_ref).collect();
        let frames = space_segment::integrate(&mut graph, plan, &present)?;
        drop(skies);
        graph.sink(SPOOL, frames, writer);
        let watched = Watched::of_space(&graph);
        let report = run::start_alone(graph, &plan.config.runtime, cancel, watched, &mut |watched| {
            watch(GroupStep::Simulated(number), Some(watched));
        })?;
        let is_cut = report.cancelled;
        reports.push(report);
        if is_cut {
            return Ok(reports);
        }
    }
    let open = |group: &ChannelGroup| {
        let path = spool_path(file, group);
        // It was there, or has just been written.
        SpoolReader::open(&path, key)?.ok_or(PipelineError::SpoolGone { path })
    };
    let spools = groups.iter().map(open).collect::<Result<Vec<_>, _>>()?;
    let mut graph = Graph::new();
    let merger = Merger::new(
        Arc::clone(&plan.array),
        plan.instrument.clone(),
        plan.windows.clone(),
        spools,
        plan.instrument_errors(),
    );
    let frames = graph.source(MERGE, plan.config.runtime.queue_capacity, merger);
    let bytes = space_segment::send(&mut graph, plan, frames)?;
    let bytes = run::add_link(&mut graph, bytes, &plan.config, file)?;
    graph.sink(run::RECORD, bytes, recorder);
    let watched = Watched::of_space(&graph);
    let report = run::start_alone(graph, &plan.config.runtime, cancel, watched, &mut |watched| {
        watch(GroupStep::Merged, Some(watched));
    })?;
    if !report.cancelled {
        remove_spools(groups, file)?;
    }
    reports.push(report);
    Ok(reports)
}

fn remove_spools(groups: &[ChannelGroup], file: &Path) -> Result<(), PipelineError> {
    for group in groups {
        let path = spool_path(file, group);
        fs::remove_file(&path).map_err(|source| ProductsError::Write { path, source })?;
    }
    Ok(())
}
