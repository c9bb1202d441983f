//! Running pipelines: the whole chain, the space segment alone, the ground segment alone.

use std::path::{Path, PathBuf};
use std::sync::{Arc, PoisonError};
use std::time::Duration;
use std::{fs, io};

use super::ground_segment::{MappingContext, SegmentOutcome};
use super::live_gains::GainsWriter;
use super::sample_summary::{SampleCounts, SampleSummary};
use super::summary::{RunScope, RunSummary};
use super::{ground_segment, space_segment};
use crate::downlink::link::LinkStage;
use crate::downlink::transport::socket::{Listening, SocketError, SocketSink, SocketSource};
use crate::downlink::{DownlinkConfig, DownlinkError, FileSource, Format, PacedSource, Recorder};
use crate::files::{FolderLock, write_atomically};
use crate::ground::{Ground, GroundOutcome, WAIT_BYTES};
use crate::imaging::EngineKind;
use crate::imaging::SolveWatch;
use crate::pipeline::config::{Config, PipelineError, Plan, SETTINGS};
use crate::products::{MapShape, MapWatch, ProductsError, ProductsWatch, Truth, write_autos};
use crate::ranks::Ranks;
use crate::runtime::{Cancel, Graph, Link, Metrics, Report, RuntimeConfig, Source};
use crate::sky::SkyMap;

/// Handles to watch a running graph.
#[derive(Clone, Debug)]
pub struct Watched {
    /// Counters and times of its stages.
    pub metrics: Arc<Metrics>,
    /// The solution in progress.
    pub solving: SolveWatch,
    /// The senders, if the ground listens.
    pub listening: Option<Listening>,
    /// Ledger, reception and checkpoints of the ground, if there is one.
    pub ground: Option<GroundOutcome>,
    /// The maps, for those who want to see them.
    pub maps: MapWatch,
    /// How their files go, of a ground that goes on without them.
    pub products: Option<ProductsWatch>,
}

impl Watched {
    /// Handles of a graph without a ground.
    pub(in crate::pipeline) fn of_space(graph: &Graph) -> Self {
        let (solving, maps) = (SolveWatch::default(), MapWatch::default());
        Self { metrics: graph.metrics(), solving, listening: None, ground: None, maps, products: None }
    }
}

/// A source of downlink bytes.
pub trait GroundSource: Source<Out = Vec<u8>, Error = DownlinkError> {
    /// Its senders, if it listens.
    fn listening(&self) -> Option<Listening> {
        None
    }

    /// Whether it goes on until it is told to end: reception then does not end because maps cannot be written.
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
}

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
    /// Standard output, in place of a file.
    pub standard_output: bool,
    /// A listening ground.
    pub socket: Option<SocketSink>,
}

impl<P: AsRef<Path>> From<&P> for Destination {
    fn from(file: &P) -> Self {
        Self { file: Some(file.as_ref().to_owned()), ..Self::default() }
    }
}

/// Receives the handles of a graph that is about to run.
pub type Watcher<'a> = &'a mut dyn FnMut(Watched);

/// Name of the stage that reads the downlink.
pub const READ: &str = "read";

/// Name of the stage that writes the downlink file.
pub(in crate::pipeline) const RECORD: &str = "record";

/// Name of the downlink file that `run` leaves among its products.
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
/// The first failure of any stage; a ledger that does not close; no visibility for any map.
pub fn run(
    plan: &Plan,
    out: &Path,
    cancel: &Cancel,
    watch: Watcher<'_>,
) -> Result<RunSummary, PipelineError> {
    run_with_ranks(&Ranks::single(), plan, out, cancel, watch)
}

/// As [`run`], as one rank of several that share the sums. Each simulates and receives everything; the first alone writes into
/// `out`, and its summary alone has maps. A rank whose run ends early or with an error has to end the job.
///
/// # Errors
/// Those of a run; settings with which sums cannot be shared.
pub fn run_with_ranks(
    ranks: &Ranks,
    plan: &Plan,
    out: &Path,
    cancel: &Cancel,
    watch: Watcher<'_>,
) -> Result<RunSummary, PipelineError> {
    plan.config.require_shareable(ranks.share().count)?;
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
        write_instrument_truth(plan, &file)?;
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
    let grace = Grace::of(&plan.config.runtime);
    let solving = SolveWatch::new(cancel.clone()).with_grace(grace.to_iterate);
    let ground =
        Ground::new(&plan.config.ground(WAIT_BYTES))?.with_cancel(cancel, grace.to_add).with_ranks(ranks);
    let maps = MapWatch::default();
    let mapping = MappingContext { out, truth, watch: solving.clone(), viewers: maps.clone(), trouble: None };
    let outcome = ground_segment::add(&mut graph, bytes, &plan.config, ground, mapping)?;
    let ground = Some(outcome.ground.clone());
    let watched =
        Watched { metrics: graph.metrics(), solving, listening: None, ground, maps, products: None };
    let report = start(graph, ranks, &plan.config.runtime, cancel, (watched, watch))?;
    let samples = close_samples(&counts, plan, &report)?;
    let ended = FinishedGraph { report, outcome, listening: None, samples };
    conclude(RunScope::Whole, ranks, &plan.config, out, ended)
}

