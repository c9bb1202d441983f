//! Starts the threads, keeps the first failure, wakes all stages, and joins them with a deadline.

use std::any::Any;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread::{self, JoinHandle};
use std::time::{Duration, Instant};

use crossbeam_channel::{Receiver, Sender, after, bounded, never, select, tick};

use super::cancel::{Cancel, Halt, Wake};
use super::error::{RuntimeError, UnfinishedStages};
use super::metrics::Counters;
use super::report::{Report, StageReport};
use super::worker::{Ending, StageNode, Timings, Worker, WorkerMonitor};

struct FirstFailure {
    halt: Arc<Halt>,
    first: Mutex<Option<RuntimeError>>,
}

impl FirstFailure {
    /// Records the first error (later ones are ignored) and halts the run.
    fn record(&self, error: RuntimeError) {
        self.first.lock().unwrap_or_else(PoisonError::into_inner).get_or_insert(error);
        self.halt.fail();
    }

    fn take(&self) -> Option<RuntimeError> {
        self.first.lock().unwrap_or_else(PoisonError::into_inner).take()
    }
}

struct WorkerEnd {
    index: usize,
    ending: Ending,
    timings: Timings,
}

const CANCEL_POLL: Duration = Duration::from_millis(50);

/// Time allowed for stages to end after a cancelled run is cut short, before they are abandoned.
const ABANDON_AFTER: Duration = Duration::from_millis(300);

/// Fraction of the grace period after which the input of the stages that must finish is cut off. The rest is for these and later stages.
const INPUT_FRACTION: f64 = 0.3;

/// A thread that was started, and its timings after its end.
struct StageThread {
    counters: Arc<Counters>,
    /// Whether a cancelled run waits for the stage without a time limit.
    must_finish: bool,
    end_of_input: Arc<Wake>,
    /// Whether the run no longer waits for the stage.
    is_abandoned: bool,
    handle: Option<JoinHandle<()>>,
    timings: Option<Timings>,
}

impl StageThread {
    fn is_running(&self) -> bool {
        self.handle.is_some()
    }

    /// Whether a source is in `finish` or waits for space in its queue.
    fn is_flushing(&self) -> bool {
        self.is_running() && (self.counters.is_finishing() || !self.counters.is_working())
    }
}

#[derive(Clone, Copy, Debug)]
pub(super) struct Limits {
    /// Time for stages that are not kept to end after cancellation; `None` for no limit.
    pub(super) grace: Option<Duration>,
    /// Time for all stages to end after a failure.
    pub(super) deadline: Duration,
    /// Maximum time without progress; `None` for no limit.
    pub(super) stall: Option<Duration>,
}

struct StallWatch {
    limit: Duration,
    seen: Vec<[u64; 4]>,
    since: Instant,
}

impl StallWatch {
    /// The stages that are in a step, if there was no progress within the limit.
    fn stalled_stages(&mut self, threads: &[StageThread]) -> Option<Vec<String>> {
        let now: Vec<[u64; 4]> = threads.iter().map(|thread| thread.counters.progress_marks()).collect();
        if now != self.seen {
            (self.seen, self.since) = (now, Instant::now());
            return None;
        }
        let stalled = self.since.elapsed() >= self.limit;
        stalled.then(|| names(threads.iter().filter(|thread| thread.counters.is_working())))
    }
}

pub(super) fn run(
    nodes: Vec<StageNode>,
    halt: &Arc<Halt>,
    cancel: &Cancel,
    limits: Limits,
) -> Result<Report, RuntimeError> {
    let deadline = limits.deadline;
    let since = Instant::now();
    let failure = Arc::new(FirstFailure { halt: Arc::clone(halt), first: Mutex::new(None) });
    let (end_sender, ends) = bounded(nodes.len().max(1));
    let mut threads = start(nodes, &failure, cancel, &end_sender);
    drop(end_sender);
    let (cancelled, cut) = join(&mut threads, &ends, &failure, cancel, limits);
    let unfinished =
        UnfinishedStages { stages: names(threads.iter().filter(|m| m.is_running())), waited: deadline };
    if let Some(error) = failure.take() {
        return Err(with_unfinished(error, unfinished));
    }
    let stages = threads
        .iter()
        .filter_map(|thread| Some(StageReport::new(&thread.counters, thread.timings.as_ref()?)))
        .collect();
    Ok(Report { stages, elapsed_s: since.elapsed().as_secs_f64(), cancelled, cut })
}

