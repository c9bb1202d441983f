//! The loops that run a source, a stage or a sink on a thread.

use std::sync::Arc;
use std::time::{Duration, Instant};

use crossbeam_channel::{Receiver, Select, TryRecvError, select};

use super::cancel::{Cancel, Halt, Wake};
use super::error::{BoxError, Moment};
use super::metrics::{Counters, Units};
use super::outlet::{Outlet, StampedItem, WaitingTimes};
use super::stage::{Flow, Sink, Source, Stage};
use super::timing::Timing;

/// End of a worker that did not fail itself.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Ending {
    /// The input was drained and `finish` ran.
    Finished,
    /// Like `Finished`, after [`Cancel`] stopped a source.
    Cancelled,
    Halted,
}

/// A source, stage or sink with its ends of the links.
pub(super) trait Worker: Send {
    /// Works until the input ends, the run halts, or an error occurs.
    fn work(&mut self, monitor: &mut WorkerMonitor) -> Result<Ending, BoxError>;
}

/// A stage of a graph before its thread is started.
pub(super) struct StageNode {
    pub(super) counters: Arc<Counters>,
    pub(super) worker: Box<dyn Worker>,
    pub(super) is_connected: bool,
    /// Whether a cancelled run waits for the stage without a time limit.
    pub(super) must_finish: bool,
}

pub(super) struct Timings {
    pub(super) waiting_in: Timing,
    pub(super) working: Timing,
    pub(super) waiting_out: Timing,
    pub(super) since_source: Timing,
}

pub(super) struct WorkerMonitor {
    pub(super) counters: Arc<Counters>,
    pub(super) timings: Timings,
    cancel: Cancel,
    halt: Arc<Halt>,
    /// Set to end the input, as the stage before is no longer waited for.
    end_of_input: Arc<Wake>,
    finishing: bool,
    mark: Instant,
}

impl WorkerMonitor {
    pub(super) fn new(
        counters: Arc<Counters>,
        cancel: Cancel,
        halt: Arc<Halt>,
        end_of_input: Arc<Wake>,
    ) -> Self {
        let timings = Timings {
            waiting_in: Timing::new(),
            working: Timing::new(),
            waiting_out: Timing::new(),
            since_source: Timing::new(),
        };
        Self { counters, timings, cancel, halt, end_of_input, finishing: false, mark: Instant::now() }
    }

    fn begin_finish(&mut self) {
        self.finishing = true;
        self.counters.set_finishing();
    }

    pub(super) fn moment(&self) -> Moment {
        let is_source = self.counters.queue_capacity.is_none();
        match (self.finishing, is_source) {
            (false, true) => Moment::Item(self.counters.items_out()),
            (true, true) => Moment::Finish(self.counters.items_out()),
            (false, false) => Moment::Item(self.counters.items_in().saturating_sub(1)),
            (true, false) => Moment::Finish(self.counters.items_in()),
        }
    }

    fn end_wait(&mut self) {
        let now = Instant::now();
        self.timings.waiting_in.record(now - self.mark);
        self.mark = now;
    }

    /// Records the end of a step, of which `waited` was spent waiting.
    fn end_step(&mut self, waited: Duration, source_time: Option<Instant>, units: Units) {
        let now = Instant::now();
        let working = (now - self.mark).saturating_sub(waited);
        self.timings.working.record(working);
        self.counters.working_time.record(working);
        if let Some(source_time) = source_time {
            let since_source = now.saturating_duration_since(source_time);
            self.timings.since_source.record(since_source);
            self.counters.since_source.record(since_source);
        }
        self.counters.set_units(units);
        self.counters.count_step();
        self.mark = now;
    }

    /// Like [`WorkerMonitor::end_step`], for a worker with an outlet.
    fn end_step_with_outlet<T>(&mut self, out: &mut Outlet<T>, source_time: Option<Instant>, units: Units) {
        let WaitingTimes { space, input } = out.take_waiting_times();
        self.end_step(space + input, source_time, units);
        self.timings.waiting_out.record(space);
        if input > Duration::ZERO {
            self.timings.waiting_in.record(input);
        }
    }
}

pub(super) struct Inlet<T> {
    receiver: Receiver<StampedItem<T>>,
}

enum Input<T> {
    Item(StampedItem<T>),
    End,
    Halt,
}

impl<T> Inlet<T> {
    pub(super) fn new(receiver: Receiver<StampedItem<T>>) -> Self {
        Self { receiver }
    }

