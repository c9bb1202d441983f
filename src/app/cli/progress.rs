//! Progress of long runs: a bar on a terminal, plain lines otherwise, or lines for programs (`--log json`).

use std::io::IsTerminal;
use std::sync::mpsc::{RecvTimeoutError, Sender, channel};
use std::sync::{Mutex, PoisonError};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use indicatif::{DecimalBytes, HumanCount, ProgressBar, ProgressStyle};
use serde_json::{Value, json};

use super::events::{LogViewer, log_change, progress_line};
use super::interrupt::Interrupt;
use super::log::{Level, is_json, print_line, say, say_entry};
use crate::downlink::transport::socket::ListenStatus;
use crate::imaging::ChannelGroup;
use crate::imaging::{SolutionClock, SolveWatch, Solving, SolvingPart};
use crate::pipeline::{
    CalibrateProgress, ChannelCost, INTEGRATE, JobEvent, MERGE, Plan, READ, RunChanges, RunGroups, RunView,
};
use crate::runtime::Cancel;
use crate::units::ChannelId;

/// Interval of refreshes on a terminal, and of checks for cancellation.
const POLL: Duration = Duration::from_millis(200);
/// Interval of lines of progress.
pub(super) const LINE_EVERY: Duration = Duration::from_secs(10);

/// Interval between lines of the propagation of orbits.
const PROPAGATION_EVERY: Duration = Duration::from_secs(3);

const INTERRUPTED: &str =
    "\ninterrupted: finishing with the data so far (interrupt again to stop immediately)";

/// Logs the progress of the propagation of orbits, at most every few seconds; `days` of `of_days` are done.
pub(super) fn say_propagation(days: f64, of_days: f64) {
    static LAST: Mutex<Option<Instant>> = Mutex::new(None);
    let mut last = LAST.lock().unwrap_or_else(PoisonError::into_inner);
    // The first call starts an interval, so that a short propagation logs nothing.
    let since = last.get_or_insert_with(Instant::now);
    if since.elapsed() >= PROPAGATION_EVERY {
        *since = Instant::now();
        let fields = json!({ "days": days, "of_days": of_days });
        say("propagation", &fields, format_args!("orbits propagated: {days:.0} of {of_days:.0} days"));
    }
}

/// Shows the progress of a running graph until dropped.
pub(super) struct Progress {
    stop: Sender<()>,
    thread: Option<JoinHandle<()>>,
}

impl Progress {
    /// Starts to show the progress of `stage` through `total` items (0 if unknown); also logs events, and when the run is cancelled.
    pub(super) fn watch(handles: RunView, stage: &'static str, total: u64, cancel: &Cancel) -> Self {
        let (stop, stopped) = channel();
        let cancel = cancel.clone();
        if is_json() {
            handles.maps.add_viewer(Box::new(LogViewer));
        }
        let thread = std::thread::spawn(move || {
            let mut view = ProgressView::new(total);
            let every = if view.bar.is_some() { POLL } else { LINE_EVERY };
            let (mut last, mut is_reported) = (Instant::now(), false);
            loop {
                let is_over = !matches!(stopped.recv_timeout(POLL), Err(RecvTimeoutError::Timeout));
                if !is_reported && cancel.is_cancelled() {
                    say("interrupted", &Value::Null, INTERRUPTED);
                    is_reported = true;
                }
                view.log_events(&handles);
                if is_over {
                    if is_json() {
                        view.show(&handles, stage);
                    }
                    break;
                }
                if last.elapsed() >= every {
                    view.show(&handles, stage);
                    last = Instant::now();
                }
            }
            if let Some(bar) = view.bar {
                bar.finish_and_clear();
            }
        });
        Self { stop, thread: Some(thread) }
    }
}

impl Drop for Progress {
    fn drop(&mut self) {
        // If the thread has already ended, the message is not needed.
        let _ = self.stop.send(());
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}

/// Runs `work`, and logs every few seconds the progress of the solution.
pub(super) fn while_solving<T>(watch: &SolveWatch, work: impl FnOnce() -> T) -> T {
    let (stop, stopped) = channel::<()>();
    std::thread::scope(|scope| {
        scope.spawn(move || {
            let mut view = ProgressView::new(0);
            while matches!(stopped.recv_timeout(LINE_EVERY), Err(RecvTimeoutError::Timeout)) {
                if let Some(solving) = watch.progress() {
                    let Solving { what, iteration, residual, target, .. } = &solving;
                    let fields =
                        json!({ "what": what, "iteration": iteration, "residual": residual, "target": target });
                    say("solving", &fields, view.solution(&solving));
                }
            }
        });
        let result = work();
        drop(stop);
        result
    })
}

/// Logs the progress of a calibration.
pub(super) struct CalibrateLines {
    last: Instant,
    /// Start and number of the round; `None` while its maps are made.
    round: Option<(Instant, u32)>,
}

impl CalibrateLines {
    pub(super) fn new() -> Self {
        let now = Instant::now();
        Self { last: now, round: Some((now, 0)) }
    }