fn names<'a>(threads: impl Iterator<Item = &'a StageThread>) -> Vec<String> {
    threads.map(|thread| thread.counters.name.clone()).collect()
}

fn start(
    nodes: Vec<StageNode>,
    failure: &Arc<FirstFailure>,
    cancel: &Cancel,
    end_sender: &Sender<WorkerEnd>,
) -> Vec<StageThread> {
    let mut threads = Vec::with_capacity(nodes.len());
    for (index, StageNode { counters, worker, must_finish, .. }) in nodes.into_iter().enumerate() {
        let end_of_input = Arc::new(Wake::new());
        let monitor = WorkerMonitor::new(
            Arc::clone(&counters),
            cancel.clone(),
            Arc::clone(&failure.halt),
            Arc::clone(&end_of_input),
        );
        let (failure_of_thread, end_sender) = (Arc::clone(failure), end_sender.clone());
        let body = move || {
            let (ending, timings) = run_worker(worker, monitor, &failure_of_thread);
            // Fails only if the supervisor no longer waits.
            let _ = end_sender.send(WorkerEnd { index, ending, timings });
        };
        match thread::Builder::new().name(counters.name.clone()).spawn(body) {
            Ok(handle) => {
                let handle = Some(handle);
                threads.push(StageThread {
                    counters,
                    must_finish,
                    end_of_input,
                    is_abandoned: false,
                    handle,
                    timings: None,
                });
            }
            Err(source) => {
                let stage = counters.name.clone();
                failure.record(RuntimeError::Thread {
                    stage,
                    unfinished: UnfinishedStages::default(),
                    source,
                });
                break;
            }
        }
    }
    threads
}

/// Runs a worker to its end. A failure is recorded before the worker drops its links.
fn run_worker(
    mut worker: Box<dyn Worker>,
    mut monitor: WorkerMonitor,
    failure: &FirstFailure,
) -> (Ending, Timings) {
    let worked = catch_unwind(AssertUnwindSafe(|| worker.work(&mut monitor)));
    let (stage, at) = (monitor.counters.name.clone(), monitor.moment());
    let panicked = |payload: Box<dyn Any + Send>| RuntimeError::Panicked {
        stage: stage.clone(),
        at,
        message: panic_message(payload.as_ref()),
        unfinished: UnfinishedStages::default(),
    };
    let ending = match worked {
        Ok(Ok(ending)) => ending,
        Ok(Err(source)) => {
            let stage = stage.clone();
            failure.record(RuntimeError::Failed {
                stage,
                at,
                unfinished: UnfinishedStages::default(),
                source,
            });
            Ending::Halted
        }
        Err(payload) => {
            failure.record(panicked(payload));
            Ending::Halted
        }
    };
    if let Err(payload) = catch_unwind(AssertUnwindSafe(|| drop(worker))) {
        failure.record(panicked(payload));
    }
    monitor.counters.end();
    (ending, monitor.timings)
}

fn panic_message(payload: &(dyn Any + Send)) -> String {
    let text = payload.downcast_ref::<&str>().copied();
    let text = text.or_else(|| payload.downcast_ref::<String>().map(String::as_str));
    text.unwrap_or("a payload that is not text").to_owned()
}

/// Enforces the grace period of a cancelled run.
struct GraceEnforcer {
    grace: Duration,
    /// Time after which abandoned stages are no longer waited for.
    abandon_at: Option<Instant>,
    has_cut_input: bool,
    is_over: bool,
    cut: Vec<String>,
}

impl GraceEnforcer {
    fn new(grace: Duration) -> Self {
        Self { grace, abandon_at: None, has_cut_input: false, is_over: false, cut: Vec::new() }
    }

    /// Cuts stages whose time is over. Called every [`CANCEL_POLL`].
    fn enforce(&mut self, threads: &mut [StageThread], cancel: &Cancel, halt: &Halt) {
        let Some(elapsed) = cancel.elapsed().filter(|_| !halt.has_failed()) else { return };
        // A source that flushes into a kept stage, which saves its items, is not cut.
        let may_cut = match &*threads {
            [source, second, ..] if second.must_finish => !source.is_flushing(),
            _ => true,
        };
        if !self.has_cut_input && may_cut && elapsed >= self.grace.mul_f64(INPUT_FRACTION) {
            self.cut_input(threads);
        }
        if !self.is_over && may_cut && elapsed >= self.grace {
            for thread in threads.iter_mut().filter(|thread| thread.is_running() && !thread.must_finish) {
                thread.is_abandoned = true;
                if !self.cut.contains(&thread.counters.name) {
                    self.cut.push(thread.counters.name.clone());
                }
            }
            halt.cut();
            (self.is_over, self.abandon_at) = (true, Some(Instant::now() + ABANDON_AFTER));
        }
    }

