//! Progress of long runs: a bar on a terminal, plain lines otherwise, or lines for programs (`--log json`).

use std::io::IsTerminal;
use std::sync::mpsc::{RecvTimeoutError, Sender, channel};
use std::sync::{Mutex, PoisonError};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use indicatif::{DecimalBytes, HumanCount, ProgressBar, ProgressStyle};
use serde_json::{Value, json};

use super::events::{LogState, LogViewer, progress_of};
use super::log::{Level, is_json, print_line, say, say_entry};
use crate::downlink::transport::socket::ListenStatus;
use crate::imaging::ChannelGroup;
use crate::imaging::{SolveWatch, Solving, SolvingPart};
use crate::pipeline::{CalibrateProgress, ChannelCost, GroupStep, Plan, RunGroups, Watched};
use crate::runtime::Cancel;
use crate::units::ChannelId;

/// Refresh interval on a terminal, and of looking for an interrupt.
const POLL: Duration = Duration::from_millis(200);
/// Interval between lines without a terminal.
const LINE_EVERY: Duration = Duration::from_secs(10);

/// Interval between lines of the propagation of orbits.
const PROPAGATION_EVERY: Duration = Duration::from_secs(3);

/// What is said when a run is interrupted.
const INTERRUPTED: &str =
    "\ninterrupted: finishing with the data so far (interrupt again to stop immediately)";

/// Says how far the propagation of orbits is, every few seconds; `days` of `of_days` are done.
pub(super) fn say_propagation(days: f64, of_days: f64) {
    static LAST: Mutex<Option<Instant>> = Mutex::new(None);
    let mut last = LAST.lock().unwrap_or_else(PoisonError::into_inner);
    // The first call begins an interval: short ones say nothing.
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
    /// Starts to show the progress of `stage` through `total` items, 0 if the total is unknown; and says when the run is
    /// cancelled.
    pub(super) fn watch(watched: Watched, stage: &'static str, total: u64, cancel: &Cancel) -> Self {
        let (stop, stopped) = channel();
        let cancel = cancel.clone();
        if is_json() {
            watched.maps.add_viewer(Box::new(LogViewer));
        }
        let thread = std::thread::spawn(move || {
            let mut shown = ProgressView::new(total);
            let every = if shown.bar.is_some() { POLL } else { LINE_EVERY };
            let (mut last, mut is_told) = (Instant::now(), false);
            loop {
                let is_over = !matches!(stopped.recv_timeout(POLL), Err(RecvTimeoutError::Timeout));
                if !is_told && cancel.is_cancelled() {
                    say("interrupted", &Value::Null, INTERRUPTED);
                    is_told = true;
                }
                shown.tell_events(&watched);
                if is_over {
                    break;
                }
                if last.elapsed() >= every {
                    shown.show(&watched, stage);
                    last = Instant::now();
                }
            }
            if let Some(bar) = shown.bar {
                bar.finish_and_clear();
            }
        });
        Self { stop, thread: Some(thread) }
    }
}

impl Drop for Progress {
    fn drop(&mut self) {
        // The thread may have ended already; then the message is not needed.
        let _ = self.stop.send(());
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}

/// Says every few seconds what is being solved for, while `work` lasts.
pub(super) fn while_solving<T>(watch: &SolveWatch, work: impl FnOnce() -> T) -> T {
    let (stop, stopped) = channel::<()>();
    std::thread::scope(|scope| {
        scope.spawn(move || {
            let mut shown = ProgressView::new(0);
            while matches!(stopped.recv_timeout(LINE_EVERY), Err(RecvTimeoutError::Timeout)) {
                if let Some(solving) = watch.progress() {
                    let Solving { what, iteration, residual, target, .. } = &solving;
                    let fields =
                        json!({ "what": what, "iteration": iteration, "residual": residual, "target": target });
                    say("solving", &fields, shown.solution(&solving));
                }
            }
        });
        let done = work();
        drop(stop);
        done
    })
}

/// Lines of how far a calibration is.
pub(super) struct CalibrateLines {
    last: Instant,
    /// When the round began, and its number; not while its map is made.
    round: Option<(Instant, u32)>,
}

impl CalibrateLines {
    pub(super) fn new() -> Self {
        let now = Instant::now();
        Self { last: now, round: Some((now, 0)) }
    }

