//! The loops of the threads: around a source, a stage and a sink.

use std::sync::Arc;
use std::time::{Duration, Instant};

use crossbeam_channel::{Receiver, Select, TryRecvError, select};

use super::cancel::{Cancel, Halt, Wake};
use super::error::{BoxError, Moment};
use super::metrics::{Counters, Units};
use super::outlet::{Outlet, StampedItem};
use super::stage::{Flow, Sink, Source, Stage};
use super::timing::Timing;

/// How a worker ended without an error of its own.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Ending {
    /// The input was drained and `finish` ran.
    Finished,
    /// As `Finished`, but [`Cancel`] stopped a source.
    Cancelled,
    /// Another stage failed.
    Halted,
}

/// A source, stage or sink with its ends of the links.
pub(super) trait Worker: Send {
    /// Works until the input ends, the run halts, or an error.
    fn work(&mut self, watch: &mut Watch) -> Result<Ending, BoxError>;
}

/// A stage of the graph that has no thread yet.
pub(super) struct StageNode {
    pub(super) counters: Arc<Counters>,
    pub(super) worker: Box<dyn Worker>,
    /// Whether its output is connected; true for a sink.
    pub(super) taken: bool,
    /// Whether a cancelled run waits for it however long it takes.
    pub(super) kept: bool,
}

/// The four timings of a stage.
pub(super) struct Timings {
    pub(super) waiting_in: Timing,
    pub(super) working: Timing,
    pub(super) waiting_out: Timing,
    pub(super) since_source: Timing,
}

/// Counts and times one worker.
pub(super) struct Watch {
    pub(super) counters: Arc<Counters>,
    pub(super) timings: Timings,
    cancel: Cancel,
    halt: Arc<Halt>,
    /// Set when the stage before this one is not waited for any more.
    last_input: Arc<Wake>,
    finishing: bool,
    /// End of the last timed interval.
    mark: Instant,
}

impl Watch {
    pub(super) fn new(
        counters: Arc<Counters>,
        cancel: Cancel,
        halt: Arc<Halt>,
        last_input: Arc<Wake>,
    ) -> Self {
        let timings = Timings {
            waiting_in: Timing::new(),
            working: Timing::new(),
            waiting_out: Timing::new(),
            since_source: Timing::new(),
        };
        Self { counters, timings, cancel, halt, last_input, finishing: false, mark: Instant::now() }
    }

    fn begin_finish(&mut self) {
        self.finishing = true;
        self.counters.set_finishing();
    }

    /// Position of the worker, for an error.
    pub(super) fn moment(&self) -> Moment {
        let is_source = self.counters.queue_capacity.is_none();
        match (self.finishing, is_source) {
            (false, true) => Moment::Item(self.counters.items_out()),
            (true, true) => Moment::Finish(self.counters.items_out()),
            (false, false) => Moment::Item(self.counters.items_in().saturating_sub(1)),
            (true, false) => Moment::Finish(self.counters.items_in()),
        }
    }

    /// The wait for input is over.
    fn received(&mut self) {
        let now = Instant::now();
        self.timings.waiting_in.record(now - self.mark);
        self.mark = now;
    }

    /// A step is over, of which `waited` was spent waiting.
    fn worked(&mut self, waited: Duration, born: Option<Instant>, units: Units) {
        let now = Instant::now();
        let working = (now - self.mark).saturating_sub(waited);
        self.timings.working.record(working);
        self.counters.working_time.record(working);
        if let Some(born) = born {
            let since_source = now.saturating_duration_since(born);
            self.timings.since_source.record(since_source);
            self.counters.since_source.record(since_source);
        }
        self.counters.set_units(units);
        self.counters.count_step();
        self.mark = now;
    }

    /// As [`Watch::worked`], for a worker with an outlet.
    fn worked_into<T>(&mut self, out: &mut Outlet<T>, born: Option<Instant>, units: Units) {
        let [waited, starved] = out.lap();
        self.worked(waited + starved, born, units);
        self.timings.waiting_out.record(waited);
        if starved > Duration::ZERO {
            self.timings.waiting_in.record(starved);
        }
    }
}

