//! `--events`: progress and events of a run, one JSON object a line.
//!
//! A thread of its own writes; the run never waits for it. Maps wait for it in a queue, and those that find it full are counted.

use std::io::Write;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

use clap::Args;
use crossbeam_channel::{Receiver, RecvTimeoutError, Sender, bounded};
use serde::Serialize;
use serde_json::json;

use super::log::{Level, is_json, note, say, say_entry};
use super::output::{CommandError, json_text, print_notes};
use crate::calibration::solver::InstrumentEvent;
use crate::downlink::ReceptionCounters;
use crate::files::growing_file;
use crate::frames::VisibilityReason;
use crate::ground::SavingReport;
use crate::pipeline::{Config, Watched};
use crate::products::{MapViewer, PublishedMap, SnapshotSummary};
use crate::runtime::{LedgerReport, StageProgress};

/// Interval between two lines of progress.
const PROGRESS_EVERY: Duration = Duration::from_secs(1);

/// Maps that may wait to be written.
const WAITING_MAX: usize = 256;

/// Longest wait for a reader of the last line.
const LAST_WAIT: Duration = Duration::from_secs(5);

/// Whether and where a command writes its events.
#[derive(Debug, Args)]
pub(super) struct EventsArgs {
    /// Write progress and events to this file, one JSON object a line; the file is replaced. With - they go to standard output,
    /// which then holds nothing else. The last line has the summary.
    #[arg(long, value_name = "FILE|-")]
    events: Option<PathBuf>,
}

impl EventsArgs {
    /// Whether the events take standard output.
    pub(super) fn take_stdout(&self) -> bool {
        self.events.as_deref() == Some(Path::new("-"))
    }

    /// Opens the file, if one is wanted, and writes the first line, of the `segment` of a chain with this configuration.
    pub(super) fn start(&self, config: &Config, segment: &'static str) -> Result<Events, CommandError> {
        let Some(path) = &self.events else { return Ok(Events { writer: None }) };
        let out: Box<dyn Write + Send> = match self.take_stdout() {
            true => Box::new(std::io::stdout()),
            false => {
                let file = growing_file(path);
                Box::new(file.map_err(|error| format!("cannot write events to {}: {error}", path.display()))?)
            }
        };
        Ok(Events { writer: Some(EventWriter::start(out, config.name.clone(), segment)) })
    }
}

/// The events of a command, if they are wanted.
pub(super) struct Events {
    writer: Option<EventWriter>,
}

impl Events {
    /// The run begins, or a further pass of it.
    pub(super) fn watch(&self, watched: &Watched) {
        let Some(writer) = &self.writer else { return };
        watched.maps.add_viewer(Box::new(writer.viewer()));
        writer.send(Message::Watch(Box::new(watched.clone())));
    }

    /// Writes the last line, with the summary or the error; `cancelled` reads whether the run was ended early.
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
                // A summary that can be written once can be written twice.
                summary: serde_json::to_value(summary).unwrap_or_default(),
            },
            Err(error) => {
                End { status: "failed", error: Some(error.to_string()), summary: serde_json::Value::Null }
            }
        };
        writer.end(end);
    }
}

/// What a line tells, besides when.
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
        /// Maps that were not told of, as nobody read.
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
    /// Something happened to the instrument.
    Instrument {
        what: InstrumentEvent,
    },
    End(&'a End),
}

#[expect(clippy::trivially_copy_pass_by_ref, reason = "serde asks so")]
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
    fn of(map: PublishedMap<'_>) -> Self {
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
    /// As `summary.json` has it; of a simulation, its report. Null if it failed.
    summary: serde_json::Value,
}

/// A line: when, and what.
#[derive(Serialize)]
struct EventLine<'a> {
    /// Seconds since 1970, UTC.
    unix_s: f64,
    elapsed_s: f64,
    #[serde(flatten)]
    entry: Entry<'a>,
}

enum Message {
    Watch(Box<Watched>),
    Map(MapEntry),
    End(Box<End>),
}