    /// Logs the progress, at most every ten seconds.
    pub(super) fn show(&mut self, progress: &CalibrateProgress) {
        let &CalibrateProgress { round, last_round, passes, read } = progress;
        let of_rounds =
            if last_round > 0 { format!(", round {round} of {last_round}") } else { String::new() };
        let Some(passes) = passes else {
            self.round = None;
            say("progress", &json!(progress), format_args!("  gains{of_rounds}: making maps"));
            return;
        };
        let started = match self.round {
            Some((started, current)) if current == round => started,
            _ => self.round.insert((Instant::now(), round)).0,
        };
        if self.last.elapsed() < LINE_EVERY || read <= 0.0 {
            return;
        }
        self.last = Instant::now();
        let left_s = started.elapsed().as_secs_f64() * (1.0 / read - 1.0).max(0.0);
        let percent = 100.0 * read.min(1.0);
        say(
            "progress",
            &json!(progress),
            format_args!(
                "  gains{of_rounds}: {passes} passes, {percent:.0} % of the data, about {left_s:.0} s left"
            ),
        );
    }
}

/// Estimates the time left of a job whose parts take time in proportion to known weights.
pub(super) struct Parts {
    weights: Vec<f64>,
    /// Start and number of the first part that was not skipped.
    first: Option<(Instant, usize)>,
}

impl Parts {
    pub(super) fn new(weights: impl Iterator<Item = f64>) -> Self {
        Self { weights: weights.collect(), first: None }
    }

    /// Begins a part; returns the estimated time left for it and all later parts, s, or `None` for the first part.
    pub(super) fn begin(&mut self, number: usize) -> Option<f64> {
        let (since, first) = *self.first.get_or_insert((Instant::now(), number));
        let sum = |parts: Option<&[f64]>| parts.unwrap_or_default().iter().sum::<f64>();
        let (done, left) = (sum(self.weights.get(first..number)), sum(self.weights.get(number..)));
        (done > 0.0).then(|| since.elapsed().as_secs_f64() / done * left)
    }
}

pub(super) fn time_left(left_s: Option<f64>) -> String {
    match left_s {
        Some(left_s) if left_s >= 90.0 => format!("; about {:.0} min left", left_s / 60.0),
        Some(left_s) => format!("; about {left_s:.0} s left"),
        None => String::new(),
    }
}

fn amount(count: u64, unit: &str) -> String {
    match unit {
        "bytes" => DecimalBytes(count).to_string(),
        _ => format!("{} {unit}", HumanCount(count)),
    }
}

/// Logs the steps of a run in groups, with the time left and the progress of each.
pub(super) struct GroupSteps {
    groups: RunGroups,
    parts: Parts,
    channels_hz: Vec<f64>,
    windows: u64,
    progress: Option<Progress>,
}

impl GroupSteps {
    pub(super) fn new(plan: &Plan, groups: &RunGroups) -> Self {
        let costs = plan.cost().channels;
        let seconds = |group: &ChannelGroup, channel_s: fn(&ChannelCost) -> f64| -> f64 {
            group.iter().filter_map(|channel| costs.get(usize::from(channel.0))).map(channel_s).sum()
        };
        let simulated = groups.simulated.iter().map(|group| seconds(group, ChannelCost::simulation_s));
        let mapped = groups.mapped.iter().map(|group| seconds(&group.channels, |cost| cost.mapping_s));
        // The merging takes negligible time.
        let parts = Parts::new(simulated.chain([0.0]).chain(mapped));
        Self {
            groups: groups.clone(),
            parts,
            channels_hz: plan.config.spacecraft.channels_hz.clone(),
            windows: plan.progress_windows(),
            progress: None,
        }
    }

    /// Logs a step that begins, and shows the progress of its graph, if it has one.
    pub(super) fn watch(&mut self, event: JobEvent, view: Option<RunView>, interrupt: &Interrupt) {
        // The bar of the previous step ends first.
        self.progress = None;
        self.begin(event);
        let Some(view) = view else { return };
        interrupt.arm_or_note();
        let (stage, total) = match event {
            JobEvent::Simulate(_) => (INTEGRATE, self.windows),
            JobEvent::Merge => (MERGE, 0),
            _ => (READ, 0),
        };
        self.progress = Some(Progress::watch(view, stage, total, interrupt.cancel()));
    }

    /// Logs a step that begins.
    fn begin(&mut self, event: JobEvent) {
        let RunGroups { simulated, mapped } = &self.groups;
        let (what, number, of, part, group) = match event {
            JobEvent::Simulate(number) => {
                ("simulated", number, simulated.len(), number, simulated.get(number))
            }
            JobEvent::Merge => ("merged", simulated.len(), simulated.len(), simulated.len(), None),
            JobEvent::Map(step) => {
                let group = mapped.get(step.number).map(|group| &group.channels);
                ("mapped", step.number, mapped.len(), simulated.len() + 1 + step.number, group)
            }
            JobEvent::Sky(channel) => return self.log_sky(channel),
            // Events of cases of a study.
            JobEvent::Calibrate(..) | JobEvent::Realise(_) => return,
        };
        let left_s = self.parts.begin(part);
        let channels: Vec<String> = group.into_iter().flatten().map(ToString::to_string).collect();
        let (left, listed) = (time_left(left_s), channels.join(", "));
        let text = match event {
            JobEvent::Simulate(_) => {
                format!("group {} of {of}: simulating channels {listed}{left}", number + 1)
            }
            JobEvent::Map(step) => {
                format!("group {} of {of}: mapping channels {listed}{step}{left}", number + 1)
            }
            _ => format!("the downlink of all channels{left}"),
        };
        let fields =
            json!({ "what": what, "number": number + 1, "of": of, "channels": channels, "left_s": left_s });
        say("group", &fields, text);
    }

