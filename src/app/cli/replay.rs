//! `lunarray replay`: run the ground segment on downlink files or live senders.

use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use clap::{ArgGroup, Args};
use crossbeam_channel::{Receiver, bounded};
use serde_json::{Value, json};

use super::arguments::{
    ChannelList, channel_list, group_size, input_path, not_negative_s, output_path, size_bytes,
};
use super::events::{Events, EventsArgs};
use super::interrupt::Interrupt;
use super::job::Job;
use super::lines::next_line;
use super::log::{Level, is_json, note, say, say_entry};
use super::output::{
    CommandError, CommandResult, WrongUsage, print_incompleteness, print_json_line, print_notes, print_text,
};
use super::progress::{Parts, Progress, time_left};
use super::serving::{Page, ServeArgs};
use crate::calibration::CalibrationHook;
use crate::downlink::transport::socket::{
    HeldAnswers, ListenLimits, ListenNote, ListenUrl, SocketSource, Stations,
};
use crate::downlink::{FileSource, Pace, PacedSource, Steps};
use crate::files::{ProtectedInputs, is_same_name};
use crate::frames::Instrument;
use crate::ground::{ARCHIVE_BYTES_MAX, Collector, Ground, GroundConfig, GroundError, WAIT_BYTES};
use crate::pipeline::{
    Config, ConfigSource, GroundSource, GroupSize, JobEvent, MemoryAdvice, MemoryLimit, PipelineError, READ,
    RunSummary, SettingsOrigin, channel_groups, main_products, replay, replay_in_groups,
    require_products_folder, use_threads,
};

/// Capacity of the hold buffer when listening without a state, bytes.
const WAIT_BYTES_LIVE: u64 = 1 << 20;

