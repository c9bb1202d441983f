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
use super::log::{Level, is_json, note, say, say_entry};
use super::output::{CommandError, cannot_write, json_text, print_notes};
use crate::calibration::FoundBurst;
use crate::calibration::solver::InstrumentEvent;
use crate::downlink::ReceptionCounters;
use crate::files::{ProtectedInputs, growing_file, is_same_name};
use crate::frames::VisibilityReason;
use crate::ground::SavingReport;
use crate::pipeline::{Config, RunHandles};
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

    /// Opens the output, if it is requested, and writes the first line. `outputs` are the main files of the command, which it must
    /// not name.
    pub(super) fn start(
        &self,
        config: &Config,
        segment: &'static str,
        outputs: &[PathBuf],
    ) -> Result<Events, CommandError> {
        let Some(path) = &self.events else {
            return Ok(Events { writer: None, _file: ProtectedInputs::default() });
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
        let writer = Some(EventWriter::start(out, config.name.clone(), segment));
        Ok(Events { writer, _file: ProtectedInputs::of([path]) })
    }
}

/// The output of events of a command, if it is requested.
pub(super) struct Events {
    writer: Option<EventWriter>,
    /// No product takes the place of the file.
    _file: ProtectedInputs,
}

impl Events {
    /// Starts to report a graph: the run, or a further reading of it.
    pub(super) fn watch(&self, handles: &RunHandles) {
        let Some(writer) = &self.writer else { return };
        handles.maps.add_viewer(Box::new(writer.viewer()));
        writer.send(Message::Watch(Box::new(handles.clone())));
    }

