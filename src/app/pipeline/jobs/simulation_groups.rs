//! Simulation of channels in groups, to save memory: each group goes to a spool file beside the downlink, and these are merged into
//! the downlink. Its bytes are the same as without groups.

use std::fs;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use super::event::{JobEvent, JobWatcher};
use super::step::{Outcome, Step, key_of};
use crate::downlink::Recorder;
use crate::imaging::ChannelGroup;
use crate::mother::{Merger, SpoolReader, SpoolWriter};
use crate::pipeline::config::{PipelineError, Plan};
use crate::pipeline::graph::run;
use crate::pipeline::graph::{RunView, space_segment};
use crate::products::ProductsError;
use crate::runtime::{Cancel, Graph, Report};
use crate::sky::SkyMap;
use crate::units::ChannelId;

/// Name of the stage that writes a group's visibilities to its spool file.
const SPOOL: &str = "spool";
/// Name of the source that merges the spool files into frames, window by window.
pub const MERGE: &str = "merge";

impl Plan {
    fn spool_key(&self) -> u64 {
        key_of(format!("{} {:016x}", env!("CARGO_PKG_VERSION"), self.config.space_hash()))
    }
}

fn spool_path(file: &Path, group: &ChannelGroup) -> PathBuf {
    let number = |channel: Option<&ChannelId>| channel.map_or(0, |channel| channel.0);
    let mut name = file.as_os_str().to_owned();
    name.push(format!(".channels-{}-{}.spool", number(group.first()), number(group.last())));
    name.into()
}

/// Simulates a downlink file group by group; see [`simulate`](crate::pipeline::simulate).
///
/// Spool files of an earlier call that was cancelled are reused. They are removed once the downlink is complete. `watch` receives
/// each step before it runs. Returns the report of each group that was simulated, and of the downlink; the last report tells whether
/// the call was cancelled.
///
/// # Errors
/// The first failure of any stage; another process that simulates into the same file.
pub fn simulate_in_groups(
    plan: &Plan,
    groups: &[ChannelGroup],
    file: &Path,
    cancel: &Cancel,
    watch: JobWatcher<'_>,
) -> Result<Vec<Report>, PipelineError> {
    let key = plan.spool_key();
    run::write_truth(plan, file)?;
    // An unwritable path is reported before anything is computed.
    let recorder = Recorder::create(file)?;
    let mut reports = Vec::new();
    for (number, group) in groups.iter().enumerate() {
        let path = spool_path(file, group);
        let outcome = Step::Spool(&path, key).run(|| {
            let writer = SpoolWriter::create(&path, key, plan.windows.len())?;
            let mut graph = Graph::new();
            let mut sky = |channel: ChannelId| {
                watch(JobEvent::Sky(channel), None);
                space_segment::sky(plan, channel)
            };
            let skies: Vec<Option<SkyMap>> = (0..plan.schedules.len())
                .map(|channel| ChannelId(channel as u16))
                .map(|channel| group.contains(&channel).then(|| sky(channel)).transpose())
                .collect::<Result<_, _>>()?;
            let present: Vec<Option<&SkyMap>> = skies.iter().map(Option::as_ref).collect();
            let frames = space_segment::add_integration(&mut graph, plan, &present)?;
            drop(skies);
            graph.sink(SPOOL, frames, writer);
            watch(JobEvent::Simulate(number), Some(RunView::without_ground(&graph)));
            let report = run::run_graph_alone(graph, &plan.config.runtime, cancel)?;
            let outcome = Outcome::of(report.cancelled);
            reports.push(report);
            Ok(outcome)
        })?;
        if outcome.is_cancelled() {
            return Ok(reports);
        }
    }
    let open = |group: &ChannelGroup| {
        let path = spool_path(file, group);
        // The file existed, or has just been written.
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
    let bytes = space_segment::add_downlink(&mut graph, plan, frames)?;
    let bytes = run::add_link(&mut graph, bytes, &plan.config, file)?;
    graph.sink(run::RECORD, bytes, recorder);
    watch(JobEvent::Merge, Some(RunView::without_ground(&graph)));
    let report = run::run_graph_alone(graph, &plan.config.runtime, cancel)?;
    if !report.cancelled {
        remove_spools(groups, file)?;
    }
    reports.push(report);
    Ok(reports)
}

fn remove_spools(groups: &[ChannelGroup], file: &Path) -> Result<(), PipelineError> {
    for group in groups {
        let path = spool_path(file, group);
        fs::remove_file(&path).map_err(ProductsError::write(&path))?;
    }
    Ok(())
}
