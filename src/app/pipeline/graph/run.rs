//! Running pipelines: the whole chain, the space segment alone, the ground segment alone.

use std::path::{Path, PathBuf};
use std::time::Duration;
use std::{fs, io};

use super::finish::{FinishedGraph, collect_and_write_summary, map_jointly};
use super::ground_segment::MappingContext;
use super::sample_summary::{SampleCounts, SampleSummary};
use super::summary::{RunScope, RunSummary};
use super::view::RunView;
use super::{ground_segment, space_segment};
use crate::downlink::link::LinkStage;
#[cfg(not(target_family = "wasm"))]
use crate::downlink::transport::socket::SocketSource;
use crate::downlink::transport::socket::{Listening, SocketError, SocketSink};
use crate::downlink::{DownlinkConfig, DownlinkError, FileSource, Format, PacedSource, Recorder};
use crate::files::FolderLock;
use crate::ground::{Ground, WAIT_BYTES};
use crate::imaging::{KeptSums, Method, SolveWatch};
use crate::pipeline::config::{Config, PipelineError, Plan, SETTINGS};
use crate::products::{JOINT, MapWatch, ProductsError, ProductsWatch, Truth, write_product};
use crate::ranks::Ranks;
use crate::runtime::{Cancel, Graph, Link, Report, RuntimeConfig, Source};
use crate::sky::SkyMap;

/// A source of downlink bytes.
pub trait GroundSource: Source<Out = Vec<u8>, Error = DownlinkError> {
    /// The senders, if the source listens on a socket.
    fn listening(&self) -> Option<Listening> {
        None
    }

    /// Whether the source runs until it is cancelled. If so, a failure to write maps does not end reception.
    fn is_service(&self) -> bool {
        false
    }
}

impl GroundSource for FileSource {
    fn is_service(&self) -> bool {
        self.is_followed()
    }
}

impl<S: GroundSource> GroundSource for PacedSource<S> {
    fn listening(&self) -> Option<Listening> {
        self.source().listening()
    }

    fn is_service(&self) -> bool {
        self.source().is_service()
    }
}

#[cfg(not(target_family = "wasm"))]
impl GroundSource for SocketSource {
    fn listening(&self) -> Option<Listening> {
        Some(SocketSource::listening(self))
    }

    fn is_service(&self) -> bool {
        true
    }
}

/// Destination of a simulated downlink.
#[derive(Debug, Default)]
pub struct Destination {
    /// A file.
    pub file: Option<PathBuf>,
    /// Whether to write to standard output if there is no file.
    pub standard_output: bool,
    /// A connection to a listening ground segment.
    pub socket: Option<SocketSink>,
}

impl<P: AsRef<Path>> From<&P> for Destination {
    fn from(file: &P) -> Self {
        Self { file: Some(file.as_ref().to_owned()), ..Self::default() }
    }
}

/// Callback that receives the handles of a graph once, just before it runs.
pub type OnStart<'a> = &'a mut dyn FnMut(RunView);

/// Name of the stage that reads the downlink.
pub const READ: &str = "read";

pub(in crate::pipeline) const RECORD: &str = "record";

/// Name of the downlink file among the products of `run`.
#[must_use]
pub fn downlink_file(format: Format) -> &'static str {
    match format {
        Format::Packets => "downlink.ccsds",
        Format::Cadu => "downlink.cadu",
    }
}

/// Paths of the products of a run that do not depend on its data.
#[must_use]
#[doc(hidden)]
pub fn main_products(config: &Config, out: &Path) -> Vec<PathBuf> {
    [downlink_file(config.downlink.format), SETTINGS, "summary.json"].map(|name| out.join(name)).into()
}

/// Runs the whole chain in one process: sky, spacecraft, downlink, ground segment, products in `out`.
///
/// # Errors
/// The first failure of any stage; a ledger that does not balance; no visibility for any map.
pub fn run(
    plan: &Plan,
    out: &Path,
    cancel: &Cancel,
    on_start: OnStart<'_>,
) -> Result<RunSummary, PipelineError> {
    run_with_ranks(&Ranks::single(), plan, out, cancel, on_start)
}