    /// Writes the last line, with the summary or the error; `cancelled` tells whether a summary is of a cancelled run.
    pub(super) fn conclude<T: Serialize>(
        self,
        result: &Result<T, CommandError>,
        cancelled: impl FnOnce(&T) -> bool,
    ) {
        let Some(writer) = self.writer else { return };
        let end = match result {
            Ok(summary) => End {
                status: if cancelled(summary) { "cancelled" } else { "complete" },
                error: None,
                // A summary always has a JSON form.
                summary: serde_json::to_value(summary).unwrap_or_default(),
            },
            Err(error) => {
                End { status: "failed", error: Some(error.to_string()), summary: serde_json::Value::Null }
            }
        };
        writer.end(end);
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
        what: FoundBurst,
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
    Watch(Box<RunHandles>),
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

/// State of a run that has been reported.
#[derive(Default)]
struct ReportedState {
    ended: Vec<bool>,
    saving: SavingReport,
    instrument: usize,
    bursts: usize,
}

/// Writes events until the end of the run, or until the reader is gone.
fn write_events(
    mut lines: EventLines,
    name: &str,
    segment: &'static str,
    messages: &Receiver<Message>,
    dropped: &AtomicU64,
) {
    let mut handles: Option<RunHandles> = None;
    let mut reported = ReportedState::default();
    let mut write = || -> std::io::Result<()> {
        lines.write(Entry::Begin { version: env!("CARGO_PKG_VERSION"), name, segment })?;
        let mut next = Instant::now() + PROGRESS_EVERY;
        loop {
            match messages.recv_deadline(next) {
                Ok(Message::Watch(new)) => (handles, reported) = (Some(*new), ReportedState::default()),
                Ok(Message::Map(map)) => lines.write(Entry::Map(map))?,
                Ok(Message::End(end)) => {
                    if let Some(handles) = &handles {
                        write_progress(&mut lines, handles, &mut reported, dropped)?;
                    }
                    return lines.write(Entry::End(&end));
                }
                Err(RecvTimeoutError::Timeout) => {
                    if let Some(handles) = &handles {
                        write_progress(&mut lines, handles, &mut reported, dropped)?;
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
    handles: &RunHandles,
    reported: &mut ReportedState,
    dropped: &AtomicU64,
) -> std::io::Result<()> {
    let stages = handles.metrics.snapshot();
    reported.ended.resize(stages.len(), false);
    for (had_ended, stage) in reported.ended.iter_mut().zip(&stages) {
        if stage.ended && !std::mem::replace(had_ended, stage.ended) {
            lines.write(Entry::StageEnded { stage: &stage.name })?;
        }
    }
    let ground = handles.ground.as_ref();
    if let Some(saving) = ground.and_then(|ground| ground.saving.report()) {
        if (saving.written, saving.failed) != (reported.saving.written, reported.saving.failed) {
            lines.write(Entry::Checkpoint { saving: saving.clone() })?;
        }
        reported.saving = saving;
    }
    let gains = ground.and_then(|ground| ground.gains.as_ref());
    for what in gains.map(|gains| gains.events_since(reported.instrument)).unwrap_or_default() {
        lines.write(Entry::Instrument { what })?;
        reported.instrument += 1;
    }
    for what in ground.map(|ground| ground.bursts.since(reported.bursts)).unwrap_or_default() {
        lines.write(Entry::Burst { what })?;
        reported.bursts += 1;
    }
    lines.write(progress_entry(handles, &stages, dropped.load(Ordering::Relaxed)))
}

/// Content of a progress line; `untold` is the number of dropped maps.
fn progress_entry(handles: &RunHandles, stages: &[StageProgress], untold: u64) -> Entry<'static> {
    let ground = handles.ground.as_ref();
    let reception = ground.map(|ground| {
        let counters = ground.reception.lock();
        Box::new(counters.unwrap_or_else(std::sync::PoisonError::into_inner).clone())
    });
    let solving = handles.solving.progress().map(|solving| SolveCount {
        what: solving.what,
        iteration: solving.iteration,
        residual: solving.residual,
        target: solving.target,
    });
    Entry::Progress {
        stages: stages.iter().map(StageCount::from).collect(),
        ledger: ground.map(|ground| ground.ledger.report()),
        reception,
        senders: handles.listening.as_ref().map(|listening| listening.status.open()),
        solving,
        untold,
    }
}

/// State of a run that has been logged.
#[derive(Default)]
pub(super) struct LogState {
    reported: ReportedState,
    products: Option<String>,
    archive: Option<String>,
}

impl LogState {
    /// Logs the changes since the last call: failures to write and their ends; as JSON, all events of `--events`.
    pub(super) fn log_changes(&mut self, handles: &RunHandles) {
        let stages = handles.metrics.snapshot();
        self.reported.ended.resize(stages.len(), false);
        for (had_ended, stage) in self.reported.ended.iter_mut().zip(&stages) {
            if stage.ended && !std::mem::replace(had_ended, true) && is_json() {
                say_entry(Level::Info, &Entry::StageEnded { stage: &stage.name }, None);
            }
        }
        let bursts = handles.ground.as_ref().map(|ground| ground.bursts.since(self.reported.bursts));
        for what in bursts.unwrap_or_default() {
            say("burst", &json!({ "what": what }), &what);
            self.reported.bursts += 1;
        }
        if let Some(saving) = handles.ground.as_ref().and_then(|ground| ground.saving.report()) {
            self.log_saving(saving);
        }
        if let Some(products) = &handles.products {
            let now = products.report().unwritten;
            log_failure_change("products", "maps", &mut self.products, now);
        }
        let archive = handles.listening.as_ref().and_then(|listening| listening.archive.as_ref());
        if let Some(archive) = archive {
            let now = archive.report().unwritten;
            let what = "the raw archive, and nothing is taken: packets";
            log_failure_change("archive", what, &mut self.archive, now);
        }
    }

    fn log_saving(&mut self, saving: SavingReport) {
        let before = std::mem::replace(&mut self.reported.saving, saving);
        let now = &self.reported.saving;
        if (before.written, before.failed) == (now.written, now.failed) {
            return;
        }
        let level = if now.unsaved.is_some() { Level::Warn } else { Level::Info };
        if is_json() {
            return say_entry(level, &Entry::Checkpoint { saving: now.clone() }, Some(&now.to_string()));
        }
        match (&before.unsaved, &now.unsaved) {
            (None, Some(_)) | (Some(_), None) => print_notes([now.to_string()]),
            _ => {}
        }
    }
}

/// Logs when writing `what` begins to fail, and when it works again.
fn log_failure_change(event: &str, what: &str, before: &mut Option<String>, now: Option<String>) {
    match (&before, &now) {
        (None, Some(reason)) => {
            note(event, &json!({ "unwritten": reason }), format_args!("{what} cannot be written: {reason}"));
        }
        (Some(_), None) => {
            say(event, &json!({ "unwritten": null }), format_args!("{what} are written again"))
        }
        _ => {}
    }
    *before = now;
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
pub(super) fn progress_line(handles: &RunHandles, elapsed: Duration) -> ProgressLine {
    let entry = progress_entry(handles, &handles.metrics.snapshot(), 0);
    ProgressLine { elapsed_s: elapsed.as_secs_f64(), entry }
}