/// Make maps from downlink files, or from stations that send live.
///
/// Everything comes from the downlink: instrument, positions, visibilities. Lost, damaged and unusable data are counted
/// in the ledger. A map file is a pipeline file of which only the sections calibration, map, products, runtime and
/// downlink.listen are used, so the file of a simulation can be used unchanged; the maps are then bit for bit those of
/// `lunarray run`.
///
/// Example: lunarray replay pass-*.ccsds --map map.toml --out maps/ --state state/
#[derive(Debug, Args)]
#[command(group(ArgGroup::new("live").args(["follow", "listen"])))]
#[command(group(ArgGroup::new("pace").args(["speed", "step"])))]
pub(super) struct ReplayArgs {
    /// Downlink files in the order of time.
    #[arg(required_unless_present_any = ["state", "listen"], value_name = "FILE", value_parser = input_path())]
    files: Vec<PathBuf>,
    /// Map file (TOML): settings of the ground segment. Without it they are those of the state, which has none of regulariser,
    /// epsilon and products: these are then the defaults; without a state those of the run that made the
    /// downlink, if its pipeline.toml lies beside the first FILE or it was the quicklook; else the defaults of `lunarray
    /// config`.
    #[arg(long, value_name = "MAP.toml", value_parser = input_path())]
    map: Option<PathBuf>,
    /// Gains that `lunarray calibrate` found: as calibration.hook = "antenna-gains" with calibration.gains_file.
    #[arg(long, value_name = "GAINS.json")]
    calibration: Option<PathBuf>,
    /// Output folder for the products.
    #[arg(short, long, value_name = "DIR", value_parser = output_path())]
    out: PathBuf,
    /// State folder that keeps everything received: every packet is applied once, in this session and all later ones,
    /// however often and in whatever order it arrives. To resume after an interruption, repeat the command.
    #[arg(long, value_name = "DIR")]
    state: Option<PathBuf>,
    /// Number of visibilities between two checkpoints of the state; the end always writes one.
    #[arg(long, value_name = "NUMBER", default_value_t = 1_000_000, requires = "state")]
    checkpoint_every: u64,
    /// Folder of the raw archive, where a ground that listens keeps every packet on disk before it answers `taken`; by default
    /// the folder `archive` of the state. `lunarray rebuild` makes a new state of it.
    #[arg(long, value_name = "DIR", requires_all = ["state", "listen"])]
    archive: Option<PathBuf>,
    /// Keep no raw archive: what came after the last checkpoint is then lost when the ground is killed, although it was answered
    /// with `taken`.
    #[arg(long, requires_all = ["state", "listen"], conflicts_with = "archive")]
    no_archive: bool,
    /// Maximum size of the raw archive, with a unit, such as 20GB; by default 64 GiB. Beyond it the oldest segments are deleted,
    /// once two checkpoints hold them.
    #[arg(long, value_name = "SIZE", value_parser = size_bytes, requires_all = ["state", "listen"])]
    archive_max: Option<u64>,
    /// Capacity of the hold buffer for visibilities without positions, bytes; when it is full, the oldest are flagged.
    /// Default 256 MiB, or 1 MiB when listening without a state; an existing state keeps its own.
    #[arg(long, value_name = "BYTES")]
    wait_bytes: Option<u64>,
    /// Follow the last FILE as it grows, until Ctrl-C or SIGTERM, which leaves maps of the data so far.
    #[arg(long, requires = "files")]
    follow: bool,
    /// Receive the downlink from senders that connect to this address, instead of files, until Ctrl-C or SIGTERM (exit
    /// code 0). Port 0 chooses a free port; standard error prints `listening on tcp://HOST:PORT`. With udp://HOST:PORT, or with both,
    /// take datagrams, each a packet or a frame; they are not answered.
    #[arg(long, value_name = "tcp://HOST:PORT", conflicts_with_all = ["files", "pace"])]
    listen: Vec<ListenUrl>,
    /// Allow an address that other machines can reach. Anyone who connects can add data to the maps.
    #[arg(long, requires = "listen")]
    allow_remote: bool,
    /// Take packets only from the stations in this file, which has a line NAME TOKEN for each. Their connections begin with the line
    /// `token TOKEN`, and are reported by name. Nobody else may be able to read the file. Tokens are sent as they are: use a tunnel.
    #[arg(long, value_name = "FILE", requires = "listen")]
    stations: Option<PathBuf>,
    /// End after this number of connections that delivered packets have closed; 0 for never.
    #[arg(long, value_name = "NUMBER", default_value_t = 0, requires = "listen")]
    connections: u64,
    /// End after this time without growth of the followed file, or without a valid packet from any sender: a number with
    /// an optional unit s, h or d, such as 90s; 0 for never.
    #[arg(long, value_name = "TIME", default_value_t = 0.0, requires = "live", value_parser = not_negative_s)]
    idle_s: f64,
    /// Speed of the replay relative to real time, by the time tags of the packets: a number, or max.
    #[arg(long, value_name = "max|NUMBER", default_value = "max", value_parser = speed)]
    speed: Speed,
    /// Replay step by step: a pass, or this much mission time (a number with an optional unit s, h or d), for each line of
    /// standard input; the end of the input ends the replay.
    #[arg(long, value_name = "pass|TIME", value_parser = step)]
    step: Option<StepLength>,
    /// Mission time between snapshot maps: a number with an optional unit s, h or d, such as 7d; 0 for the final map only.
    #[arg(long, value_name = "TIME", value_parser = not_negative_s)]
    snapshot_every: Option<f64>,
    /// Channels to map, from 0 in the order of the instrument, such as 0-4,7; by default all. The others are counted as left out.
    #[arg(long, value_name = "LIST", value_parser = channel_list)]
    channels: Option<ChannelList>,
    /// Map the channels in groups and read the files once per group: as many channels at a time as memory allows (auto), or this
    /// many. Maps and ledger are identical to those of mapping all channels together. To
    /// resume after an interruption, repeat the command.
    #[arg(long, value_name = "auto|NUMBER", value_parser = group_size, conflicts_with_all = ["live", "pace", "state"])]
    #[cfg_attr(feature = "serve", arg(conflicts_with = "serve"))]
    groups: Option<GroupSize>,
    /// Maximum memory for the sums of all channels, with a unit, such as 8GB or 16GiB; by default what the machine has available.
    #[arg(long, value_name = "SIZE", value_parser = size_bytes)]
    memory_max: Option<u64>,
    /// Share the sums of each map of the harmonic engine with the other ranks of an MPI job: mpirun -n 4 lunarray replay --mpi ...
    /// Every rank reads the files; the first writes the products, which are those of one process. With --state each rank keeps its
    /// part, and any number of ranks goes on from it. Needs a program built with --features mpi.
    #[arg(long, conflicts_with_all = ["live", "pace", "groups", "events"])]
    #[cfg_attr(feature = "serve", arg(conflicts_with = "serve"))]
    mpi: bool,
    /// Replace one setting, for example --set map.nside=8; may be repeated.
    #[arg(long = "set", value_name = "KEY=VALUE")]
    overrides: Vec<String>,
    /// Print the summary as one JSON object instead of tables.
    #[arg(long)]
    json: bool,
    #[command(flatten)]
    events: EventsArgs,
    #[command(flatten)]
    serve: ServeArgs,
}