/// Runs the whole chain as one of several MPI ranks that share the normal equations.
///
/// Each rank simulates and receives everything. Only the first writes into `out` and has maps in its summary. A rank that is
/// interrupted or fails has to end the job.
///
/// # Errors
/// As [`run`]; settings with which the normal equations cannot be shared.
pub fn run_with_ranks(
    ranks: &Ranks,
    plan: &Plan,
    out: &Path,
    cancel: &Cancel,
    on_start: OnStart<'_>,
) -> Result<RunSummary, PipelineError> {
    plan.config.require_shareable_run(ranks.share().count)?;
    let DownlinkConfig { link, rate_bits_per_s_max, .. } = &plan.config.downlink;
    if ranks.is_distributed() && (link.is_on() || *rate_bits_per_s_max > 0.0) {
        let found = "downlink.link with faults, or downlink.rate_bits_per_s_max";
        return Err(PipelineError::NotShareable {
            found,
            expected: "neither: simulate first, then replay --mpi",
        });
    }
    let _lock = ranks.is_first().then(|| lock_products(&plan.config, out)).transpose()?;
    let file = out.join(downlink_file(plan.config.downlink.format));
    let recorder = if ranks.is_first() {
        write_settings(&plan.config, out)?;
        write_truth(plan, &file)?;
        Some(Recorder::create(&file)?)
    } else {
        None
    };
    let skies = space_segment::skies(plan)?;
    let mut graph = Graph::new();
    let counts = SampleCounts::default();
    let bytes = space_segment::add(&mut graph, plan, &skies, &counts)?;
    let mut bytes = add_link(&mut graph, bytes, &plan.config, &file)?;
    if let Some(recorder) = recorder {
        bytes = graph.stage(RECORD, plan.config.runtime.queue_capacity, bytes, recorder);
    }
    let truth = Truth::new(&skies, plan.config.map_shape())?;
    drop(skies);
    let grace = Grace::new(&plan.config.runtime);
    let solving = SolveWatch::new(cancel.clone()).with_grace(grace.iterate);
    let ground =
        Ground::new(&plan.config.ground(WAIT_BYTES))?.with_cancel(cancel, grace.accumulate).with_ranks(ranks);
    let kept = plan.config.joint.on.then(KeptSums::default);
    let joint_sums = kept.clone();
    let ground = if kept.is_some() { ground.with_placed_autos() } else { ground };
    let maps = MapWatch::default();
    let mapping = MappingContext {
        out,
        truth,
        watch: solving.clone(),
        viewers: maps.clone(),
        product_state: None,
        kept,
    };
    let outcome = ground_segment::add(&mut graph, bytes, &plan.config, ground, mapping)?;
    let handles = RunView {
        metrics: graph.metrics(),
        solving: solving.clone(),
        listening: None,
        ground: Some(outcome.ground.clone()),
        maps,
        products: None,
    };
    on_start(handles);
    let report = run_graph(graph, ranks, &plan.config.runtime, cancel)?;
    let samples = sample_summary(&counts, plan, &report)?;
    let finished = FinishedGraph::new(report, outcome, None, cancel).with_samples(samples);
    if let Some(sums) = joint_sums {
        return map_jointly(plan, out, finished, sums, (cancel, &solving));
    }
    collect_and_write_summary(RunScope::Whole, ranks, &plan.config, out, finished)
}

/// Runs the space segment alone; its downlink goes to a file, a listening ground segment, or both.
///
/// # Errors
/// The first failure of any stage; a link with faults and no file.
pub fn simulate(
    plan: &Plan,
    destination: impl Into<Destination>,
    cancel: &Cancel,
    on_start: OnStart<'_>,
) -> Result<Report, PipelineError> {
    let destination = destination.into();
    if plan.config.downlink.link.is_on() && destination.file.is_none() {
        return Err(DownlinkError::from(SocketError::NoTruthFile).into());
    }
    if let Some(file) = &destination.file {
        write_truth(plan, file)?;
    }
    let recorder = match &destination.file {
        Some(file) => Some(Recorder::create(file)?),
        None => destination.standard_output.then(Recorder::to_standard_output),
    };
    let skies = space_segment::skies(plan)?;
    let sinks = DownlinkSinks { file: destination.file, recorder, socket: destination.socket };
    simulate_skies(plan, &skies, sinks, cancel, on_start)
}

