//! `--events`: progress and events of a run, one JSON object per line.
//!
//! A separate thread writes them, and the run never waits for it. Maps are dropped and counted if the queue to the thread is full.

use std::io::Write;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

use clap::Args;
use crossbeam_channel::{Receiver, RecvTimeoutError, Sender, bounded};
use serde::Serialize;
use serde_json::json;

use super::arguments::output_or_standard;
use super::log::{Level, is_json, log_json, note, say, say_entry};
use super::output::{CommandError, cannot_write, json_text, print_notes};
use crate::calibration::solver::InstrumentEvent;
use crate::calibration::{BurstAlert, FoundBurst};
use crate::downlink::ReceptionCounters;
use crate::files::{ProtectedInputs, growing_file, is_same_name};
use crate::frames::VisibilityReason;
use crate::ground::SavingReport;
use crate::pipeline::{Change, Config, RunChanges, RunView};
use crate::products::{MapViewer, PublishedMap, SnapshotSummary};
use crate::runtime::{LedgerReport, StageProgress};

const PROGRESS_EVERY: Duration = Duration::from_secs(1);

/// Capacity of the queue to the writing thread.
const QUEUED_MAX: usize = 256;

/// Time limit for the writing thread to take a message and to end.
const WRITE_TIMEOUT: Duration = Duration::from_secs(5);

/// Arguments for the output of events.
#[derive(Debug, Args)]
pub(super) struct EventsArgs {
    /// Write progress and events to this file, one JSON object per line; the file is replaced. With - they go to standard output,
    /// which then holds nothing else. The last line has the summary.
    #[arg(long, value_name = "FILE|-", value_parser = output_or_standard())]
    events: Option<PathBuf>,
}

impl EventsArgs {
    /// Whether the events go to standard output.
    pub(super) fn take_stdout(&self) -> bool {
        self.events.as_deref() == Some(Path::new("-"))
    }

    /// The file, if the events go to one.
    pub(super) fn file(&self) -> Option<&Path> {
        self.events.as_deref().filter(|_| !self.take_stdout())
    }

    /// Opens the output, if it is requested, and writes the first line, also of a log in JSON if `is_logging`. `outputs` are the main
    /// files of the command, which it must not name.
    pub(super) fn start(
        &self,
        config: &Config,
        segment: &'static str,
        outputs: &[PathBuf],
        is_logging: bool,
    ) -> Result<Events, CommandError> {
        let is_logged = is_logging && is_json();
        let log_begin = || {
            if is_logged {
                let (version, name) = (env!("CARGO_PKG_VERSION"), config.name.as_str());
                say_entry(Level::Info, &Entry::Begin { version, name, segment }, None);
            }
        };
        let Some(path) = &self.events else {
            log_begin();
            return Ok(Events { writer: None, is_logged, _file: ProtectedInputs::default() });
        };
        if outputs.iter().any(|output| is_same_name(output, path)) {
            let path = path.display();
            return Err(format!(
                "--events {path}: the command writes another output there; expected another name"
            )
            .into());
        }
        let out: Box<dyn Write + Send> = match self.take_stdout() {
            true => Box::new(std::io::stdout()),
            false => Box::new(growing_file(path).map_err(cannot_write(path))?),
        };
        log_begin();
        let writer = Some(EventWriter::start(out, config.name.clone(), segment));
        Ok(Events { writer, is_logged, _file: ProtectedInputs::of([path]) })
    }
}

/// The output of events of a command, if it is requested, and the first and last line of a log in JSON.
pub(super) struct Events {
    writer: Option<EventWriter>,
    is_logged: bool,
    /// No product takes the place of the file.
    _file: ProtectedInputs,
}

impl Events {
    /// Starts to report a graph: the run, or a further reading of it.
    pub(super) fn watch(&self, view: &RunView) {
        let Some(writer) = &self.writer else { return };
        view.maps.add_viewer(Box::new(writer.viewer()));
        writer.send(Message::Watch(Box::new(view.clone())));
    }