/// Speed of a replay relative to real time; `None` for as fast as possible.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Speed(pub(super) Option<f64>);

/// Mission time of a step, s; `None` for a pass.
#[derive(Clone, Copy, Debug, PartialEq)]
struct StepLength(Option<f64>);

pub(super) fn speed(text: &str) -> Result<Speed, String> {
    match (text.trim(), text.trim().parse::<f64>()) {
        ("max", _) => Ok(Speed(None)),
        (_, Ok(times)) if (1e-3..=1e12).contains(&times) => Ok(Speed(Some(times))),
        _ => Err("expected max, or a factor relative to real time from 0.001 to 1e12".into()),
    }
}

fn step(text: &str) -> Result<StepLength, String> {
    match text.trim() {
        "pass" => Ok(StepLength(None)),
        text => match not_negative_s(text) {
            Ok(every_s) if every_s > 0.0 => Ok(StepLength(Some(every_s))),
            _ => Err("expected pass, or a number above 0 with s, h or d, such as 1d".into()),
        },
    }
}

pub(super) fn execute(args: &ReplayArgs) -> CommandResult {
    let job = Job::join(args.mpi)?;
    let result = work(args, &job);
    job.conclude(result)
}

fn work(args: &ReplayArgs, job: &Job) -> CommandResult {
    args.check_folders()?;
    let mut overrides = args.overrides.clone();
    if let Some(every_s) = args.snapshot_every {
        overrides.push(format!("map.snapshot_every_s={every_s:?}"));
    }
    overrides.extend(args.channels.iter().map(ChannelList::setting));
    if let Some(path) = &args.calibration {
        overrides.push("calibration.hook=antenna-gains".to_owned());
        overrides.push(format!("calibration.gains_file={:?}", path.display().to_string()));
    }
    let source = ConfigSource { file: args.map.clone(), overrides, seed: None };
    let config = args.with_known_settings(source, job)?.load_ground()?;
    let named = args.files.iter().chain(&args.map).chain(&args.stations).cloned();
    let _inputs = ProtectedInputs::of(named.chain(config.input_files()));
    use_threads(&config.runtime)?;
    print_notes([config.positions_note(), config.gain_errors_note()].into_iter().flatten());
    if let Some(size) = args.groups {
        return in_groups(args, &config, size);
    }
    let reception = args.reception()?;
    let ground = args.open_ground(&config, job)?;
    let saving = ground.outcome().saving;
    let interrupt = Interrupt::default();
    let page = args.serve.start(&config, "ground", args.state.as_deref(), Some(&args.out))?;
    let outputs = main_products(&config, &args.out);
    let events = args.events.start(&config, "ground", &outputs, job.is_first())?;
    let session = Session { args, config: &config, job, interrupt: &interrupt, page: &page, events: &events };
    let result = match reception {
        Some(reception) => session.receive_from_senders(reception, ground),
        None => session.read_files(ground),
    };
    if let Some(completion) = job.completion_if_interrupted(&result, &interrupt) {
        return Ok(completion);
    }
    let result = page.conclude(result, |summary| summary.cancelled);
    events.conclude(&result, |summary| summary.cancelled);
    if result.is_err() && (args.listens() || args.follow) {
        page.serve_failure(&interrupt);
    }
    let summary = result.inspect_err(|error| {
        let is_reported =
            matches!(error.downcast_ref::<PipelineError>(), Some(PipelineError::Unsaved { .. }));
        // Another failure must not hide that the state was not saved.
        if let Some(saving) = saving.report().filter(|saving| saving.unsaved.is_some() && !is_reported) {
            note("checkpoint", &serde_json::to_value(&saving).unwrap_or_default(), saving);
        }
    })?;
    let completion = match args.follow || args.listens() {
        true => {
            let is_saved = args.state.is_some() || !summary.lacks_maps();
            interrupt.completion_of_service(summary.cancelled, is_saved)
        }
        false => interrupt.completion(summary.cancelled),
    };
    if !job.is_first() {
        return Ok(completion);
    }
    let printed = args.print(&summary);
    print_incompleteness(&summary);
    page.serve_until_interrupt(&interrupt);
    completion.after(printed)
}

