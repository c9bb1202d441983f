//! Ending a run early: in order from outside, at once after a failure.

use std::convert::Infallible;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, PoisonError};

use crossbeam_channel::{Receiver, Sender, bounded};

/// Asks a run to end early: sources stop, all stages drain their queues, every `finish` runs.
///
/// Clones share one state; safe to trigger from a signal handler's thread.
#[derive(Clone, Debug, Default)]
pub struct Cancel(Arc<AtomicBool>);

impl Cancel {
    /// A token that has not been triggered.
    #[must_use]
    pub fn new() -> Self {
        Self::default()
    }

    /// Triggers it; it cannot be reset.
    pub fn cancel(&self) {
        self.0.store(true, Ordering::Release);
    }

    /// Whether it was triggered.
    #[must_use]
    pub fn is_cancelled(&self) -> bool {
        self.0.load(Ordering::Acquire)
    }
}

/// Set by the first failure; wakes every thread that waits on a channel.
///
/// The flag is set before the failing thread drops its channels. So a thread that finds a channel closed reads from the
/// flag whether the other end finished or failed.
#[derive(Debug)]
pub(super) struct Halt {
    set: AtomicBool,
    stop: Receiver<Infallible>,
    /// Dropped to disconnect `stop`, which wakes all threads that select on it.
    hold: Mutex<Option<Sender<Infallible>>>,
}

impl Halt {
    pub(super) fn new() -> Self {
        let (hold, stop) = bounded(0);
        Self { set: AtomicBool::new(false), stop, hold: Mutex::new(Some(hold)) }
    }

    pub(super) fn set(&self) {
        self.set.store(true, Ordering::SeqCst);
        drop(self.hold.lock().unwrap_or_else(PoisonError::into_inner).take());
    }

    pub(super) fn is_set(&self) -> bool {
        self.set.load(Ordering::SeqCst)
    }

    /// Never yields; disconnects when the run halts. For `select!`.
    pub(super) fn stop(&self) -> &Receiver<Infallible> {
        &self.stop
    }
}