pub(in crate::pipeline) struct DownlinkSinks {
    /// Path of the downlink file, if `recorder` writes to one.
    pub(in crate::pipeline) file: Option<PathBuf>,
    pub(in crate::pipeline) recorder: Option<Recorder>,
    pub(in crate::pipeline) socket: Option<SocketSink>,
}

/// Runs the space segment with the given skies, one per channel.
pub(in crate::pipeline) fn simulate_skies(
    plan: &Plan,
    skies: &[SkyMap],
    sinks: DownlinkSinks,
    cancel: &Cancel,
    on_start: OnStart<'_>,
) -> Result<Report, PipelineError> {
    let DownlinkSinks { file, recorder, socket } = sinks;
    let mut graph = Graph::new();
    let counts = SampleCounts::default();
    let mut bytes = space_segment::add(&mut graph, plan, skies, &counts)?;
    if let Some(file) = &file {
        bytes = add_link(&mut graph, bytes, &plan.config, file)?;
    }
    match (recorder, socket) {
        (Some(recorder), Some(socket)) => {
            let bytes = graph.stage(RECORD, plan.config.runtime.queue_capacity, bytes, recorder);
            graph.sink("send", bytes, socket);
        }
        (Some(recorder), None) => graph.sink(RECORD, bytes, recorder),
        (None, Some(socket)) => graph.sink("send", bytes, socket),
        // Neither file nor socket: `Graph::run` reports the unconnected link as an error.
        (None, None) => drop(bytes),
    }
    on_start(RunView::without_ground(&graph));
    let report = run_graph_alone(graph, &plan.config.runtime, cancel)?;
    // An error if the counts do not balance.
    sample_summary(&counts, plan, &report)?;
    Ok(report)
}

/// Runs the ground segment alone, on downlink files or a socket. `ground` has to be made with the same configuration.
///
/// A ground made with [`Ground::with_ranks`] runs as one of several ranks; see [`run_with_ranks`].
///
/// # Errors
/// A file that cannot be read; the first failure of any stage; a last checkpoint that could not be written; no
/// visibility for any map.
pub fn replay<S: GroundSource + 'static>(
    source: S,
    config: &Config,
    ground: Ground,
    out: &Path,
    cancel: &Cancel,
    on_start: OnStart<'_>,
) -> Result<RunSummary, PipelineError> {
    replay_with_truth(Truth::unknown(), source, config, ground, out, cancel, on_start)
}

/// Runs the ground segment alone on a simulation whose input sky is known, to compare the maps with it.
pub(in crate::pipeline) fn replay_with_truth<S: GroundSource + 'static>(
    truth: Truth,
    source: S,
    config: &Config,
    ground: Ground,
    out: &Path,
    cancel: &Cancel,
    on_start: OnStart<'_>,
) -> Result<RunSummary, PipelineError> {
    let ranks = ground.ranks().clone();
    config.require_shareable(ranks.share().count)?;
    let _lock = ranks.is_first().then(|| lock_products(config, out)).transpose()?;
    let finished = run_ground(truth, source, config, ground, out, cancel, on_start)?;
    collect_and_write_summary(RunScope::Ground, &ranks, config, out, finished)
}

/// Runs the ground segment on a source, without a summary. The caller has locked `out`.
pub(in crate::pipeline) fn run_ground<S: GroundSource + 'static>(
    truth: Truth,
    source: S,
    config: &Config,
    ground: Ground,
    out: &Path,
    cancel: &Cancel,
    on_start: OnStart<'_>,
) -> Result<FinishedGraph, PipelineError> {
    let mut graph = Graph::new();
    let (listening, is_service) = (source.listening(), source.is_service());
    let bytes = graph.source(READ, config.runtime.queue_capacity, source);
    let grace = Grace::new(&config.runtime);
    let solving = SolveWatch::new(cancel.clone()).with_grace(grace.iterate);
    let ranks = ground.ranks().clone();
    let ground = ground.with_cancel(cancel, grace.accumulate);
    let maps = MapWatch::default();
    let products = is_service.then(ProductsWatch::default);
    let (viewers, product_state) = (maps.clone(), products.clone());
    let mapping = MappingContext { out, truth, watch: solving.clone(), viewers, product_state, kept: None };
    let outcome = ground_segment::add(&mut graph, bytes, config, ground, mapping)?;
    let handles = RunView {
        metrics: graph.metrics(),
        solving,
        listening: listening.clone(),
        ground: Some(outcome.ground.clone()),
        maps,
        products,
    };
    on_start(handles);
    let report = run_graph(graph, &ranks, &config.runtime, cancel)?;
    Ok(FinishedGraph::new(report, outcome, listening, cancel))
}