/// The thread that writes, and the way to it.
struct EventWriter {
    messages: Sender<Message>,
    untold: Arc<AtomicU64>,
    /// Closes with the thread.
    over: Receiver<()>,
}

impl EventWriter {
    fn start(out: Box<dyn Write + Send>, name: String, segment: &'static str) -> Self {
        let (messages, received) = bounded(WAITING_MAX);
        let (is_alive, over) = bounded(0);
        let untold = Arc::new(AtomicU64::new(0));
        let lines = Lines { out, since: Instant::now(), failed: 0 };
        let counted = Arc::clone(&untold);
        std::thread::spawn(move || {
            write_events(lines, &name, segment, &received, &counted);
            drop(is_alive);
        });
        Self { messages, untold, over }
    }

    fn viewer(&self) -> EventViewer {
        EventViewer { messages: self.messages.clone(), untold: Arc::clone(&self.untold) }
    }

    fn send(&self, message: Message) {
        // Nobody takes it if the reader has gone, and the run goes on; a reader that is late is given a moment.
        let _ = self.messages.send_timeout(message, LAST_WAIT);
    }

    fn end(self, end: End) {
        self.send(Message::End(Box::new(end)));
        if matches!(self.over.recv_timeout(LAST_WAIT), Err(RecvTimeoutError::Timeout)) {
            print_notes(["nobody reads the events; their last lines are not written"]);
        }
    }
}

/// Sees maps for the events.
struct EventViewer {
    messages: Sender<Message>,
    untold: Arc<AtomicU64>,
}

impl MapViewer for EventViewer {
    fn view(&self, map: PublishedMap<'_>) {
        let entry = MapEntry::of(map);
        if self.messages.try_send(Message::Map(entry)).is_err() {
            self.untold.fetch_add(1, Ordering::Relaxed);
        }
    }
}

/// The file, line by line.
struct Lines {
    out: Box<dyn Write + Send>,
    since: Instant,
    /// Lines that could not be written since the last one that could.
    failed: u64,
}