impl ReplayArgs {
    /// Refuses a state that does not exist although there is nothing to make it from, and one folder for state and products.
    fn check_folders(&self) -> Result<(), CommandError> {
        let Some(state) = &self.state else { return Ok(()) };
        let path = state.display();
        if is_same_name(state, &self.out) {
            let text = format!("--state {path}: it is also the folder of --out; expected two folders");
            return Err(WrongUsage(text).into());
        }
        // The parsers of names know only states that exist.
        let mut below = self.out.ancestors().skip(1).chain(self.events.file().and_then(Path::parent));
        if below.any(|folder| is_same_name(state, folder)) {
            let text = format!("--state {path}: --out or --events lies in it; expected other folders");
            return Err(WrongUsage(text).into());
        }
        if self.files.is_empty() && !self.listens() && !Ground::is_state(state)? {
            return Err(format!(
                "--state {path}: no such state, and no files; expected the folder of a state, or downlink files to make one from"
            )
            .into());
        }
        Ok(())
    }

    /// Opens the state, or makes a ground without one.
    fn open_ground(&self, config: &Config, job: &Job) -> Result<Ground, CommandError> {
        let wait_bytes = match (&self.state, self.listens()) {
            // Solving holds all visibilities of a pass until its gains are known, which needs the large buffer.
            _ if config.calibration.hook == CalibrationHook::Solve => WAIT_BYTES,
            (None, true) => WAIT_BYTES_LIVE,
            _ => WAIT_BYTES,
        };
        let settings = self.with_memory_limit(config.ground(self.wait_bytes.unwrap_or(wait_bytes)));
        if job.is_first() && self.state.as_deref().is_some_and(|folder| !folder.exists()) {
            // A new state is made only if the products can be.
            require_products_folder(config, &self.out)?;
        }
        let ground = match &self.state {
            Some(folder) => Ground::open_with_ranks(folder, &settings, self.checkpoint_every, job.ranks())?,
            None => Ground::new(&settings)?.with_ranks(job.ranks()),
        };
        if job.is_first() {
            print_notes(ground.notes());
        }
        Ok(ground)
    }

