//! Starts the threads, keeps the first failure, wakes all stages and joins them with a deadline.

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

/// Share of the grace that stages before the kept ones have to end: the rest is for what follows.
const INPUT_SHARE: f64 = 0.3;

/// A thread that was started, and its timings when it has ended.
struct Member {
    counters: Arc<Counters>,
    /// Whether a cancelled run waits for it however long it takes.
    kept: bool,
    /// Ends its input.
    last_input: Arc<Wake>,
    /// Whether the run does not wait for it any more.
    left: bool,
    handle: Option<JoinHandle<()>>,
    timings: Option<Timings>,
}

impl Member {
    fn is_running(&self) -> bool {
        self.handle.is_some()
    }

    /// Whether, being a source, it is handing over what it has.
    fn hands_over(&self) -> bool {
        self.is_running() && (self.counters.is_finishing() || !self.counters.is_working())
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
    let laggards =
        UnfinishedStages { stages: names(members.iter().filter(|m| m.is_running())), waited: deadline };
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
        let last_input = Arc::new(Wake::new());
        let watch = Watch::new(
            Arc::clone(&counters),
            cancel.clone(),
            Arc::clone(&verdict.halt),
            Arc::clone(&last_input),
        );
        let (verdict_there, say) = (Arc::clone(verdict), say.clone());
        let body = move || {
            let (ending, timings) = live(worker, watch, &verdict_there);
            // Fails only if the supervisor has stopped waiting.
            let _ = say.send(WorkerEnd { index, ending, timings });
        };
        match thread::Builder::new().name(counters.name.clone()).spawn(body) {
            Ok(handle) => {
                let handle = Some(handle);
                members.push(Member { counters, kept, last_input, left: false, handle, timings: None });
            }
            Err(source) => {
                let stage = counters.name.clone();
                verdict.fail(RuntimeError::Thread { stage, laggards: UnfinishedStages::default(), source });
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
        laggards: UnfinishedStages::default(),
    };
    let ending = match worked {
        Ok(Ok(ending)) => ending,
        Ok(Err(source)) => {
            let stage = stage.clone();
            verdict.fail(RuntimeError::Failed { stage, at, laggards: UnfinishedStages::default(), source });
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

/// Ends a cancelled run in time.
struct Cutter {
    grace: Duration,
    /// When what has not ended is left behind.
    leave: Option<Instant>,
    has_cut_input: bool,
    /// Whether everything was cut.
    is_over: bool,
    /// Stages that lose something.
    cut: Vec<String>,
}

impl Cutter {
    fn new(grace: Duration) -> Self {
        Self { grace, leave: None, has_cut_input: false, is_over: false, cut: Vec::new() }
    }

    /// Cuts what is due. Called every [`LOOK`].
    fn look(&mut self, members: &mut [Member], cancel: &Cancel, halt: &Halt) {
        let Some(elapsed) = cancel.elapsed().filter(|_| !halt.has_failed()) else { return };
        // What a source hands over to a stage that saves it is waited for.
        let may_cut = match &*members {
            [source, saves, ..] if saves.kept => !source.hands_over(),
            _ => true,
        };
        if !self.has_cut_input && may_cut && elapsed >= self.grace.mul_f64(INPUT_SHARE) {
            self.cut_input(members);
        }
        if !self.is_over && may_cut && elapsed >= self.grace {
            for member in members.iter_mut().filter(|member| member.is_running() && !member.kept) {
                member.left = true;
                if !self.cut.contains(&member.counters.name) {
                    self.cut.push(member.counters.name.clone());
                }
            }
            halt.cut();
            (self.is_over, self.leave) = (true, Some(Instant::now() + LEAVE));
        }
    }

    /// Ends the input of the stage behind the last one before the kept ones that is in a step; all that follows drains.
    fn cut_input(&mut self, members: &mut [Member]) {
        let Some(kept) = members.iter().position(|member| member.kept) else { return };
        if members[..=kept].iter().all(|member| !member.is_running()) {
            return;
        }
        let is_busy = |member: &Member| member.is_running() && member.counters.is_working();
        let Some(busy) = members[..kept].iter().rposition(is_busy) else { return };
        self.cut.push(members[busy].counters.name.clone());
        members[..=busy].iter_mut().for_each(|member| member.left = true);
        members[busy + 1].last_input.set();
        (self.has_cut_input, self.leave) = (true, Some(Instant::now() + LEAVE));
    }

    /// Whether nobody is left to wait for.
    fn is_done(&self, members: &[Member]) -> bool {
        let is_left = self.leave.is_some_and(|leave| Instant::now() >= leave);
        members.iter().all(|member| !member.is_running() || (is_left && member.left))
    }
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
    let mut cutter = Cutter::new(limits.grace.unwrap_or_default());
    let clock = limits.grace.map_or_else(never, |_| tick(LOOK));
    let mut stop = verdict.halt.stop().clone();
    let mut give_up = never();
    let patience = limits.stall.unwrap_or_default();
    let mut watch = StallWatch { patience, seen: Vec::new(), since: Instant::now() };
    let mut look = limits.stall.map_or_else(never, |stall| tick(stall / 8));
    while !cutter.is_done(members) {
        select! {
            recv(heard) -> ended => {
                let Ok(WorkerEnd { index, ending, timings }) = ended else { break };
                cancelled |= ending == Ending::Cancelled;
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
                // Not if the run was cut short.
                if verdict.halt.has_failed() {
                    give_up = after(limits.deadline);
                }
            }
            recv(look) -> _ => {
                if let Some(stages) = watch.look(members) {
                    verdict.fail(RuntimeError::Stalled { stages, waited: patience, laggards: UnfinishedStages::default() });
                }
            }
            recv(clock) -> _ => cutter.look(members, cancel, &verdict.halt),
            recv(give_up) -> _ => break,
        }
    }
    (cancelled || cutter.has_cut_input || cutter.is_over, cutter.cut)
}

fn with_laggards(mut error: RuntimeError, found: UnfinishedStages) -> RuntimeError {
    if let RuntimeError::Failed { laggards, .. }
    | RuntimeError::Panicked { laggards, .. }
    | RuntimeError::Stalled { laggards, .. }
    | RuntimeError::Thread { laggards, .. } = &mut error
    {
        *laggards = found;
    }
    error
}