    /// Shows where it is, at most every ten seconds.
    pub(super) fn show(&mut self, at: &CalibrateProgress) {
        let of = if at.last_round > 0 {
            format!(", round {} of {}", at.round, at.last_round)
        } else {
            String::new()
        };
        let Some(passes) = at.passes else {
            self.round = None;
            say("progress", &json!(at), format_args!("  gains{of}: the map to go on with"));
            return;
        };
        let begun = match self.round {
            Some((begun, round)) if round == at.round => begun,
            _ => self.round.insert((Instant::now(), at.round)).0,
        };
        if self.last.elapsed() < LINE_EVERY || at.read <= 0.0 {
            return;
        }
        self.last = Instant::now();
        let left_s = begun.elapsed().as_secs_f64() * (1.0 / at.read - 1.0).max(0.0);
        let part = 100.0 * at.read.min(1.0);
        say(
            "progress",
            &json!(at),
            format_args!("  gains{of}: {passes} passes, {part:.0} % of the data, about {left_s:.0} s left"),
        );
    }
}

/// Parts of a job of known weights, which take time in proportion.
pub(super) struct Parts {
    weights: Vec<f64>,
    /// When the first part began that this job makes, and its number.
    begun: Option<(Instant, usize)>,
}

impl Parts {
    pub(super) fn new(weights: impl Iterator<Item = f64>) -> Self {
        Self { weights: weights.collect(), begun: None }
    }

    /// Begins a part: the time left for it and all later ones, s, at the pace so far; `None` before there is one.
    pub(super) fn begin(&mut self, number: usize) -> Option<f64> {
        let (since, first) = *self.begun.get_or_insert((Instant::now(), number));
        let sum = |parts: Option<&[f64]>| parts.unwrap_or_default().iter().sum::<f64>();
        let (done, left) = (sum(self.weights.get(first..number)), sum(self.weights.get(number..)));
        (done > 0.0).then(|| since.elapsed().as_secs_f64() / done * left)
    }
}

/// How much time is left, in words that end a line.
pub(super) fn time_left(left_s: Option<f64>) -> String {
    match left_s {
        Some(left_s) if left_s >= 90.0 => format!("; about {:.0} min left", left_s / 60.0),
        Some(left_s) => format!("; about {left_s:.0} s left"),
        None => String::new(),
    }
}

/// How much a stage has handled, for people.
fn amount(count: u64, unit: &str) -> String {
    match unit {
        "bytes" => DecimalBytes(count).to_string(),
        _ => format!("{} {unit}", HumanCount(count)),
    }
}

/// Says which group of a run begins, and the time left for all.
pub(super) struct GroupSteps {
    groups: RunGroups,
    parts: Parts,
    channels_hz: Vec<f64>,
}

impl GroupSteps {
    pub(super) fn new(plan: &Plan, groups: &RunGroups) -> Self {
        let costs = plan.cost().channels;
        let seconds = |group: &ChannelGroup, of: fn(&ChannelCost) -> f64| -> f64 {
            group.iter().filter_map(|channel| costs.get(usize::from(channel.0))).map(of).sum()
        };
        let simulated = groups.simulated.iter().map(|group| seconds(group, ChannelCost::simulation_s));
        let mapped = groups.mapped.iter().map(|group| seconds(&group.channels, |cost| cost.mapping_s));
        // The downlink takes next to no time.
        let parts = Parts::new(simulated.chain([0.0]).chain(mapped));
        Self { groups: groups.clone(), parts, channels_hz: plan.config.spacecraft.channels_hz.clone() }
    }

    pub(super) fn begin(&mut self, group: GroupStep) {
        let RunGroups { simulated, mapped } = &self.groups;
        let (what, number, of, place) = match group {
            GroupStep::Simulated(number) => ("simulated", number, simulated.len(), number),
            GroupStep::Merged => ("merged", simulated.len(), simulated.len(), simulated.len()),
            GroupStep::Mapped(step) => ("mapped", step.group, mapped.len(), simulated.len() + 1 + step.group),
            GroupStep::Sky(channel) => return self.tell_sky(channel),
        };
        let left_s = self.parts.begin(place);
        let of_group = match group {
            GroupStep::Simulated(number) => simulated.get(number),
            GroupStep::Mapped(step) => mapped.get(step.group).map(|group| &group.channels),
            GroupStep::Merged | GroupStep::Sky(_) => None,
        };
        let channels: Vec<String> = of_group.into_iter().flatten().map(ToString::to_string).collect();
        let (left, listed) = (time_left(left_s), channels.join(", "));
        let text = match group {
            GroupStep::Simulated(_) => {
                format!("group {} of {of}: simulating channels {listed}{left}", number + 1)
            }
            GroupStep::Merged | GroupStep::Sky(_) => format!("the downlink of all channels{left}"),
            GroupStep::Mapped(step) => {
                format!("group {} of {of}: mapping channels {listed}{step}{left}", number + 1)
            }
        };
        let fields =
            json!({ "what": what, "number": number + 1, "of": of, "channels": channels, "left_s": left_s });
        say("group", &fields, text);
    }