    /// Adds the settings of the state, or else of the downlink, if there is no map file.
    fn with_known_settings(&self, source: ConfigSource, job: &Job) -> Result<ConfigSource, GroundError> {
        let with_state = self.state.as_deref().map(|folder| {
            let source = source.clone();
            match job.ranks().is_distributed() {
                true => source.with_state_settings_for_ranks(folder),
                false => source.with_state_settings(folder),
            }
        });
        let has_state = self.state.as_deref().is_some_and(Path::exists);
        let source = match with_state {
            Some(Err(error @ GroundError::FilesOfState { .. })) => return Err(error),
            // A state that cannot be read is reported when it is opened.
            Some(Err(_)) | None => source,
            Some(Ok(source)) => source,
        };
        let is_of_state = source.file.is_none() && has_state;
        let (source, origin) = source.with_downlink_settings(&self.files);
        match origin {
            SettingsOrigin::Run(origin) if job.is_first() => {
                let fields = json!({ "from": origin });
                say("settings", &fields, format_args!("settings of the maps: those of {origin}"));
            }
            // A state has its own.
            SettingsOrigin::NotUsed(why) if job.is_first() && !has_state => print_notes([why]),
            _ if job.is_first() && is_of_state => {
                let fields = json!({ "from": self.state });
                let text = "settings of the sums: those of the state; it has no others, so that map.regulariser, map.epsilon and the \
                            products have their defaults unless --map or --set says otherwise";
                say("settings", &fields, format_args!("{text}"));
            }
            _ => {}
        }
        Ok(source)
    }

    /// Prints the summary, unless standard output holds events.
    fn print(&self, summary: &RunSummary) -> Result<(), CommandError> {
        match self.json {
            _ if self.events.take_stdout() => Ok(()),
            true => print_json_line(summary),
            false => print_text(&format!("{summary}\nProducts are in {}", self.out.display())),
        }
    }

    fn with_memory_limit(&self, config: GroundConfig) -> GroundConfig {
        GroundConfig { memory_max_bytes: self.memory_limit().map(|limit| limit.bytes), ..config }
    }

    /// The memory limit: the given one, or that of the machine.
    fn memory_limit(&self) -> Option<MemoryLimit> {
        self.memory_max.map(MemoryLimit::of_user).or_else(MemoryLimit::of_machine)
    }
}

/// Warns if the normal equations of an instrument's channels will outgrow memory.
fn warn_about_memory(config: &Config, instrument: &Instrument, limit: Option<MemoryLimit>) {
    if let Some(advice) = limit.and_then(|limit| MemoryAdvice::new(config, instrument, limit)) {
        print_notes([advice]);
    }
}

/// Maps the channels of files in groups.
fn in_groups(args: &ReplayArgs, config: &Config, size: GroupSize) -> CommandResult {
    let groups = channel_groups(&args.files, config, size, args.memory_limit())?;
    let interrupt = Interrupt::default();
    let cancel = interrupt.cancel();
    let events = args.events.start(config, "ground", &main_products(config, &args.out), true)?;
    let mut parts = Parts::new(groups.iter().map(|group| group.channels.len() as f64));
    let mut progress = None;
    let result = replay_in_groups(&args.files, config, &groups, &args.out, cancel, &mut |event, view| {
        let (JobEvent::Map(step), Some(view)) = (event, view) else { return };
        let number = step.number;
        if number == 0 {
            interrupt.arm_or_note();
        }
        // The bar of the previous group ends first.
        progress = None;
        let channels: Vec<String> =
            groups.get(number).into_iter().flat_map(|group| &group.channels).map(|c| c.to_string()).collect();
        let (of, listed) = (groups.len(), channels.join(", "));
        let left_s = parts.begin(number);
        let fields = json!({
            "number": number + 1, "of": of, "channels": channels, "part": step.part + 1, "parts": step.parts, "left_s": left_s
        });
        let left = time_left(left_s);
        say("group", &fields, format_args!("group {} of {of}: channels {listed}{step}{left}", number + 1));
        events.watch(&view);
        progress = Some(Progress::watch(view, READ, 0, cancel));
    });
    drop(progress);
    let result = result.map_err(CommandError::from);
    events.conclude(&result, |summary| summary.cancelled);
    let summary = result?;
    let printed = args.print(&summary);
    print_incompleteness(&summary);
    interrupt.completion(summary.cancelled).after(printed)
}