/// The space segment alone, to a downlink file, a ground that listens, or both.
///
/// # Errors
/// The first failure of any stage; a link with faults and no file.
pub fn simulate(
    plan: &Plan,
    to: impl Into<Destination>,
    cancel: &Cancel,
    watch: Watcher<'_>,
) -> Result<Report, PipelineError> {
    let to = to.into();
    if plan.config.downlink.link.is_on() && to.file.is_none() {
        return Err(DownlinkError::from(SocketError::TruthNowhere).into());
    }
    if let Some(file) = &to.file {
        write_instrument_truth(plan, file)?;
    }
    let recorder = match &to.file {
        Some(file) => Some(Recorder::create(file)?),
        None => to.standard_output.then(Recorder::to_standard_output),
    };
    let skies = space_segment::skies(plan)?;
    simulate_sky(plan, &skies, (to, recorder), cancel, watch)
}

/// As [`simulate`], of these skies, one a channel; the recorder is that of the file.
pub(in crate::pipeline) fn simulate_sky(
    plan: &Plan,
    skies: &[SkyMap],
    (to, recorder): (Destination, Option<Recorder>),
    cancel: &Cancel,
    watch: Watcher<'_>,
) -> Result<Report, PipelineError> {
    let Destination { file, socket, .. } = to;
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
        // The graph says that its end is open.
        (None, None) => drop(bytes),
    }
    let watched = Watched::of_space(&graph);
    let report = start_alone(graph, &plan.config.runtime, cancel, watched, watch)?;
    close_samples(&counts, plan, &report)?;
    Ok(report)
}

/// The ground segment alone: `ground`, made with the same configuration, takes downlink files or what senders send.
///
/// As [`run_with_ranks`], for a ground that is one rank's ([`Ground::with_ranks`]).
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
    watch: Watcher<'_>,
) -> Result<RunSummary, PipelineError> {
    replay_knowing(Truth::unknown(), source, config, ground, out, cancel, watch)
}

/// As [`replay`], of a simulation whose skies are known.
pub(in crate::pipeline) fn replay_knowing<S: GroundSource + 'static>(
    truth: Truth,
    source: S,
    config: &Config,
    ground: Ground,
    out: &Path,
    cancel: &Cancel,
    watch: Watcher<'_>,
) -> Result<RunSummary, PipelineError> {
    let ranks = ground.ranks().clone();
    config.require_shareable(ranks.share().count)?;
    let _lock = ranks.is_first().then(|| lock_products(config, out)).transpose()?;
    let ended = ground_alone(truth, source, config, ground, out, cancel, watch)?;
    conclude(RunScope::Ground, &ranks, config, out, ended)
}

/// Runs the ground on a source; the output folder is locked.
pub(in crate::pipeline) fn ground_alone<S: GroundSource + 'static>(
    truth: Truth,
    source: S,
    config: &Config,
    ground: Ground,
    out: &Path,
    cancel: &Cancel,
    watch: Watcher<'_>,
) -> Result<FinishedGraph, PipelineError> {
    let mut graph = Graph::new();
    let (listening, is_service) = (source.listening(), source.is_service());
    let bytes = graph.source(READ, config.runtime.queue_capacity, source);
    let grace = Grace::of(&config.runtime);
    let solving = SolveWatch::new(cancel.clone()).with_grace(grace.to_iterate);
    let ranks = ground.ranks().clone();
    let ground = ground.with_cancel(cancel, grace.to_add);
    let maps = MapWatch::default();
    let trouble = is_service.then(ProductsWatch::default);
    let (viewers, products) = (maps.clone(), trouble.clone());
    let mapping = MappingContext { out, truth, watch: solving.clone(), viewers, trouble };
    let outcome = ground_segment::add(&mut graph, bytes, config, ground, mapping)?;
    let ground = Some(outcome.ground.clone());
    let watched =
        Watched { metrics: graph.metrics(), solving, listening: listening.clone(), ground, maps, products };
    let report = start(graph, &ranks, &config.runtime, cancel, (watched, watch))?;
    Ok(FinishedGraph { report, outcome, listening, samples: None })
}