impl Lines {
    /// Writes a line at once.
    fn write(&mut self, entry: Entry<'_>) -> std::io::Result<()> {
        let unix_s = SystemTime::now().duration_since(UNIX_EPOCH).map_or(0.0, |since| since.as_secs_f64());
        let line = EventLine { unix_s, elapsed_s: self.since.elapsed().as_secs_f64(), entry };
        let text = json_text(&line).map_err(std::io::Error::other)?;
        // After a line that was cut off another begins.
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

/// What has been told of a run.
#[derive(Default)]
struct EventsReported {
    ended: Vec<bool>,
    saving: SavingReport,
    instrument: usize,
}

/// Writes until the end, or until nobody reads.
fn write_events(
    mut lines: Lines,
    name: &str,
    segment: &'static str,
    messages: &Receiver<Message>,
    untold: &AtomicU64,
) {
    let mut watched: Option<Watched> = None;
    let mut told = EventsReported::default();
    let mut write = || -> std::io::Result<()> {
        lines.write(Entry::Begin { version: env!("CARGO_PKG_VERSION"), name, segment })?;
        let mut next = Instant::now() + PROGRESS_EVERY;
        loop {
            match messages.recv_deadline(next) {
                Ok(Message::Watch(new)) => (watched, told) = (Some(*new), EventsReported::default()),
                Ok(Message::Map(map)) => lines.write(Entry::Map(map))?,
                Ok(Message::End(end)) => {
                    if let Some(watched) = &watched {
                        progress(&mut lines, watched, &mut told, untold)?;
                    }
                    return lines.write(Entry::End(&end));
                }
                Err(RecvTimeoutError::Timeout) => {
                    if let Some(watched) = &watched {
                        progress(&mut lines, watched, &mut told, untold)?;
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

/// Writes what has happened since the last time, and the counts.
fn progress(
    lines: &mut Lines,
    watched: &Watched,
    told: &mut EventsReported,
    untold: &AtomicU64,
) -> std::io::Result<()> {
    let stages = watched.metrics.snapshot();
    told.ended.resize(stages.len(), false);
    for (was, stage) in told.ended.iter_mut().zip(&stages) {
        if stage.ended && !std::mem::replace(was, stage.ended) {
            lines.write(Entry::StageEnded { stage: &stage.name })?;
        }
    }
    let ground = watched.ground.as_ref();
    if let Some(saving) = ground.and_then(|ground| ground.saving.report()) {
        if (saving.written, saving.failed) != (told.saving.written, told.saving.failed) {
            lines.write(Entry::Checkpoint { saving: saving.clone() })?;
        }
        told.saving = saving;
    }
    let gains = ground.and_then(|ground| ground.gains.as_ref());
    for what in gains.map(|gains| gains.events_since(told.instrument)).unwrap_or_default() {
        lines.write(Entry::Instrument { what })?;
        told.instrument += 1;
    }
    lines.write(counts_of(watched, &stages, untold.load(Ordering::Relaxed)))
}

/// What a line of progress tells.
fn counts_of(watched: &Watched, stages: &[StageProgress], untold: u64) -> Entry<'static> {
    let ground = watched.ground.as_ref();
    let reception = ground.map(|ground| {
        let counters = ground.reception.lock();
        Box::new(counters.unwrap_or_else(std::sync::PoisonError::into_inner).clone())
    });
    let solving = watched.solving.progress().map(|solving| SolveCount {
        what: solving.what,
        iteration: solving.iteration,
        residual: solving.residual,
        target: solving.target,
    });
    Entry::Progress {
        stages: stages.iter().map(StageCount::from).collect(),
        ledger: ground.map(|ground| ground.ledger.report()),
        reception,
        senders: watched.listening.as_ref().map(|listening| listening.status.open()),
        solving,
        untold,
    }
}

/// What the log has been told of a run.
#[derive(Default)]
pub(super) struct LogState {
    told: EventsReported,
    products: Option<String>,
    archive: Option<String>,
}

impl LogState {
    /// Says what has happened since the last time: troubles and their ends; for programs everything that `--events` has.
    pub(super) fn tell(&mut self, watched: &Watched) {
        let stages = watched.metrics.snapshot();
        self.told.ended.resize(stages.len(), false);
        for (was, stage) in self.told.ended.iter_mut().zip(&stages) {
            if stage.ended && !std::mem::replace(was, true) && is_json() {
                say_entry(Level::Info, &Entry::StageEnded { stage: &stage.name }, None);
            }
        }
        if let Some(saving) = watched.ground.as_ref().and_then(|ground| ground.saving.report()) {
            self.tell_saving(saving);
        }
        if let Some(products) = &watched.products {
            let now = products.report().unwritten;
            tell_trouble("products", "maps", &mut self.products, now);
        }
        let archive = watched.listening.as_ref().and_then(|listening| listening.archive.as_ref());
        if let Some(archive) = archive {
            let now = archive.report().unwritten;
            tell_trouble("archive", "the raw archive, and nothing is taken: packets", &mut self.archive, now);
        }
    }

    fn tell_saving(&mut self, saving: SavingReport) {
        let before = std::mem::replace(&mut self.told.saving, saving);
        let now = &self.told.saving;
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

/// Says that something cannot be written, and when it can be again.
fn tell_trouble(event: &str, what: &str, before: &mut Option<String>, now: Option<String>) {
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

/// Sees maps for the log of programs.
pub(super) struct LogViewer;

impl MapViewer for LogViewer {
    fn view(&self, map: PublishedMap<'_>) {
        say_entry(Level::Info, &Entry::Map(MapEntry::of(map)), None);
    }
}

/// A line of progress for the log.
#[derive(Serialize)]
pub(super) struct ProgressLine {
    elapsed_s: f64,
    #[serde(flatten)]
    entry: Entry<'static>,
}

/// The progress of a run that has lasted so long.
pub(super) fn progress_of(watched: &Watched, elapsed: Duration) -> ProgressLine {
    let entry = counts_of(watched, &watched.metrics.snapshot(), 0);
    ProgressLine { elapsed_s: elapsed.as_secs_f64(), entry }
}