/// Addresses of the sockets, and who may send to them.
struct SocketReception {
    connections: Vec<SocketAddr>,
    datagrams: Vec<SocketAddr>,
    stations: Option<Stations>,
}

/// Arguments, settings and outputs of a replay.
struct Session<'a> {
    args: &'a ReplayArgs,
    config: &'a Config,
    job: &'a Job,
    interrupt: &'a Interrupt,
    page: &'a Page,
    events: &'a Events,
}

impl ReplayArgs {
    /// Whether the packets are received from sockets.
    fn listens(&self) -> bool {
        !self.listen.is_empty()
    }

    /// What the sockets need; `None` without `--listen`.
    fn reception(&self) -> Result<Option<SocketReception>, CommandError> {
        if !self.listens() {
            return Ok(None);
        }
        let [connections, datagrams] = self.listening_addresses()?;
        let stations = self.stations.as_deref().map(Stations::read).transpose()?;
        Ok(Some(SocketReception { connections, datagrams, stations }))
    }

    /// Addresses for connections and for datagrams.
    fn listening_addresses(&self) -> Result<[Vec<SocketAddr>; 2], CommandError> {
        let wrong = |text: &str| Err(WrongUsage(text.to_owned()).into());
        let mut found = [Vec::new(), Vec::new()];
        for url in &self.listen {
            let (kind, url) = match url {
                ListenUrl::Tcp(url) => (0, url),
                ListenUrl::Udp(_) if self.stations.is_some() => {
                    return wrong(
                        "--listen udp:// with --stations: datagrams have no token; expected tcp:// alone",
                    );
                }
                ListenUrl::Udp(url) => (1, url),
            };
            if !found[kind].is_empty() {
                return wrong("--listen is given twice; expected at most one tcp:// and one udp://");
            }
            found[kind] = if self.allow_remote { url.addresses()? } else { url.loopback_addresses()? };
        }
        Ok(found)
    }
}