impl Config {
    /// Requires settings with which so many ranks can share the sums.
    ///
    /// # Errors
    /// [`PipelineError::NotShareable`].
    #[doc(hidden)]
    pub fn require_shareable(&self, ranks: usize) -> Result<(), PipelineError> {
        let found = match self {
            _ if ranks < 2 => None,
            Self { map, .. } if map.engine != EngineKind::Harmonic => {
                Some(("map.engine = \"pixel\"", "\"harmonic\""))
            }
            Self { map, .. } if map.refine.is_on() => Some(("map.refine.passes_max above 0", "0")),
            _ => None,
        };
        match found {
            Some((found, expected)) => Err(PipelineError::NotShareable { found, expected }),
            None => Ok(()),
        }
    }

    /// The maps that a truth is compared with.
    pub(in crate::pipeline) fn map_shape(&self) -> MapShape {
        let Self { map, products, .. } = self;
        let l_max = (map.engine == EngineKind::Harmonic).then(|| map.degree());
        MapShape { nside: map.nside, l_max, processing: products.processing() }
    }
}

/// Closes the ledger of samples; not of a run that was cut short, whose stages may still be counting.
fn close_samples(
    counts: &SampleCounts,
    plan: &Plan,
    report: &Report,
) -> Result<Option<SampleSummary>, PipelineError> {
    if report.cut.is_empty() { counts.close(plan) } else { Ok(None) }
}

/// Adds the link's faults, if any are configured; their truth file goes beside the downlink file.
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

/// Leaves the true errors of the instrument beside a downlink file, if it has any.
pub(in crate::pipeline) fn write_instrument_truth(plan: &Plan, file: &Path) -> Result<(), PipelineError> {
    let Some(text) = plan.instrument_truth() else { return Ok(()) };
    let mut name = file.as_os_str().to_owned();
    name.push(".instrument.csv");
    let path = PathBuf::from(name);
    Ok(write_atomically(&path, text.as_bytes()).map_err(|source| ProductsError::Write { path, source })?)
}

/// Leaves all settings of a run beside its products, as a pipeline file that repeats it.
pub(in crate::pipeline) fn write_settings(config: &Config, out: &Path) -> Result<(), PipelineError> {
    let path = out.join(SETTINGS);
    let settings = toml::to_string_pretty(config)
        .map_err(|error| ProductsError::Encode { path: path.clone(), reason: error.to_string() })?;
    let version = env!("CARGO_PKG_VERSION");
    let text = format!(
        "# All settings of this run, by lunarray {version}: `lunarray run {SETTINGS}` repeats it. Paths of files are as they were \
         given.\n\n{settings}"
    );
    // A run of the settings that it left may leave them.
    let has_its_length =
        fs::metadata(&path).is_ok_and(|found| found.is_file() && found.len() == text.len() as u64);
    if has_its_length && fs::read(&path).is_ok_and(|known| known == text.as_bytes()) {
        return Ok(());
    }
    Ok(write_atomically(&path, text.as_bytes()).map_err(|source| ProductsError::Write { path, source })?)
}

/// As [`lock_folder`], for maps: no file that the configuration names may be in the place of one.
pub(in crate::pipeline) fn lock_products(config: &Config, out: &Path) -> Result<FolderLock, PipelineError> {
    for input in config.input_files() {
        if is_place_of_product(&input, out) {
            let reason = "the configuration names it as an input, and the run would replace it; expected another output folder";
            let source = io::Error::new(io::ErrorKind::InvalidInput, reason);
            return Err(ProductsError::Write { path: input, source }.into());
        }
    }
    lock_folder(out)
}

/// Creates and locks the folder before anything is computed, so that an error shows at once.
pub(in crate::pipeline) fn lock_folder(out: &Path) -> Result<FolderLock, PipelineError> {
    let locked = FolderLock::acquire(out, ".lock", true);
    locked.map_err(|source| ProductsError::Write { path: out.to_owned(), source }.into())
}

/// Whether a file lies in one of the folders of channels in `out`.
fn is_place_of_product(input: &Path, out: &Path) -> bool {
    let (Ok(input), Ok(out)) = (fs::canonicalize(input), fs::canonicalize(out)) else { return false };
    let Some(folder) = input.parent() else { return false };
    folder.parent() == Some(out.as_path())
        && folder.file_name().is_some_and(|name| name.to_string_lossy().ends_with("MHz"))
}

/// How the time after cancellation is divided.
struct Grace {
    /// For the sums, if they are not saved.
    to_add: Duration,
    /// Until iterations end; making maps of what they have found takes the rest.
    to_iterate: Duration,
}

impl Grace {
    fn of(config: &RuntimeConfig) -> Self {
        let whole = Duration::from_secs_f64(config.grace_s);
        Self { to_add: whole / 4, to_iterate: whole * 7 / 10 }
    }
}