impl Config {
    /// Requires settings with which this number of ranks can share the normal equations.
    ///
    /// # Errors
    /// [`PipelineError::NotShareable`].
    #[doc(hidden)]
    pub fn require_shareable(&self, ranks: usize) -> Result<(), PipelineError> {
        let (found, expected) = match self.map.method() {
            Method::Harmonic => return Ok(()),
            _ if ranks < 2 => return Ok(()),
            Method::Refined => ("map.refine.passes_max above 0", "0"),
            Method::Pixel | Method::MatrixFree => ("map.engine = \"pixel\"", "\"harmonic\""),
        };
        Err(PipelineError::NotShareable { found, expected })
    }
}

/// The summary of samples; `None` without samples, or if stages were abandoned and may still be counting.
fn sample_summary(
    counts: &SampleCounts,
    plan: &Plan,
    report: &Report,
) -> Result<Option<SampleSummary>, PipelineError> {
    if report.cut.is_empty() { counts.close(plan) } else { Ok(None) }
}

/// Adds the faults of the radio link, if any are configured; the file that lists them goes beside the downlink file.
pub(in crate::pipeline) fn add_link(
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

/// Writes the true errors of the instrument and the true bursts of moving sources beside a downlink file, if there are any.
pub(in crate::pipeline) fn write_truth(plan: &Plan, file: &Path) -> Result<(), PipelineError> {
    let tables = [(".instrument.csv", plan.instrument_truth()), (".moving.csv", plan.moving_truth())];
    for (ending, text) in tables {
        let Some(text) = text else { continue };
        let mut name = file.as_os_str().to_owned();
        name.push(ending);
        write_product(&PathBuf::from(name), text)?;
    }
    Ok(())
}

/// Writes all settings of a run beside its products, as a pipeline file that repeats the run.
pub(in crate::pipeline) fn write_settings(config: &Config, out: &Path) -> Result<(), PipelineError> {
    let version = env!("CARGO_PKG_VERSION");
    let head = format!(
        "All settings of this run, by lunarray {version}: `lunarray run {SETTINGS}` repeats it. Paths of files are as they were given."
    );
    write_pipeline(config, &head, &out.join(SETTINGS))
}

/// Writes all settings as a pipeline file, after a line on what they are.
pub(in crate::pipeline) fn write_pipeline(
    config: &Config,
    head: &str,
    path: &Path,
) -> Result<(), PipelineError> {
    let settings = toml::to_string_pretty(config)
        .map_err(|error| ProductsError::Encode { path: path.to_owned(), reason: error.to_string() })?;
    let text = format!("# {head}\n\n{settings}");
    // If the run was started from this very file, it is not rewritten.
    let has_same_length =
        fs::metadata(path).is_ok_and(|found| found.is_file() && found.len() == text.len() as u64);
    if has_same_length && fs::read(path).is_ok_and(|found| found == text.as_bytes()) {
        return Ok(());
    }
    Ok(write_product(path, text)?)
}

/// Locks a folder for maps; an error if an input file of the configuration lies in a channel's folder of it.
pub(in crate::pipeline) fn lock_products(config: &Config, out: &Path) -> Result<FolderLock, PipelineError> {
    for input in config.input_files() {
        if is_in_channel_folder(&input, out) {
            let reason = "the configuration names it as an input, and the run would replace it; expected another output folder";
            let source = io::Error::new(io::ErrorKind::InvalidInput, reason);
            return Err(ProductsError::Write { path: input, source }.into());
        }
    }
    lock_folder(out)
}

/// Requires that a run can lock the folder of its products, and leaves nothing behind.
///
/// # Errors
/// A folder that cannot be written or is in use, or in which the run would replace an input.
pub fn require_products_folder(config: &Config, out: &Path) -> Result<(), PipelineError> {
    lock_products(config, out).map(drop)
}

/// Creates and locks a folder; before anything is computed, so that an error shows early.
pub(in crate::pipeline) fn lock_folder(out: &Path) -> Result<FolderLock, PipelineError> {
    if let Ok(found) = out.symlink_metadata()
        && !out.is_dir()
    {
        let what = if out.exists() || !found.is_symlink() { "not a folder" } else { "a link to nothing" };
        let reason = format!("it is {what}; expected a folder, or a name that is free");
        let source = io::Error::new(io::ErrorKind::InvalidInput, reason);
        return Err(ProductsError::Write { path: out.to_owned(), source }.into());
    }
    let locked = FolderLock::acquire(out, ".lock", true);
    Ok(locked.map_err(ProductsError::write(out))?)
}

/// Whether a file lies in a channel's folder (`...MHz`) of `out`, or of its joint maps.
fn is_in_channel_folder(input: &Path, out: &Path) -> bool {
    let (Ok(input), Ok(out)) = (fs::canonicalize(input), fs::canonicalize(out)) else { return false };
    let Some(folder) = input.parent() else { return false };
    [&out, &out.join(JOINT)].into_iter().any(|products| folder.parent() == Some(products.as_path()))
        && folder.file_name().is_some_and(|name| name.to_string_lossy().ends_with("MHz"))
}

/// Division of the grace period after cancellation.
struct Grace {
    /// Time to add the visibilities in queues, if there is no state that saves them.
    accumulate: Duration,
    /// Time until the solver stops iterating; the rest is for writing maps.
    iterate: Duration,
}

impl Grace {
    fn new(config: &RuntimeConfig) -> Self {
        let total = Duration::from_secs_f64(config.grace_s);
        Self { accumulate: total / 4, iterate: total * 7 / 10 }
    }
}

/// Time limit for stages to end after a failure.
pub(crate) const SHUTDOWN: Duration = Duration::from_secs(10);

/// Time limit for the stages of one of several ranks to end after a failure; shorter, as they may be waiting for other ranks.
const RANK_SHUTDOWN: Duration = Duration::from_secs(3);

/// Runs a graph that is not shared with other ranks.
pub(in crate::pipeline) fn run_graph_alone(
    graph: Graph,
    config: &RuntimeConfig,
    cancel: &Cancel,
) -> Result<Report, PipelineError> {
    run_graph(graph, &Ranks::single(), config, cancel)
}

fn run_graph(
    mut graph: Graph,
    ranks: &Ranks,
    config: &RuntimeConfig,
    cancel: &Cancel,
) -> Result<Report, PipelineError> {
    if config.stall_s > 0.0 {
        graph.fail_after_stall(Duration::from_secs_f64(config.stall_s));
    }
    // The named stages save data: they are not abandoned.
    graph.cut_after(Duration::from_secs_f64(config.grace_s), &[RECORD, ground_segment::GROUND]);
    Ok(graph.run(cancel, if ranks.is_distributed() { RANK_SHUTDOWN } else { SHUTDOWN })?)
}

/// Starts the configured number of worker threads. Call it once, before anything runs.
///
/// # Errors
/// Threads that cannot be started; another number of threads than the process already has.
pub fn use_threads(config: &RuntimeConfig) -> Result<(), PipelineError> {
    let threads = config.threads;
    match rayon::ThreadPoolBuilder::new().num_threads(threads).build_global() {
        Err(error) if threads != 0 && threads != rayon::current_num_threads() => {
            Err(PipelineError::Threads { threads, reason: error.to_string() })
        }
        _ => Ok(()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::downlink::Pace;
    use crate::runtime::{Flow, Outlet};

    /// A source that runs until it is cancelled, or does not.
    struct Service(bool);

    impl Source for Service {
        type Out = Vec<u8>;
        type Error = DownlinkError;

        fn next(&mut self, _: &mut Outlet<Vec<u8>>) -> Result<Flow, DownlinkError> {
            Ok(Flow::Done)
        }
    }

    impl GroundSource for Service {
        fn is_service(&self) -> bool {
            self.0
        }
    }

    #[test]
    fn a_service_is_one_at_any_pace() {
        for is_service in [false, true] {
            let paced = PacedSource::new(Service(is_service), Pace::Speed(10.0));
            assert_eq!(paced.is_service(), is_service);
        }
    }
}
