//! Starts the threads, keeps the first failure, wakes all stages and joins them with a deadline.

use std::any::Any;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread::{self, JoinHandle};
use std::time::{Duration, Instant};

use crossbeam_channel::{Receiver, Sender, after, bounded, never, select, tick};

use super::cancel::{Cancel, Halt};
use super::error::{Laggards, RuntimeError};
use super::metrics::Counters;
use super::report::{Report, StageReport};
use super::worker::{Ending, StageNode, Timings, Watch, Worker};

/// Keeps the first failure of a run.
struct Verdict {
    halt: Arc<Halt>,
    first: Mutex<Option<RuntimeError>>,
}

impl Verdict {
    fn fail(&self, error: RuntimeError) {
        self.first.lock().unwrap_or_else(PoisonError::into_inner).get_or_insert(error);
        self.halt.fail();
    }

    fn take(&self) -> Option<RuntimeError> {
        self.first.lock().unwrap_or_else(PoisonError::into_inner).take()
    }
}

/// The result of a thread.
struct WorkerEnd {
    index: usize,
    ending: Ending,
    timings: Timings,
}

/// How often a run looks whether it was cancelled.
const LOOK: Duration = Duration::from_millis(50);

/// How long stages may take to end when a cancelled run is cut short, before it leaves them behind.
const LEAVE: Duration = Duration::from_millis(300);

/// A thread that was started, and its timings when it has ended.
struct Member {
    counters: Arc<Counters>,
    /// Whether a cancelled run waits for it however long it takes.
    kept: bool,
    handle: Option<JoinHandle<()>>,
    timings: Option<Timings>,
}

impl Member {
    fn is_running(&self) -> bool {
        self.handle.is_some()
    }

    fn is_source(&self) -> bool {
        self.counters.queue_capacity.is_none()
    }
}

/// How long a run waits for its stages.
#[derive(Clone, Copy, Debug)]
pub(super) struct Limits {
    /// For stages that are not kept to end after cancellation; `None` for no limit.
    pub(super) grace: Option<Duration>,
    /// For all stages to end after a failure.
    pub(super) deadline: Duration,
    /// For any progress; `None` for no limit.
    pub(super) stall: Option<Duration>,
}

/// Detects that no stage makes progress.
struct StallWatch {
    patience: Duration,
    seen: Vec<[u64; 4]>,
    since: Instant,
}

impl StallWatch {
    /// Stages in a step, if there was no progress for the whole patience.
    fn look(&mut self, members: &[Member]) -> Option<Vec<String>> {
        let now: Vec<[u64; 4]> = members.iter().map(|member| member.counters.moves()).collect();
        if now != self.seen {
            (self.seen, self.since) = (now, Instant::now());
            return None;
        }
        let stalled = self.since.elapsed() >= self.patience;
        stalled.then(|| names(members.iter().filter(|member| member.counters.is_working())))
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
    let verdict = Arc::new(Verdict { halt: Arc::clone(halt), first: Mutex::new(None) });
    let (say, heard) = bounded(nodes.len().max(1));
    let mut members = start(nodes, &verdict, cancel, &say);
    drop(say);
    let (cancelled, cut) = join(&mut members, &heard, &verdict, cancel, limits);
    let laggards = Laggards { stages: names(members.iter().filter(|m| m.is_running())), waited: deadline };
    if let Some(error) = verdict.take() {
        return Err(with_laggards(error, laggards));
    }
    let stages = members
        .iter()
        .filter_map(|member| Some(StageReport::new(&member.counters, member.timings.as_ref()?)))
        .collect();
    Ok(Report { stages, elapsed_s: since.elapsed().as_secs_f64(), cancelled, cut })
}

fn names<'a>(members: impl Iterator<Item = &'a Member>) -> Vec<String> {
    members.map(|member| member.counters.name.clone()).collect()
}

/// Starts a thread for every node, or as many as the system allows.
fn start(
    nodes: Vec<StageNode>,
    verdict: &Arc<Verdict>,
    cancel: &Cancel,
    say: &Sender<WorkerEnd>,
) -> Vec<Member> {
    let mut members = Vec::with_capacity(nodes.len());
    for (index, StageNode { counters, worker, kept, .. }) in nodes.into_iter().enumerate() {
        let watch = Watch::new(Arc::clone(&counters), cancel.clone(), Arc::clone(&verdict.halt));
        let (verdict_there, say) = (Arc::clone(verdict), say.clone());
        let body = move || {
            let (ending, timings) = live(worker, watch, &verdict_there);
            // Fails only if the supervisor has stopped waiting.
            let _ = say.send(WorkerEnd { index, ending, timings });
        };
        match thread::Builder::new().name(counters.name.clone()).spawn(body) {
            Ok(handle) => members.push(Member { counters, kept, handle: Some(handle), timings: None }),
            Err(source) => {
                let stage = counters.name.clone();
                verdict.fail(RuntimeError::Thread { stage, laggards: Laggards::default(), source });
                break;
            }
        }
    }
    members
}