impl Session<'_> {
    /// Receives the downlink from senders, until a limit or a signal.
    fn receive_from_senders(
        &self,
        SocketReception { connections, datagrams, stations }: SocketReception,
        mut ground: Ground,
    ) -> Result<RunSummary, CommandError> {
        let Self { args, config, .. } = self;
        // These settings only decide which instruments fit, so the size of the hold buffer does not matter.
        let acceptance = args.with_memory_limit(config.ground(0));
        let (is_warned, warning_config, limit) =
            (AtomicBool::new(false), (*config).clone(), args.memory_limit());
        let limits = ListenLimits { idle_s: args.idle_s, connections: args.connections };
        let listen = &config.downlink.listen;
        let mut source = SocketSource::bind(&connections, listen, limits)?
            .with_instrument(ground.instrument().cloned())
            .with_instrument_check(Arc::new(move |instrument| {
                let fits = acceptance.fits(instrument).is_ok();
                if fits && !is_warned.swap(true, Ordering::Relaxed) {
                    warn_about_memory(&warning_config, instrument, limit);
                }
                fits
            }))
            .with_note_handler(Box::new(print_listen_note));
        if !datagrams.is_empty() {
            source = source.with_datagrams(&datagrams)?;
        }
        if let Some(stations) = stations {
            source = source.with_stations(stations);
        }
        if args.state.is_some() {
            let answers = HeldAnswers::new(Duration::from_secs_f64(listen.held_every_s));
            (source, ground) =
                (source.with_held_answers(&answers), ground.with_answers(&answers).with_initial_snapshot());
            if !args.no_archive {
                let bytes_max = args.archive_max.unwrap_or(ARCHIVE_BYTES_MAX);
                let kept = ground.keep_packets(args.archive.as_deref(), bytes_max)?;
                source = kept.iter().fold(source, |source, archive| source.with_archive(archive));
            }
        }
        let addresses = source.addresses().to_vec();
        Ok(self.run(source, ground, &|| {
            for address in &addresses {
                say("listening", &json!({ "url": address }), format_args!("listening on {address}"));
            }
        })?)
    }

    /// Replays downlink files.
    fn read_files(&self, ground: Ground) -> Result<RunSummary, CommandError> {
        let args = self.args;
        let files = match args.follow {
            true => FileSource::follow(&args.files, args.idle_s)?,
            false => FileSource::open(&args.files)?,
        };
        // A pipe can be read only once.
        if let Some(first) = args.files.first().filter(|path| path.is_file())
            && let Ok(Some(instrument)) = Collector::instrument_of(first)
        {
            warn_about_memory(self.config, &instrument, args.memory_limit());
        }
        let pace = match (args.step, args.speed) {
            (Some(StepLength(every_s)), _) => {
                let prompt = Box::new(|note: &str| say("step", &Value::Null, note));
                Pace::Steps(Steps { every_s, requests: lines_of_input(), prompt })
            }
            (None, Speed(Some(times))) => Pace::Speed(times),
            (None, Speed(None)) => return Ok(self.run(files, ground, &|| {})?),
        };
        Ok(self.run(PacedSource::new(files, pace), ground, &|| {})?)
    }

    /// Runs the ground segment; `on_started` is called after the signal handlers are installed.
    fn run<S: GroundSource + 'static>(
        &self,
        source: S,
        ground: Ground,
        on_started: &dyn Fn(),
    ) -> Result<RunSummary, PipelineError> {
        let Self { args, config, job, interrupt, page, events } = self;
        let cancel = interrupt.cancel();
        let mut progress = None;
        #[cfg(unix)]
        let mut notifier = None;
        replay(source, config, ground, &args.out, cancel, &mut |handles| {
            interrupt.arm_or_note();
            on_started();
            #[cfg(unix)]
            if args.follow || args.listens() {
                notifier = super::notify::Notifier::start(&handles, cancel);
            }
            page.watch(&handles);
            events.watch(&handles);
            if job.is_first() {
                progress = Some(Progress::watch(handles, READ, 0, cancel));
            }
        })
    }
}

/// Logs an event of a connection.
fn print_listen_note(event: &ListenNote<'_>) {
    match is_json() {
        true => say_entry(
            if event.is_regular() { Level::Info } else { Level::Warn },
            event,
            Some(&event.to_string()),
        ),
        false => print_notes([event]),
    }
}

/// A channel with one message for each line of standard input, until its end.
fn lines_of_input() -> Receiver<()> {
    let (lines, go) = bounded(0);
    // The thread ends with the input or the process, as its read cannot be interrupted.
    std::thread::spawn(move || {
        let mut input = std::io::stdin().lock();
        while let Ok(Some(_)) = next_line(&mut input, 1) {
            if lines.send(()).is_err() {
                return;
            }
        }
    });
    go
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::units::constants::DAY_S;

    #[test]
    fn speeds_and_steps_are_parsed() {
        assert_eq!(speed("max"), Ok(Speed(None)));
        assert_eq!(speed("1000"), Ok(Speed(Some(1000.0))));
        assert_eq!(step("pass"), Ok(StepLength(None)));
        assert_eq!(step("1d"), Ok(StepLength(Some(DAY_S))));
        assert!(["0", "-1", "inf", "NaN", "fast"].iter().all(|text| speed(text).is_err()));
        assert!(["0", "-1d", "file.ccsds", ""].iter().all(|text| step(text).is_err()));
    }
}
