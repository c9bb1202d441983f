//! Ending a run early: in order from outside, at once after a failure.

use std::convert::Infallible;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, OnceLock, PoisonError};
use std::time::{Duration, Instant};

use crossbeam_channel::{Receiver, Sender, bounded};

/// Asks a run to end early: sources stop, all stages drain their queues, every `finish` runs.
///
/// Clones share one state; safe to trigger from a signal handler.
#[derive(Clone, Debug, Default)]
pub struct Cancel {
    flag: Arc<AtomicBool>,
    /// When somebody first saw the flag: a signal handler must not read a clock.
    seen: Arc<OnceLock<Instant>>,
}

impl Cancel {
    /// A token that has not been triggered.
    #[must_use]
    pub fn new() -> Self {
        Self::default()
    }

    /// Triggers it; it cannot be reset.
    pub fn cancel(&self) {
        self.flag.store(true, Ordering::Release);
    }

    /// The flag itself; setting it cancels. For signal handlers.
    #[must_use]
    #[doc(hidden)]
    pub fn flag(&self) -> Arc<AtomicBool> {
        Arc::clone(&self.flag)
    }

    /// Whether it was triggered.
    #[must_use]
    pub fn is_cancelled(&self) -> bool {
        self.flag.load(Ordering::Acquire)
    }

    /// Time since it was first seen to be triggered; `None` if it was not. A running graph looks often.
    #[must_use]
    #[doc(hidden)]
    pub fn elapsed(&self) -> Option<Duration> {
        self.is_cancelled().then(|| self.seen.get_or_init(Instant::now).elapsed())
    }
}

/// A flag that wakes every thread that waits on a channel.
#[derive(Debug)]
pub(super) struct Wake {
    set: AtomicBool,
    stop: Receiver<Infallible>,
    /// Dropped to disconnect `stop`, which wakes all threads that select on it.
    hold: Mutex<Option<Sender<Infallible>>>,
}

impl Wake {
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

    /// Never yields; disconnects when it is set. For `select!`.
    pub(super) fn stop(&self) -> &Receiver<Infallible> {
        &self.stop
    }
}

/// Set by the first failure, or when a cancelled run is cut short.
///
/// The flag is set before the failing thread drops its channels. So a thread that finds a channel closed reads from the
/// flag whether the other end finished or failed.
#[derive(Debug)]
pub(super) struct Halt {
    failed: AtomicBool,
    /// For either reason.
    wake: Wake,
}

impl Halt {
    pub(super) fn new() -> Self {
        Self { failed: AtomicBool::new(false), wake: Wake::new() }
    }

    /// Ends a run that failed: stages stop without `finish`.
    pub(super) fn fail(&self) {
        self.failed.store(true, Ordering::SeqCst);
        self.wake.set();
    }

    /// Ends a cancelled run whose time is up: stages take what is in their queue and run `finish`; outputs are discarded.
    pub(super) fn cut(&self) {
        self.wake.set();
    }

    pub(super) fn has_failed(&self) -> bool {
        self.failed.load(Ordering::SeqCst)
    }

    /// Whether outputs are discarded, for either reason.
    pub(super) fn is_set(&self) -> bool {
        self.wake.is_set()
    }

    /// Never yields; disconnects when the run halts. For `select!`.
    pub(super) fn stop(&self) -> &Receiver<Infallible> {
        self.wake.stop()
    }
}