    /// Writes the last line, with the summary or the error; `cancelled` tells whether a summary is of a cancelled run.
    pub(super) fn conclude<T: Serialize>(
        self,
        result: &Result<T, CommandError>,
        cancelled: impl FnOnce(&T) -> bool,
    ) {
        let (status, error) = match result {
            Ok(summary) => (if cancelled(summary) { "cancelled" } else { "complete" }, None),
            Err(error) => ("failed", Some(error.to_string())),
        };
        if self.is_logged {
            // Without the summary, which is too long for a line of a log.
            log_json(Level::Info, "end", &json!({ "status": status }), error.as_deref());
        }
        if let Some(writer) = self.writer {
            // A summary always has a JSON form.
            let summary = result.as_ref().ok().and_then(|summary| serde_json::to_value(summary).ok());
            writer.end(End { status, error, summary: summary.unwrap_or_default() });
        }
    }
}

/// Content of a line, without its time.
#[derive(Debug, Serialize)]
#[serde(tag = "event", rename_all = "kebab-case")]
enum Entry<'a> {
    Begin {
        version: &'static str,
        name: &'a str,
        segment: &'static str,
    },
    Progress {
        stages: Vec<StageCount>,
        #[serde(skip_serializing_if = "Option::is_none")]
        ledger: Option<LedgerReport<VisibilityReason>>,
        #[serde(skip_serializing_if = "Option::is_none")]
        reception: Option<Box<ReceptionCounters>>,
        #[serde(skip_serializing_if = "Option::is_none")]
        senders: Option<usize>,
        #[serde(skip_serializing_if = "Option::is_none")]
        solving: Option<SolveCount>,
        /// Number of maps that were dropped because the queue was full.
        #[serde(skip_serializing_if = "is_zero")]
        untold: u64,
    },
    Map(MapEntry),
    Checkpoint {
        #[serde(flatten)]
        saving: SavingReport,
    },
    StageEnded {
        stage: &'a str,
    },
    /// An event of the instrument, found by calibration.
    Instrument {
        what: InstrumentEvent,
    },
    /// A burst of a point source, found in a pass that has ended.
    Burst {
        what: Box<FoundBurst>,
    },
    /// There may be a burst in a pass that goes on.
    BurstAlert {
        what: BurstAlert,
    },
    End(&'a End),
}

#[expect(clippy::trivially_copy_pass_by_ref, reason = "serde requires a reference")]
fn is_zero(count: &u64) -> bool {
    *count == 0
}

#[derive(Debug, Serialize)]
struct StageCount {
    name: String,
    items_in: u64,
    items_out: u64,
    units: u64,
    unit: &'static str,
    ended: bool,
}

impl From<&StageProgress> for StageCount {
    fn from(stage: &StageProgress) -> Self {
        let StageProgress { name, items_in, items_out, units, ended, .. } = stage;
        let (name, units, unit) = (name.clone(), units.count, units.name);
        Self { name, items_in: *items_in, items_out: *items_out, units, unit, ended: *ended }
    }
}

#[derive(Debug, Serialize)]
struct SolveCount {
    what: String,
    iteration: usize,
    residual: f64,
    target: f64,
}

#[derive(Debug, Serialize)]
struct MapEntry {
    channel: u16,
    frequency_hz: f64,
    is_final: bool,
    #[serde(flatten)]
    figures: SnapshotSummary,
}

impl MapEntry {
    fn new(map: PublishedMap<'_>) -> Self {
        let PublishedMap { solution, figures, .. } = map;
        let index = usize::from(solution.channel.0);
        Self {
            channel: solution.channel.0,
            frequency_hz: solution.instrument.channels.get(index).map_or(0.0, |c| c.frequency_hz),
            is_final: solution.is_final_map(),
            figures: figures.clone(),
        }
    }
}

#[derive(Debug, Serialize)]
struct End {
    /// `complete`, `cancelled` or `failed`.
    status: &'static str,
    #[serde(skip_serializing_if = "Option::is_none")]
    error: Option<String>,
    /// Content of `summary.json`, or the report of a simulation; null after a failure.
    summary: serde_json::Value,
}

/// A line of the output.
#[derive(Serialize)]
struct EventLine<'a> {
    unix_s: f64,
    elapsed_s: f64,
    #[serde(flatten)]
    entry: Entry<'a>,
}

enum Message {
    Watch(Box<RunView>),
    Map(MapEntry),
    End(Box<End>),
}

/// Handle of the writing thread.
struct EventWriter {
    messages: Sender<Message>,
    dropped: Arc<AtomicU64>,
    /// Disconnects when the thread ends.
    thread_end: Receiver<()>,
}