    /// Logs the sky of a channel: skies may take long before the first visibility is simulated.
    fn log_sky(&self, channel: ChannelId) {
        let frequency_hz = self.channels_hz.get(usize::from(channel.0)).copied().unwrap_or_default();
        let (mhz, of) = (frequency_hz / 1e6, self.channels_hz.len());
        let fields = json!({ "channel": channel.0, "of": of, "frequency_hz": frequency_hz });
        say("sky", &fields, format_args!("the sky of channel {channel} of {of}: {mhz:.3} MHz"));
    }
}

/// Display of the progress of one graph.
struct ProgressView {
    bar: Option<ProgressBar>,
    total: u64,
    /// Bytes received from all senders at the last refresh, and its time.
    received: (u64, Instant),
    since: Instant,
    told: RunChanges,
    solution: SolutionClock,
}

impl ProgressView {
    fn new(total: u64) -> Self {
        let bar = (std::io::stderr().is_terminal() && !is_json()).then(|| {
            let template = if total > 0 {
                "{elapsed_precise} [{bar:40}] {pos}/{len} windows, {eta} left  {msg}"
            } else {
                "{elapsed_precise} {spinner} {msg}"
            };
            let style = ProgressStyle::with_template(template);
            ProgressBar::new(total).with_style(style.unwrap_or_else(|_| ProgressStyle::default_bar()))
        });
        let now = Instant::now();
        Self {
            bar,
            total,
            received: (0, now),
            since: now,
            told: RunChanges::default(),
            solution: SolutionClock::default(),
        }
    }

    /// Text on the state of the solver, with an estimate of the time left.
    fn solution(&mut self, solving: &Solving) -> String {
        let Solving { what, iteration, residual, target, part, .. } = solving;
        let left_s = self.solution.left_s(solving);
        let left = left_s.map_or_else(String::new, |left_s| format!(", about {left_s:.0} s left"));
        let step = part.map_or_else(String::new, |SolvingPart { what, iteration, residual, target }| {
            format!("; {what}: iteration {iteration}, residual {residual:.1e} (target {target:.0e})")
        });
        format!("{what}: iteration {iteration}, residual {residual:.1e} (target {target:.0e}){left}{step}")
    }

    /// Text on the number of senders, their data rate and the backlog.
    fn senders(&mut self, status: &ListenStatus) -> String {
        let ((before, since), bytes) = (self.received, status.bytes());
        self.received = (bytes, Instant::now());
        let rate = (bytes - before) as f64 / since.elapsed().as_secs_f64().max(1e-3);
        format!(
            "{} senders, {:.2} MB/s, {:.2} MB queued",
            status.open(),
            1e-6 * rate,
            1e-6 * status.backlog_bytes() as f64
        )
    }

    /// Logs new events of the instrument, the checkpoints, the archive and the products.
    fn log_events(&mut self, view: &RunView) {
        self.told.next(view, &view.stages()).iter().for_each(log_change);
    }

    fn show(&mut self, view: &RunView, stage: &str) {
        if is_json() {
            let entry = progress_line(view, self.since.elapsed());
            return say_entry(Level::Info, &entry, None);
        }
        let stages = view.stages();
        let done = stages.iter().find(|s| s.name == stage).map_or(0, |s| s.items_in.saturating_sub(1));
        let mut message: Vec<String> = stages
            .iter()
            .filter(|s| !s.units.name.is_empty() && s.units.count > 0)
            .map(|s| format!("{} {}", s.name, amount(s.units.count, s.units.name)))
            .collect();
        if let Some(listening) = &view.listening {
            message.insert(0, self.senders(&listening.status));
        }
        if let Some(solving) = view.solving.progress() {
            message.push(self.solution(&solving));
        }
        if let Some(saving) = view.saving().filter(|saving| saving.unsaved.is_some()) {
            message.insert(0, saving.to_string());
        }
        let message = message.join(", ");
        match &self.bar {
            Some(bar) => {
                bar.set_position(done);
                bar.set_message(message);
            }
            None => {
                let elapsed_s = self.since.elapsed().as_secs();
                let of =
                    if self.total > 0 { format!(" {done}/{} windows,", self.total) } else { String::new() };
                print_line(format_args!("{elapsed_s:>5} s:{of} {message}"));
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn amounts_are_readable() {
        assert_eq!(amount(51_785_266, "bytes"), "51.79 MB");
        assert_eq!(amount(2_257_040, "visibilities"), "2,257,040 visibilities");
    }
}