    /// Skies take seconds each, and there may be many before anything moves.
    fn tell_sky(&self, channel: ChannelId) {
        let frequency_hz = self.channels_hz.get(usize::from(channel.0)).copied().unwrap_or_default();
        let (mhz, of) = (frequency_hz / 1e6, self.channels_hz.len());
        let fields = json!({ "channel": channel.0, "of": of, "frequency_hz": frequency_hz });
        say("sky", &fields, format_args!("the sky of channel {channel} of {of}: {mhz:.3} MHz"));
    }
}

struct ProgressView {
    bar: Option<ProgressBar>,
    total: u64,
    /// Bytes received from all senders at the last refresh, and its time.
    received: (u64, Instant),
    since: Instant,
    /// Events of the instrument that were told.
    events_told: usize,
    told: LogState,
    /// The solution being shown: its number, when it was first shown, and its residual then.
    solution: Option<(u64, Instant, f64)>,
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
            events_told: 0,
            told: LogState::default(),
            solution: None,
        }
    }

    /// The state of the solver, with the time left if the residual keeps falling at the same rate.
    fn solution(&mut self, solving: &Solving) -> String {
        let Solving { number, what, iteration, residual, target, part } = solving;
        let (_, since, first) = match self.solution {
            Some(seen) if seen.0 == *number => seen,
            _ => *self.solution.insert((*number, Instant::now(), *residual)),
        };
        let (done, whole) = ((first / residual).ln(), (first / target).ln());
        let elapsed_s = since.elapsed().as_secs_f64();
        let left = if done > 0.05 * whole && elapsed_s > 1.0 {
            format!(", about {:.0} s left", elapsed_s * (whole / done - 1.0).max(0.0))
        } else {
            String::new()
        };
        let step = part.map_or_else(String::new, |SolvingPart { what, iteration, residual, target }| {
            format!("; {what}: iteration {iteration}, residual {residual:.1e} of {target:.0e}")
        });
        format!("{what}: iteration {iteration}, residual {residual:.1e} of {target:.0e}{left}{step}")
    }

    /// The number of senders, their rate and the backlog.
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

    /// Says what happened to the instrument, to checkpoints, archive and products, as it happens.
    fn tell_events(&mut self, watched: &Watched) {
        self.told.tell(watched);
        let gains = watched.ground.as_ref().and_then(|ground| ground.gains.as_ref());
        for event in gains.map(|gains| gains.events_since(self.events_told)).unwrap_or_default() {
            say("instrument", &json!({ "what": event }), &event);
            self.events_told += 1;
        }
    }

    fn show(&mut self, watched: &Watched, stage: &str) {
        if is_json() {
            let entry = progress_of(watched, self.since.elapsed());
            return say_entry(Level::Info, &entry, None);
        }
        let stages = watched.metrics.snapshot();
        let done = stages.iter().find(|s| s.name == stage).map_or(0, |s| s.items_in.saturating_sub(1));
        let mut message: Vec<String> = stages
            .iter()
            .filter(|s| !s.units.name.is_empty() && s.units.count > 0)
            .map(|s| format!("{} {}", s.name, amount(s.units.count, s.units.name)))
            .collect();
        if let Some(listening) = &watched.listening {
            message.insert(0, self.senders(&listening.status));
        }
        if let Some(solving) = watched.solving.progress() {
            message.push(self.solution(&solving));
        }
        if let Some(saving) = watched
            .ground
            .as_ref()
            .and_then(|ground| ground.saving.report())
            .filter(|saving| saving.unsaved.is_some())
        {
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
    fn amounts_are_for_people() {
        assert_eq!(amount(51_785_266, "bytes"), "51.79 MB");
        assert_eq!(amount(2_257_040, "visibilities"), "2,257,040 visibilities");
    }
}
