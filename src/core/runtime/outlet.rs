//! The output of a source or stage.

use std::sync::Arc;
use std::time::{Duration, Instant};

use crossbeam_channel::{Sender, TrySendError, select};

use super::cancel::{Cancel, Halt};
use super::metrics::Counters;

/// Interval between checks for space in the queue, in [`Outlet::push_unless`].
const SPACE_POLL: Duration = Duration::from_millis(10);

/// An item, and the instant at which the source pushed the item from which it was made.
pub(super) struct StampedItem<T> {
    pub(super) item: T,
    pub(super) source_time: Instant,
}

/// Takes the outputs of a stage, in order, into a queue to the next stage, or into a list for tests.
///
/// [`Outlet::push`] waits while the queue is full. After a failure of another stage, it does nothing, and the stage ends
/// after its step. A stage with many outputs in one step may check [`Outlet::is_closed`] and return early.
pub struct Outlet<T>(Target<T>);

enum Target<T> {
    Queue(Queue<T>),
    List(Vec<T>),
}

impl<T> Outlet<T> {
    /// An outlet that keeps all items, to test a stage alone.
    #[must_use]
    pub fn collect() -> Self {
        Self(Target::List(Vec::new()))
    }

    pub(super) fn queue(queue: Queue<T>) -> Self {
        Self(Target::Queue(queue))
    }

    /// Passes `item` to the next stage.
    pub fn push(&mut self, item: T) {
        match &mut self.0 {
            Target::Queue(queue) => queue.push(item),
            Target::List(list) => list.push(item),
        }
    }

    /// Like [`Outlet::push`], for an item that arrived at a source at `since`, from which its latency is counted.
    #[doc(hidden)]
    pub fn push_since(&mut self, item: T, since: Instant) {
        self.set_source_time(since);
        self.push(item);
        if let Target::Queue(queue) = &mut self.0 {
            queue.source_time = None;
        }
    }

    /// Like [`Outlet::push`], but drops the item once `cancel` is triggered, for items that are not needed then.
    #[doc(hidden)]
    pub fn push_unless(&mut self, item: T, cancel: &Cancel) {
        match &mut self.0 {
            Target::Queue(queue) => queue.push_unless(item, cancel),
            Target::List(list) => list.push(item),
        }
    }

    /// Calls `wait`, in which a source waits for input. The time counts as waiting for input, not as work.
    #[doc(hidden)]
    pub fn await_input<R>(&mut self, wait: impl FnOnce() -> R) -> R {
        let since = Instant::now();
        let found = wait();
        if let Target::Queue(queue) = &mut self.0 {
            queue.waiting.input += since.elapsed();
        }
        found
    }

    /// Whether pushed items are discarded because the run has failed or was cut short.
    #[must_use]
    #[doc(hidden)]
    pub fn is_closed(&self) -> bool {
        match &self.0 {
            Target::Queue(queue) => queue.closed || queue.halt.is_set(),
            Target::List(_) => false,
        }
    }

    /// The items of a collecting outlet; empty for a queue.
    #[must_use]
    #[doc(hidden)]
    pub fn items(&self) -> &[T] {
        match &self.0 {
            Target::Queue(_) => &[],
            Target::List(list) => list,
        }
    }

    /// Removes the items of a collecting outlet; empty for a queue.
    pub fn take(&mut self) -> Vec<T> {
        match &mut self.0 {
            Target::Queue(_) => Vec::new(),
            Target::List(list) => std::mem::take(list),
        }
    }

    /// The items of a collecting outlet; empty for a queue.
    #[must_use]
    pub fn into_vec(mut self) -> Vec<T> {
        self.take()
    }

    pub(super) fn set_source_time(&mut self, source_time: Instant) {
        if let Target::Queue(queue) = &mut self.0 {
            queue.source_time = Some(source_time);
        }
    }

    pub(super) fn take_waiting_times(&mut self) -> WaitingTimes {
        match &mut self.0 {
            Target::Queue(queue) => std::mem::take(&mut queue.waiting),
            Target::List(_) => WaitingTimes::default(),
        }
    }
}

#[derive(Default)]
pub(super) struct WaitingTimes {
    /// For space in the output queue.
    pub(super) space: Duration,
    /// For input of a source.
    pub(super) input: Duration,
}

pub(super) struct Queue<T> {
    sender: Sender<StampedItem<T>>,
    halt: Arc<Halt>,
    counters: Arc<Counters>,
    /// Source time of pushed items; `None` in a source, which stamps each at its push.
    source_time: Option<Instant>,
    waiting: WaitingTimes,
    closed: bool,
}

impl<T> Queue<T> {
    pub(super) fn new(sender: Sender<StampedItem<T>>, halt: Arc<Halt>, counters: Arc<Counters>) -> Self {
        Self { sender, halt, counters, source_time: None, waiting: WaitingTimes::default(), closed: false }
    }

    fn push_unless(&mut self, item: T, cancel: &Cancel) {
        let since = Instant::now();
        self.counters.set_working(false);
        while self.sender.is_full() && !cancel.is_cancelled() && !self.halt.is_set() {
            std::thread::sleep(SPACE_POLL);
        }
        self.counters.set_working(true);
        self.waiting.space += since.elapsed();
        // This is the only sender, so there is still space.
        if !cancel.is_cancelled() {
            self.push(item);
        }
    }

    fn push(&mut self, item: T) {
        if self.closed || self.halt.is_set() {
            return;
        }
        let source_time = self.source_time.unwrap_or_else(Instant::now);
        match self.sender.try_send(StampedItem { item, source_time }) {
            Ok(()) => {}
            Err(TrySendError::Full(stamped)) => self.wait_and_push(stamped),
            Err(TrySendError::Disconnected(_)) => self.closed = true,
        }
        if !self.closed {
            self.counters.count_out();
        }
    }

    fn wait_and_push(&mut self, stamped: StampedItem<T>) {
        let since = Instant::now();
        self.counters.set_working(false);
        select! {
            send(self.sender, stamped) -> sent => self.closed = sent.is_err(),
            recv(self.halt.stop()) -> _ => self.closed = true,
        }
        self.counters.set_working(true);
        self.waiting.space += since.elapsed();
    }
}

impl<T> Drop for Queue<T> {
    /// Reports a panic, as a closed link must not look like a normal end to the next stage.
    fn drop(&mut self) {
        if std::thread::panicking() {
            self.halt.fail();
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_collecting_outlet_keeps_order() {
        let mut out = Outlet::collect();
        out.push(1);
        out.push(2);
        assert_eq!(out.items(), [1, 2]);
        assert!(!out.is_closed());
        assert_eq!(out.take(), [1, 2]);
        out.push(3);
        assert_eq!(out.into_vec(), [3]);
    }
}
