//! The output of a stage.

use std::sync::Arc;
use std::time::{Duration, Instant};

use crossbeam_channel::{Sender, TrySendError, select};

use super::cancel::{Cancel, Halt};
use super::metrics::Counters;

/// How often a sender that may give up looks for room.
const ROOM_POLL: Duration = Duration::from_millis(10);

/// An item, and the instant at which the source emitted the item that it was made from.
pub(super) struct StampedItem<T> {
    pub(super) item: T,
    pub(super) born: Instant,
}

/// Takes the outputs of a stage, in order: a queue to the next stage, or a list for tests.
///
/// [`Outlet::push`] waits while the queue is full. After a failure of another stage, pushing does nothing and the runner
/// ends the stage after its step. A stage with many outputs in one step may check [`Outlet::is_closed`] and return early.
pub struct Outlet<T>(Target<T>);

enum Target<T> {
    Queue(Queue<T>),
    List(Vec<T>),
}

impl<T> Outlet<T> {
    /// An outlet that keeps everything, to test a stage alone.
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

    /// As [`Outlet::push`] of a source, for an item that was there `since` an instant: from then on its latencies count.
    #[doc(hidden)]
    pub fn push_since(&mut self, item: T, since: Instant) {
        self.descend_from(since);
        self.push(item);
        if let Target::Queue(queue) = &mut self.0 {
            queue.born = None;
        }
    }

    /// As [`Outlet::push`], but gives up waiting for room when `cancel` is triggered; for items that no one needs then.
    #[doc(hidden)]
    pub fn push_unless(&mut self, item: T, cancel: &Cancel) {
        match &mut self.0 {
            Target::Queue(queue) => queue.push_unless(item, cancel),
            Target::List(list) => list.push(item),
        }
    }

    /// Lets a source wait for input from outside. The time counts as waiting for input, and not as work.
    #[doc(hidden)]
    pub fn await_input<R>(&mut self, wait: impl FnOnce() -> R) -> R {
        let since = Instant::now();
        let found = wait();
        if let Target::Queue(queue) = &mut self.0 {
            queue.starved += since.elapsed();
        }
        found
    }

    /// Whether pushed items are discarded, as the run has failed or was cut short.
    #[must_use]
    #[doc(hidden)]
    pub fn is_closed(&self) -> bool {
        match &self.0 {
            Target::Queue(queue) => queue.closed || queue.halt.is_set(),
            Target::List(_) => false,
        }
    }

    /// Items of a collecting outlet; empty for a queue.
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

    /// Items of a collecting outlet; empty for a queue.
    #[must_use]
    pub fn into_vec(mut self) -> Vec<T> {
        self.take()
    }

    /// Stamps all items that are pushed from now on with `born`.
    pub(super) fn descend_from(&mut self, born: Instant) {
        if let Target::Queue(queue) = &mut self.0 {
            queue.born = Some(born);
        }
    }

    /// Time spent waiting for room, and for input from outside, since the last call.
    pub(super) fn lap(&mut self) -> [Duration; 2] {
        match &mut self.0 {
            Target::Queue(queue) => [&mut queue.waited, &mut queue.starved].map(std::mem::take),
            Target::List(_) => [Duration::ZERO; 2],
        }
    }
}

/// The sending end of a link.
pub(super) struct Queue<T> {
    sender: Sender<StampedItem<T>>,
    halt: Arc<Halt>,
    counters: Arc<Counters>,
    /// Source timestamp of pushed items; `None` in a source, which stamps them as it pushes.
    born: Option<Instant>,
    waited: Duration,
    starved: Duration,
    closed: bool,
}

impl<T> Queue<T> {
    pub(super) fn new(sender: Sender<StampedItem<T>>, halt: Arc<Halt>, counters: Arc<Counters>) -> Self {
        let (waited, starved) = (Duration::ZERO, Duration::ZERO);
        Self { sender, halt, counters, born: None, waited, starved, closed: false }
    }

    fn push_unless(&mut self, item: T, cancel: &Cancel) {
        let since = Instant::now();
        self.counters.set_working(false);
        while self.sender.is_full() && !cancel.is_cancelled() && !self.halt.is_set() {
            std::thread::sleep(ROOM_POLL);
        }
        self.counters.set_working(true);
        self.waited += since.elapsed();
        // This is the only sender, so there is room still.
        if !cancel.is_cancelled() {
            self.push(item);
        }
    }

    fn push(&mut self, item: T) {
        if self.closed || self.halt.is_set() {
            return;
        }
        let born = self.born.unwrap_or_else(Instant::now);
        match self.sender.try_send(StampedItem { item, born }) {
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
        self.waited += since.elapsed();
    }
}

impl<T> Drop for Queue<T> {
    /// A panic while unwinding must not look like a clean end to the next stage.
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