    /// Waits for the next item, and times and counts it.
    fn receive(&mut self, monitor: &mut WorkerMonitor) -> Input<T> {
        let depth = self.receiver.len();
        monitor.counters.set_working(false);
        let received = match self.receiver.try_recv() {
            Ok(stamped) => Some(stamped),
            // An item may have arrived at the moment at which the wait was ended.
            Err(TryRecvError::Empty) => self.wait(monitor).or_else(|| self.receiver.try_recv().ok()),
            Err(TryRecvError::Disconnected) => None,
        };
        monitor.end_wait();
        monitor.counters.set_working(true);
        // After the wait, as a closed channel means the end of the input only without a failure.
        if monitor.halt.has_failed() {
            return Input::Halt;
        }
        let Some(stamped) = received else {
            return Input::End;
        };
        monitor.counters.note_depth(depth.max(1));
        monitor.counters.count_in();
        Input::Item(stamped)
    }

    /// Whether an item, the end of the input, or a halt comes within a time.
    fn is_ready_within(&self, time: Duration, monitor: &WorkerMonitor) -> bool {
        monitor.counters.set_working(false);
        let mut select = Select::new();
        select.recv(&self.receiver);
        select.recv(monitor.halt.stop());
        select.recv(monitor.end_of_input.stop());
        select.ready_timeout(time).is_ok()
    }

    fn wait(&self, monitor: &WorkerMonitor) -> Option<StampedItem<T>> {
        select! {
            recv(self.receiver) -> stamped => stamped.ok(),
            recv(monitor.halt.stop()) -> _ => None,
            recv(monitor.end_of_input.stop()) -> _ => None,
        }
    }
}

/// A source and its outlet. The order of the fields matters: the source drops first, then the link.
pub(super) struct SourceWorker<S: Source> {
    pub(super) source: S,
    pub(super) out: Outlet<S::Out>,
}

impl<S: Source> Worker for SourceWorker<S> {
    fn work(&mut self, monitor: &mut WorkerMonitor) -> Result<Ending, BoxError> {
        let Self { source, out } = self;
        monitor.counters.set_working(true);
        let ending = loop {
            if monitor.halt.has_failed() {
                return Ok(Ending::Halted);
            }
            if monitor.cancel.is_cancelled() {
                break Ending::Cancelled;
            }
            let flow = source.next(out)?;
            monitor.end_step_with_outlet(out, None, source.units());
            if flow == Flow::Done {
                break Ending::Finished;
            }
        };
        monitor.begin_finish();
        source.finish(out)?;
        monitor.end_step_with_outlet(out, None, source.units());
        Ok(if out.is_closed() { Ending::Halted } else { ending })
    }
}

/// A stage and its links. The order of the fields matters: the stage drops first, then the links.
pub(super) struct StageWorker<S: Stage> {
    pub(super) stage: S,
    pub(super) inlet: Inlet<S::In>,
    pub(super) out: Outlet<S::Out>,
}

impl<S: Stage> Worker for StageWorker<S> {
    fn work(&mut self, monitor: &mut WorkerMonitor) -> Result<Ending, BoxError> {
        let Self { stage, inlet, out } = self;
        loop {
            match inlet.receive(monitor) {
                Input::Item(StampedItem { item, source_time }) => {
                    out.set_source_time(source_time);
                    stage.step(item, out)?;
                    monitor.end_step_with_outlet(out, Some(source_time), stage.units());
                    if inlet.receiver.is_empty() {
                        stage.idle();
                    }
                }
                Input::End => break,
                Input::Halt => return Ok(Ending::Halted),
            }
        }
        monitor.begin_finish();
        stage.finish(out)?;
        monitor.end_step_with_outlet(out, None, stage.units());
        Ok(if out.is_closed() { Ending::Halted } else { Ending::Finished })
    }
}

pub(super) struct SinkWorker<S: Sink> {
    pub(super) sink: S,
    pub(super) inlet: Inlet<S::In>,
}

impl<S: Sink> Worker for SinkWorker<S> {
    fn work(&mut self, monitor: &mut WorkerMonitor) -> Result<Ending, BoxError> {
        let Self { sink, inlet } = self;
        loop {
            while let Some(after) = sink.retry_after()
                && !inlet.is_ready_within(after, monitor)
            {
                sink.retry();
            }
            match inlet.receive(monitor) {
                Input::Item(StampedItem { item, source_time }) => {
                    sink.take(item)?;
                    monitor.end_step(Duration::ZERO, Some(source_time), sink.units());
                }
                Input::End => break,
                Input::Halt => return Ok(Ending::Halted),
            }
        }
        monitor.begin_finish();
        sink.finish()?;
        monitor.end_step(Duration::ZERO, None, sink.units());
        Ok(Ending::Finished)
    }
}