/// The receiving end of a link.
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

    /// Waits for the next item; timed and counted.
    fn receive(&mut self, watch: &mut Watch) -> Input<T> {
        let depth = self.receiver.len();
        watch.counters.set_working(false);
        let received = match self.receiver.try_recv() {
            Ok(stamped) => Some(stamped),
            // The wait may end although an item has just arrived.
            Err(TryRecvError::Empty) => self.wait(watch).or_else(|| self.receiver.try_recv().ok()),
            Err(TryRecvError::Disconnected) => None,
        };
        watch.received();
        watch.counters.set_working(true);
        // After the wait: a closed channel means an end only if nothing failed.
        if watch.halt.has_failed() {
            return Input::Halt;
        }
        let Some(stamped) = received else {
            return Input::End;
        };
        watch.counters.note_depth(depth.max(1));
        watch.counters.count_in();
        Input::Item(stamped)
    }

    /// Whether something comes within a time: an item, the end, or a halt.
    fn comes_within(&self, time: Duration, watch: &Watch) -> bool {
        watch.counters.set_working(false);
        let mut select = Select::new();
        select.recv(&self.receiver);
        select.recv(watch.halt.stop());
        select.recv(watch.last_input.stop());
        select.ready_timeout(time).is_ok()
    }

    fn wait(&self, watch: &Watch) -> Option<StampedItem<T>> {
        select! {
            recv(self.receiver) -> stamped => stamped.ok(),
            recv(watch.halt.stop()) -> _ => None,
            recv(watch.last_input.stop()) -> _ => None,
        }
    }
}

/// A source and its outlet. Fields drop in this order: the source first, then the link.
pub(super) struct SourceWorker<S: Source> {
    pub(super) source: S,
    pub(super) out: Outlet<S::Out>,
}

impl<S: Source> Worker for SourceWorker<S> {
    fn work(&mut self, watch: &mut Watch) -> Result<Ending, BoxError> {
        let Self { source, out } = self;
        watch.counters.set_working(true);
        let ending = loop {
            if watch.halt.has_failed() {
                return Ok(Ending::Halted);
            }
            if watch.cancel.is_cancelled() {
                break Ending::Cancelled;
            }
            let flow = source.next(out)?;
            watch.worked_into(out, None, source.units());
            if flow == Flow::Done {
                break Ending::Finished;
            }
        };
        watch.begin_finish();
        source.finish(out)?;
        watch.worked_into(out, None, source.units());
        Ok(if out.is_closed() { Ending::Halted } else { ending })
    }
}

/// A stage and its links. Fields drop in this order: the stage first, then the links.
pub(super) struct StageWorker<S: Stage> {
    pub(super) stage: S,
    pub(super) inlet: Inlet<S::In>,
    pub(super) out: Outlet<S::Out>,
}

impl<S: Stage> Worker for StageWorker<S> {
    fn work(&mut self, watch: &mut Watch) -> Result<Ending, BoxError> {
        let Self { stage, inlet, out } = self;
        loop {
            match inlet.receive(watch) {
                Input::Item(StampedItem { item, born }) => {
                    out.descend_from(born);
                    stage.step(item, out)?;
                    watch.worked_into(out, Some(born), stage.units());
                    if inlet.receiver.is_empty() {
                        stage.rest();
                    }
                }
                Input::End => break,
                Input::Halt => return Ok(Ending::Halted),
            }
        }
        watch.begin_finish();
        stage.finish(out)?;
        watch.worked_into(out, None, stage.units());
        Ok(if out.is_closed() { Ending::Halted } else { Ending::Finished })
    }
}

/// A sink and its link.
pub(super) struct SinkWorker<S: Sink> {
    pub(super) sink: S,
    pub(super) inlet: Inlet<S::In>,
}

impl<S: Sink> Worker for SinkWorker<S> {
    fn work(&mut self, watch: &mut Watch) -> Result<Ending, BoxError> {
        let Self { sink, inlet } = self;
        loop {
            while let Some(after) = sink.tries_again_after()
                && !inlet.comes_within(after, watch)
            {
                sink.try_again();
            }
            match inlet.receive(watch) {
                Input::Item(StampedItem { item, born }) => {
                    sink.take(item)?;
                    watch.worked(Duration::ZERO, Some(born), sink.units());
                }
                Input::End => break,
                Input::Halt => return Ok(Ending::Halted),
            }
        }
        watch.begin_finish();
        sink.finish()?;
        watch.worked(Duration::ZERO, None, sink.units());
        Ok(Ending::Finished)
    }
}