/// How long stages have to end after a failure.
pub(crate) const SHUTDOWN: Duration = Duration::from_secs(10);

/// How long stages of one rank of several have to end after a failure: they may be waiting for the others.
const SHUTDOWN_OF_RANK: Duration = Duration::from_secs(3);

/// Runs a graph in one process.
pub(in crate::pipeline) fn start_alone(
    graph: Graph,
    config: &RuntimeConfig,
    cancel: &Cancel,
    watched: Watched,
    watch: Watcher<'_>,
) -> Result<Report, PipelineError> {
    start(graph, &Ranks::single(), config, cancel, (watched, watch))
}

fn start(
    mut graph: Graph,
    ranks: &Ranks,
    config: &RuntimeConfig,
    cancel: &Cancel,
    (watched, watch): (Watched, Watcher<'_>),
) -> Result<Report, PipelineError> {
    if config.stall_s > 0.0 {
        graph.fail_after_stall(Duration::from_secs_f64(config.stall_s));
    }
    // These stages save data: they end in order, however long it takes.
    graph.cut_after(Duration::from_secs_f64(config.grace_s), &[RECORD, ground_segment::GROUND]);
    watch(watched);
    Ok(graph.run(cancel, if ranks.is_distributed() { SHUTDOWN_OF_RANK } else { SHUTDOWN })?)
}

/// Results of a run that ended without a failure.
pub(in crate::pipeline) struct FinishedGraph {
    report: Report,
    outcome: SegmentOutcome,
    listening: Option<Listening>,
    samples: Option<SampleSummary>,
}

impl FinishedGraph {
    /// Auto-correlations that were taken.
    pub(in crate::pipeline) fn powers(&self) -> u64 {
        self.outcome.ground.autos.lock().unwrap_or_else(PoisonError::into_inner).len() as u64
    }
}

/// The summary of a run, which the first rank writes.
fn conclude(
    segment: RunScope,
    ranks: &Ranks,
    config: &Config,
    out: &Path,
    ended: FinishedGraph,
) -> Result<RunSummary, PipelineError> {
    if ranks.is_distributed() && ended.report.cancelled {
        return Err(PipelineError::RankInterrupted);
    }
    if ranks.is_first() {
        return finish(summarise(segment, config, out, ended)?, out);
    }
    let FinishedGraph { report, outcome, .. } = ended;
    let reception = outcome.ground.reception.lock().unwrap_or_else(PoisonError::into_inner).clone();
    let ledger = outcome.ground.ledger.balanced_report()?;
    Ok(RunSummary::new(segment, config, report, ledger, reception, Vec::new()))
}

/// The summary of a run; writes the auto-correlations.
pub(in crate::pipeline) fn summarise(
    segment: RunScope,
    config: &Config,
    out: &Path,
    ended: FinishedGraph,
) -> Result<RunSummary, PipelineError> {
    let FinishedGraph { report, outcome, listening, samples } = ended;
    let SegmentOutcome { ground, channels } = outcome;
    let mut reception = ground.reception.lock().unwrap_or_else(PoisonError::into_inner).clone();
    let channels = channels.lock().unwrap_or_else(PoisonError::into_inner).clone();
    let ledger = ground.ledger.balanced_report()?;
    let listening = listening.map(|listening| listening.report());
    if let Some(account) = &listening {
        account.complete(&mut reception);
    }
    let mut autos = ground.autos.lock().unwrap_or_else(PoisonError::into_inner);
    write_autos(&mut autos, out, config.products.pictures)?;
    let mut summary = RunSummary::new(segment, config, report, ledger, reception, channels);
    (summary.listening, summary.samples) = (listening, samples);
    summary.completeness = ground.completeness.lock().unwrap_or_else(PoisonError::into_inner).clone();
    summary.saving = ground.saving.report();
    let gains = ground.gains.as_ref().map(|gains| GainsWriter::new(config, out).write(gains));
    summary.calibration = gains.transpose()?;
    Ok(summary)
}

/// Writes the summary of a run, and says what failed in the end.
pub(in crate::pipeline) fn finish(summary: RunSummary, out: &Path) -> Result<RunSummary, PipelineError> {
    let path = summary.write(out)?;
    if let Some(reason) = summary.saving.as_ref().and_then(|saving| saving.unsaved.clone()) {
        return Err(PipelineError::Unsaved { summary: path, reason });
    }
    if summary.channels.is_empty() && !summary.cancelled {
        return Err(PipelineError::NoMap { summary: path, ledger: Box::new(summary.ledger) });
    }
    Ok(summary)
}

/// Starts as many worker threads as configured; once, before anything runs.
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