impl EventWriter {
    fn start(out: Box<dyn Write + Send>, name: String, segment: &'static str) -> Self {
        let (messages, received) = bounded(QUEUED_MAX);
        let (end_sender, thread_end) = bounded(0);
        let dropped = Arc::new(AtomicU64::new(0));
        let lines = EventLines { out, since: Instant::now(), failed: 0 };
        let dropped_count = Arc::clone(&dropped);
        std::thread::spawn(move || {
            write_events(lines, &name, segment, &received, &dropped_count);
            drop(end_sender);
        });
        Self { messages, dropped, thread_end }
    }

    fn viewer(&self) -> EventViewer {
        EventViewer { messages: self.messages.clone(), dropped: Arc::clone(&self.dropped) }
    }

    fn send(&self, message: Message) {
        // An error is ignored: the run continues without a reader. A slow reader gets some time.
        let _ = self.messages.send_timeout(message, WRITE_TIMEOUT);
    }

    fn end(self, end: End) {
        self.send(Message::End(Box::new(end)));
        if matches!(self.thread_end.recv_timeout(WRITE_TIMEOUT), Err(RecvTimeoutError::Timeout)) {
            print_notes(["nobody reads the events; their last lines are not written"]);
        }
    }
}

/// Receives maps for the events.
struct EventViewer {
    messages: Sender<Message>,
    dropped: Arc<AtomicU64>,
}

impl MapViewer for EventViewer {
    fn view(&self, map: PublishedMap<'_>) {
        let entry = MapEntry::new(map);
        if self.messages.try_send(Message::Map(entry)).is_err() {
            self.dropped.fetch_add(1, Ordering::Relaxed);
        }
    }
}

struct EventLines {
    out: Box<dyn Write + Send>,
    since: Instant,
    /// Number of lines that could not be written since the last success.
    failed: u64,
}

impl EventLines {
    fn write(&mut self, entry: Entry<'_>) -> std::io::Result<()> {
        let unix_s = SystemTime::now().duration_since(UNIX_EPOCH).map_or(0.0, |since| since.as_secs_f64());
        let line = EventLine { unix_s, elapsed_s: self.since.elapsed().as_secs_f64(), entry };
        let text = json_text(&line).map_err(std::io::Error::other)?;
        // The last failed line may be incomplete.
        let before = if self.failed > 0 { "\n" } else { "" };
        let written =
            self.out.write_all(format!("{before}{text}\n").as_bytes()).and_then(|()| self.out.flush());
        match written {
            Err(error) if error.kind() == std::io::ErrorKind::BrokenPipe => return Err(error),
            Err(error) => {
                self.failed += 1;
                if self.failed == 1 {
                    let fields = json!({ "unwritten": error.to_string() });
                    note(
                        "events",
                        &fields,
                        format_args!("events cannot be written: {error}; the run goes on"),
                    );
                }
            }
            Ok(()) if self.failed > 0 => {
                let failed = std::mem::take(&mut self.failed);
                say(
                    "events",
                    &json!({ "failed": failed }),
                    format_args!("events are written again; {failed} lines are missing"),
                );
            }
            Ok(()) => {}
        }
        Ok(())
    }
}

/// Writes events until the end of the run, or until the reader is gone.
fn write_events(
    mut lines: EventLines,
    name: &str,
    segment: &'static str,
    messages: &Receiver<Message>,
    dropped: &AtomicU64,
) {
    let mut view: Option<RunView> = None;
    let mut told = RunChanges::default();
    let mut write = || -> std::io::Result<()> {
        lines.write(Entry::Begin { version: env!("CARGO_PKG_VERSION"), name, segment })?;
        let mut next = Instant::now() + PROGRESS_EVERY;
        loop {
            match messages.recv_deadline(next) {
                Ok(Message::Watch(new)) => (view, told) = (Some(*new), RunChanges::default()),
                Ok(Message::Map(map)) => lines.write(Entry::Map(map))?,
                Ok(Message::End(end)) => {
                    if let Some(view) = &view {
                        write_progress(&mut lines, view, &mut told, dropped)?;
                    }
                    return lines.write(Entry::End(&end));
                }
                Err(RecvTimeoutError::Timeout) => {
                    if let Some(view) = &view {
                        write_progress(&mut lines, view, &mut told, dropped)?;
                    }
                    next = Instant::now() + PROGRESS_EVERY;
                }
                Err(RecvTimeoutError::Disconnected) => return Ok(()),
            }
        }
    };
    if let Err(error) = write() {
        print_notes([format!("no more events are written: {error}; the run goes on")]);
    }
}

