//! Ends a run early: by draining after cancellation, at once after a failure.

use std::convert::Infallible;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, OnceLock, PoisonError};
use std::time::{Duration, Instant};

use crossbeam_channel::{Receiver, Sender, bounded};

/// Token that ends a run early: sources stop, all stages drain their queues, and every `finish` runs.
///
/// Clones share one state. It is safe to trigger from a signal handler.
#[derive(Clone, Debug, Default)]
pub struct Cancel {
    flag: Arc<AtomicBool>,
    /// Time at which the flag was first seen set, as a signal handler must not read a clock.
    seen: Arc<OnceLock<Instant>>,
}

impl Cancel {
    /// A token that has not been triggered.
    #[must_use]
    pub fn new() -> Self {
        Self::default()
    }

    /// Triggers cancellation, which cannot be reset.
    pub fn cancel(&self) {
        self.flag.store(true, Ordering::Release);
    }

    /// The flag itself, for signal handlers. Setting it triggers cancellation.
    #[must_use]
    #[doc(hidden)]
    pub fn flag(&self) -> Arc<AtomicBool> {
        Arc::clone(&self.flag)
    }

    /// Whether cancellation was triggered.
    #[must_use]
    pub fn is_cancelled(&self) -> bool {
        self.flag.load(Ordering::Acquire)
    }

    /// Time since cancellation was first noticed; `None` without cancellation. A running graph checks often.
    #[must_use]
    #[doc(hidden)]
    pub fn elapsed(&self) -> Option<Duration> {
        self.is_cancelled().then(|| self.seen.get_or_init(Instant::now).elapsed())
    }
}

/// A flag that wakes every thread that selects on its channel.
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

    /// For `select!`: a channel without items that disconnects when the flag is set.
    pub(super) fn stop(&self) -> &Receiver<Infallible> {
        &self.stop
    }
}

/// State that halts a run, after the first failure or when a cancelled run is cut short.
///
/// It is set before the failing thread drops its channels. So a thread that finds a channel closed can tell whether the
/// other end finished or failed.
#[derive(Debug)]
pub(super) struct Halt {
    failed: AtomicBool,
    wake: Wake,
}

impl Halt {
    pub(super) fn new() -> Self {
        Self { failed: AtomicBool::new(false), wake: Wake::new() }
    }

    /// Halts a run that failed. Stages stop without `finish`.
    pub(super) fn fail(&self) {
        self.failed.store(true, Ordering::SeqCst);
        self.wake.set();
    }

    /// Halts a cancelled run whose grace period is over. Stages take the items in their queue and run `finish`; outputs are discarded.
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

    /// For `select!`: a channel without items that disconnects when the run halts.
    pub(super) fn stop(&self) -> &Receiver<Infallible> {
        self.wake.stop()
    }
}