/// The life of a thread: works, reports a failure before it drops its links, cleans up.
fn live(mut worker: Box<dyn Worker>, mut watch: Watch, verdict: &Verdict) -> (Ending, Timings) {
    let worked = catch_unwind(AssertUnwindSafe(|| worker.work(&mut watch)));
    let (stage, at) = (watch.counters.name.clone(), watch.moment());
    let panicked = |payload: Box<dyn Any + Send>| RuntimeError::Panicked {
        stage: stage.clone(),
        at,
        message: panic_message(payload.as_ref()),
        laggards: Laggards::default(),
    };
    let ending = match worked {
        Ok(Ok(ending)) => ending,
        Ok(Err(source)) => {
            let stage = stage.clone();
            verdict.fail(RuntimeError::Failed { stage, at, laggards: Laggards::default(), source });
            Ending::Halted
        }
        Err(payload) => {
            verdict.fail(panicked(payload));
            Ending::Halted
        }
    };
    if let Err(payload) = catch_unwind(AssertUnwindSafe(|| drop(worker))) {
        verdict.fail(panicked(payload));
    }
    watch.counters.end();
    (ending, watch.timings)
}

fn panic_message(payload: &(dyn Any + Send)) -> String {
    let text = payload.downcast_ref::<&str>().copied();
    let text = text.or_else(|| payload.downcast_ref::<String>().map(String::as_str));
    text.unwrap_or("a payload that is not text").to_owned()
}

/// Whether a run whose grace is over may be cut short. Sources first hand over all that they have, unless nobody works
/// on it: then they wait for something else, like a pipe.
fn may_cut(members: &[Member]) -> bool {
    let handing_over = members.iter().any(|member| member.is_source() && member.is_running());
    !handing_over || !members.iter().any(|member| member.kept && member.counters.is_working())
}

/// Waits for all members: after a failure no longer than `deadline`, after cancellation and its grace for kept ones only.
/// Removes the handles of members that ended. Returns whether cancellation stopped a source early, and the names of the
/// stages that it cut short.
fn join(
    members: &mut [Member],
    heard: &Receiver<WorkerEnd>,
    verdict: &Verdict,
    cancel: &Cancel,
    limits: Limits,
) -> (bool, Vec<String>) {
    let mut cancelled = false;
    let mut cut = Vec::new();
    let mut clock = limits.grace.map_or_else(never, |_| tick(LOOK));
    let mut leave = never();
    let mut leaving = false;
    let mut remaining = members.len();
    let mut stop = verdict.halt.stop().clone();
    let mut give_up = never();
    let patience = limits.stall.unwrap_or_default();
    let mut watch = StallWatch { patience, seen: Vec::new(), since: Instant::now() };
    let mut look = limits.stall.map_or_else(never, |stall| tick(stall / 8));
    while remaining > 0 && !(leaving && members.iter().all(|member| !member.kept || !member.is_running())) {
        select! {
            recv(heard) -> ended => {
                let Ok(WorkerEnd { index, ending, timings }) = ended else { break };
                cancelled |= ending == Ending::Cancelled;
                remaining -= 1;
                let Some(member) = members.get_mut(index) else { continue };
                member.timings = Some(timings);
                if let Some(handle) = member.handle.take() {
                    // The thread only has to return, and it catches its panics.
                    let _ = handle.join();
                }
            }
            recv(stop) -> _ => {
                stop = never();
                look = never();
                give_up = after(limits.deadline);
            }
            recv(look) -> _ => {
                if let Some(stages) = watch.look(members) {
                    verdict.fail(RuntimeError::Stalled { stages, waited: patience, laggards: Laggards::default() });
                }
            }
            recv(clock) -> _ => {
                let (elapsed, grace) = (cancel.elapsed(), limits.grace.unwrap_or_default());
                let is_over = elapsed.is_some_and(|elapsed| elapsed >= grace);
                if is_over && !verdict.halt.has_failed() && may_cut(members) {
                    cut = names(members.iter().filter(|member| member.is_running() && !member.kept));
                    cancelled = true;
                    verdict.halt.cut();
                    (clock, look, leave) = (never(), never(), after(LEAVE));
                    stop = never();
                }
            }
            recv(leave) -> _ => leaving = true,
            recv(give_up) -> _ => break,
        }
    }
    (cancelled, cut)
}

fn with_laggards(mut error: RuntimeError, found: Laggards) -> RuntimeError {
    if let RuntimeError::Failed { laggards, .. }
    | RuntimeError::Panicked { laggards, .. }
    | RuntimeError::Stalled { laggards, .. }
    | RuntimeError::Thread { laggards, .. } = &mut error
    {
        *laggards = found;
    }
    error
}