/// Writes the events since the last call, and the counts.
fn write_progress(
    lines: &mut EventLines,
    view: &RunView,
    told: &mut RunChanges,
    dropped: &AtomicU64,
) -> std::io::Result<()> {
    let stages = view.stages();
    for change in told.next(view, &stages) {
        if let Some(entry) = Entry::of_change(&change) {
            lines.write(entry)?;
        }
    }
    lines.write(progress_entry(view, &stages, dropped.load(Ordering::Relaxed)))
}

impl<'a> Entry<'a> {
    /// The event of a change; `None` for failures to write, which are of the log only.
    fn of_change(change: &'a Change) -> Option<Self> {
        Some(match change {
            Change::StageEnded(stage) => Self::StageEnded { stage },
            Change::Saving { now, .. } => Self::Checkpoint { saving: now.clone() },
            Change::Instrument(what) => Self::Instrument { what: what.clone() },
            Change::Burst(what) => Self::Burst { what: what.clone() },
            Change::BurstAlert(what) => Self::BurstAlert { what: what.clone() },
            Change::Products(_) | Change::Archive(_) => return None,
        })
    }
}

/// Content of a progress line; `untold` is the number of dropped maps.
fn progress_entry(view: &RunView, stages: &[StageProgress], untold: u64) -> Entry<'static> {
    let solving = view.solving.progress().map(|solving| SolveCount {
        what: solving.what,
        iteration: solving.iteration,
        residual: solving.residual,
        target: solving.target,
    });
    Entry::Progress {
        stages: stages.iter().map(StageCount::from).collect(),
        ledger: view.ground.as_ref().map(|ground| ground.ledger.report()),
        reception: view.reception().map(Box::new),
        senders: view.listening.as_ref().map(|listening| listening.status.open()),
        solving,
        untold,
    }
}

/// Logs a change: failures to write and their ends; as JSON, all events of `--events`.
pub(super) fn log_change(change: &Change) {
    match change {
        Change::StageEnded(stage) if is_json() => {
            say_entry(Level::Info, &Entry::StageEnded { stage }, None);
        }
        Change::StageEnded(_) => {}
        Change::Saving { before, now } => log_saving(before, now),
        Change::Instrument(what) => say("instrument", &json!({ "what": what }), what),
        Change::Burst(what) => say("burst", &json!({ "what": what }), what),
        Change::BurstAlert(what) => say("burst-alert", &json!({ "what": what }), what),
        Change::Products(now) => log_failure_change("products", "maps", now.as_ref()),
        Change::Archive(now) => {
            log_failure_change("archive", "the raw archive, and nothing is taken: packets", now.as_ref());
        }
    }
}

fn log_saving(before: &SavingReport, now: &SavingReport) {
    let level = if now.unsaved.is_some() { Level::Warn } else { Level::Info };
    if is_json() {
        return say_entry(level, &Entry::Checkpoint { saving: now.clone() }, Some(&now.to_string()));
    }
    if before.unsaved.is_some() != now.unsaved.is_some() {
        print_notes([now.to_string()]);
    }
}

/// Logs that writing `what` begins to fail, or works again.
fn log_failure_change(event: &str, what: &str, now: Option<&String>) {
    match now {
        Some(reason) => {
            note(event, &json!({ "unwritten": reason }), format_args!("{what} cannot be written: {reason}"));
        }
        None => say(event, &json!({ "unwritten": null }), format_args!("{what} are written again")),
    }
}

/// Receives maps for the log in JSON.
pub(super) struct LogViewer;

impl MapViewer for LogViewer {
    fn view(&self, map: PublishedMap<'_>) {
        say_entry(Level::Info, &Entry::Map(MapEntry::new(map)), None);
    }
}

/// A progress line of the log.
#[derive(Serialize)]
pub(super) struct ProgressLine {
    elapsed_s: f64,
    #[serde(flatten)]
    entry: Entry<'static>,
}

/// The progress line of a run that has lasted `elapsed`.
pub(super) fn progress_line(view: &RunView, elapsed: Duration) -> ProgressLine {
    let entry = progress_entry(view, &view.stages(), 0);
    ProgressLine { elapsed_s: elapsed.as_secs_f64(), entry }
}
