//! Running pipelines: the whole chain, the space segment alone, the ground segment alone.

use std::path::Path;
use std::sync::{Arc, PoisonError};
use std::time::Duration;

use super::config::Config;
use super::error::PipelineError;
use super::ground::{self, GroundOutcome};
use super::plan::Plan;
use super::sample_summary::SampleSummary;
use super::sampling::SampleCounts;
use super::space;
use super::state::Keeper;
use super::summary::{Segment, Summary};
use crate::accumulation::EngineKind;
use crate::downlink::link::LinkStage;
use crate::downlink::{FileSource, Format, Recorder};
use crate::products::{ProductsError, Truth, write_autos};
use crate::runtime::{Cancel, Graph, Link, Metrics, Report, RuntimeConfig};
use crate::solve::SolveWatch;

/// What can be watched of a graph while it runs.
#[derive(Clone, Debug)]
pub struct Watched {
    /// Counters and times of its stages.
    pub metrics: Arc<Metrics>,
    /// The solution that is being worked on.
    pub solving: SolveWatch,
}

/// Whom to tell about a graph that is about to run.
pub type Watcher<'a> = &'a mut dyn FnMut(Watched);

/// Name of the downlink file that `run` leaves among its products, by its format.
#[must_use]
pub fn downlink_file(format: Format) -> &'static str {
    match format {
        Format::Packets => "downlink.ccsds",
        Format::Cadu => "downlink.cadu",
    }
}

/// The whole chain in one process: sky, spacecraft, downlink bytes, ground, products in `out`.
///
/// # Errors
/// The first failure of any stage; a ledger that does not close.
pub fn run(plan: &Plan, out: &Path, cancel: &Cancel, watch: Watcher<'_>) -> Result<Summary, PipelineError> {
    make_folder(out)?;
    let skies = space::skies(plan)?;
    let mut graph = Graph::new();
    let counts = SampleCounts::default();
    let bytes = space::add(&mut graph, plan, &skies, &counts)?;
    let file = out.join(downlink_file(plan.config.downlink.format));
    let bytes = add_link(&mut graph, bytes, &plan.config, &file)?;
    let recorder = Recorder::create(&file)?;
    let capacity = plan.config.runtime.queue_capacity;
    let bytes = graph.stage("record", capacity, bytes, recorder);
    let map = &plan.config.map;
    let truth = match map.engine {
        EngineKind::Harmonic => Truth::band_limited(&skies, map.nside, map.degree())?,
        _ => Truth::new(&skies, map.nside)?,
    };
    drop(skies);
    let solving = SolveWatch::new(cancel.clone());
    let outcome = ground::add(&mut graph, bytes, &plan.config, out, (truth, solving.clone()), None)?;
    let report = start(graph, &plan.config.runtime, (cancel, solving), watch)?;
    conclude(Segment::Whole, &plan.config, Some(out), report, (outcome, counts.close(plan)?))
}

/// The space segment alone, to a downlink file.
///
/// # Errors
/// The first failure of any stage.
pub fn simulate(
    plan: &Plan,
    file: &Path,
    cancel: &Cancel,
    watch: Watcher<'_>,
) -> Result<Report, PipelineError> {
    let skies = space::skies(plan)?;
    let mut graph = Graph::new();
    let counts = SampleCounts::default();
    let bytes = space::add(&mut graph, plan, &skies, &counts)?;
    drop(skies);
    let bytes = add_link(&mut graph, bytes, &plan.config, file)?;
    graph.sink("record", bytes, Recorder::create(file)?);
    let report = start(graph, &plan.config.runtime, (cancel, SolveWatch::default()), watch)?;
    counts.close(plan)?;
    Ok(report)
}

/// The ground segment alone, from downlink files; with a `keeper`, on top of what it holds.
///
/// # Errors
/// A file that cannot be read; the first failure of any stage.
pub fn replay(
    files: FileSource,
    config: &Config,
    keeper: Option<Keeper>,
    out: &Path,
    cancel: &Cancel,
    watch: Watcher<'_>,
) -> Result<Summary, PipelineError> {
    make_folder(out)?;
    let mut graph = Graph::new();
    let bytes = graph.source("read", config.runtime.queue_capacity, files);
    let solving = SolveWatch::new(cancel.clone());
    let outcome = ground::add(&mut graph, bytes, config, out, (Truth::unknown(), solving.clone()), keeper)?;
    let report = start(graph, &config.runtime, (cancel, solving), watch)?;
    conclude(Segment::Ground, config, Some(out), report, (outcome, None))
}

/// The link's faults, if any are asked for; the truth about them goes beside the downlink file.
fn add_link(
    graph: &mut Graph,
    bytes: Link<Vec<u8>>,
    config: &Config,
    file: &Path,
) -> Result<Link<Vec<u8>>, PipelineError> {
    Ok(match LinkStage::new(&config.downlink, config.seed, file)? {
        Some(link) => graph.stage("link", config.runtime.queue_capacity, bytes, link),
        None => bytes,
    })
}

/// Before anything is computed, so that a bad place is known at once.
fn make_folder(out: &Path) -> Result<(), PipelineError> {
    let made = std::fs::create_dir_all(out);
    made.map_err(|source| ProductsError::Write { path: out.to_owned(), source }.into())
}

fn start(
    mut graph: Graph,
    config: &RuntimeConfig,
    (cancel, solving): (&Cancel, SolveWatch),
    watch: Watcher<'_>,
) -> Result<Report, PipelineError> {
    if config.stall_s > 0.0 {
        graph.fail_after_stall(Duration::from_secs_f64(config.stall_s));
    }
    watch(Watched { metrics: graph.metrics(), solving });
    Ok(graph.run(cancel, Duration::from_secs_f64(config.shutdown_s))?)
}

fn conclude(
    segment: Segment,
    config: &Config,
    out: Option<&Path>,
    report: Report,
    (outcome, samples): (GroundOutcome, Option<SampleSummary>),
) -> Result<Summary, PipelineError> {
    let reception = outcome.reception.lock().unwrap_or_else(PoisonError::into_inner).clone();
    let channels = outcome.channels.lock().unwrap_or_else(PoisonError::into_inner).clone();
    let ledger = outcome.ledger.close()?;
    if let Some(out) = out {
        let mut autos = outcome.autos.lock().unwrap_or_else(PoisonError::into_inner);
        write_autos(&mut autos, out, config.products.pictures)?;
    }
    let summary = Summary { samples, ..Summary::new(segment, config, report, ledger, reception, channels) };
    if let Some(out) = out {
        summary.write(out)?;
    }
    Ok(summary)
}

/// Gives this process as many worker threads as the configuration says; once, before anything runs.
///
/// # Errors
/// Threads that cannot be started, or a number other than the one that the process already has.
pub fn use_threads(config: &RuntimeConfig) -> Result<(), PipelineError> {
    let threads = config.threads;
    let built = rayon::ThreadPoolBuilder::new().num_threads(threads).build_global();
    match built {
        Err(error) if threads != 0 && threads != rayon::current_num_threads() => {
            Err(PipelineError::Threads { threads, reason: error.to_string() })
        }
        _ => Ok(()),
    }
}