    /// Cuts off the input of the kept stages.
    ///
    /// Of the stages before the first kept one, finds the last that is in a step. Abandons it and all before it, and ends the
    /// input of the next stage, so that all later stages drain.
    fn cut_input(&mut self, threads: &mut [StageThread]) {
        let Some(kept) = threads.iter().position(|thread| thread.must_finish) else { return };
        if threads[..=kept].iter().all(|thread| !thread.is_running()) {
            return;
        }
        let is_busy = |thread: &StageThread| thread.is_running() && thread.counters.is_working();
        let Some(busy) = threads[..kept].iter().rposition(is_busy) else { return };
        self.cut.push(threads[busy].counters.name.clone());
        threads[..=busy].iter_mut().for_each(|thread| thread.is_abandoned = true);
        threads[busy + 1].end_of_input.set();
        (self.has_cut_input, self.abandon_at) = (true, Some(Instant::now() + ABANDON_AFTER));
    }

    fn is_done(&self, threads: &[StageThread]) -> bool {
        let may_abandon = self.abandon_at.is_some_and(|abandon_at| Instant::now() >= abandon_at);
        threads.iter().all(|thread| !thread.is_running() || (may_abandon && thread.is_abandoned))
    }
}

/// Waits for all threads, and takes the handles of those that ended.
///
/// After a failure it waits no longer than the deadline; after cancellation and the grace period only for kept stages. Returns
/// whether cancellation stopped a source early, and the names of the stages that it cut short.
fn join(
    threads: &mut [StageThread],
    ends: &Receiver<WorkerEnd>,
    failure: &FirstFailure,
    cancel: &Cancel,
    limits: Limits,
) -> (bool, Vec<String>) {
    let mut cancelled = false;
    let mut enforcer = GraceEnforcer::new(limits.grace.unwrap_or_default());
    let cancel_tick = limits.grace.map_or_else(never, |_| tick(CANCEL_POLL));
    let mut stop = failure.halt.stop().clone();
    let mut deadline = never();
    let stall_limit = limits.stall.unwrap_or_default();
    let mut stall_watch = StallWatch { limit: stall_limit, seen: Vec::new(), since: Instant::now() };
    let mut stall_tick = limits.stall.map_or_else(never, |stall| tick(stall / 8));
    while !enforcer.is_done(threads) {
        select! {
            recv(ends) -> ended => {
                let Ok(WorkerEnd { index, ending, timings }) = ended else { break };
                cancelled |= ending == Ending::Cancelled;
                let Some(thread) = threads.get_mut(index) else { continue };
                thread.timings = Some(timings);
                if let Some(handle) = thread.handle.take() {
                    // The thread is about to return, and it catches its panics.
                    let _ = handle.join();
                }
            }
            recv(stop) -> _ => {
                stop = never();
                stall_tick = never();
                // The deadline does not apply to a run that was cut short.
                if failure.halt.has_failed() {
                    deadline = after(limits.deadline);
                }
            }
            recv(stall_tick) -> _ => {
                if let Some(stages) = stall_watch.stalled_stages(threads) {
                    failure.record(RuntimeError::Stalled { stages, waited: stall_limit, unfinished: UnfinishedStages::default() });
                }
            }
            recv(cancel_tick) -> _ => enforcer.enforce(threads, cancel, &failure.halt),
            recv(deadline) -> _ => break,
        }
    }
    (cancelled || enforcer.has_cut_input || enforcer.is_over, enforcer.cut)
}

fn with_unfinished(mut error: RuntimeError, found: UnfinishedStages) -> RuntimeError {
    if let RuntimeError::Failed { unfinished, .. }
    | RuntimeError::Panicked { unfinished, .. }
    | RuntimeError::Stalled { unfinished, .. }
    | RuntimeError::Thread { unfinished, .. } = &mut error
    {
        *unfinished = found;
    }
    error
}
