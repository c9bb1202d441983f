//! Counters that can be read during a run.

use std::sync::atomic::{AtomicBool, AtomicU64, AtomicUsize, Ordering};
use std::sync::{Arc, Mutex, PoisonError};

use super::live_timing::{DurationCounts, LiveTiming};

/// Amount of data that a stage has processed, in its own unit such as visibilities or bytes, for its throughput.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Units {
    /// Number since the start.
    pub count: u64,
    /// Name of the unit in the plural; empty if the stage does not count.
    pub name: &'static str,
}

impl Units {
    /// `count` units called `name`.
    #[must_use]
    pub fn of(count: u64, name: &'static str) -> Self {
        Self { count, name }
    }
}

/// Counters of one stage. Only its thread writes them, so stores suffice.
#[derive(Debug)]
pub(super) struct Counters {
    pub(super) name: String,
    /// Capacity of the queue before the stage; `None` for a source.
    pub(super) queue_capacity: Option<usize>,
    pub(super) unit: &'static str,
    items_in: AtomicU64,
    items_out: AtomicU64,
    units: AtomicU64,
    queue_depth_max: AtomicUsize,
    steps: AtomicU64,
    pub(super) working_time: LiveTiming,
    /// Time from the push of the source to the end of the step.
    pub(super) since_source: LiveTiming,
    /// Whether the stage is in a step and not waiting for space in its queue.
    working: AtomicBool,
    finishing: AtomicBool,
    ended: AtomicBool,
}

impl Counters {
    pub(super) fn new(name: &str, queue_capacity: Option<usize>, unit: &'static str) -> Self {
        Self {
            name: name.to_owned(),
            queue_capacity,
            unit,
            items_in: AtomicU64::new(0),
            items_out: AtomicU64::new(0),
            units: AtomicU64::new(0),
            queue_depth_max: AtomicUsize::new(0),
            steps: AtomicU64::new(0),
            working_time: LiveTiming::default(),
            since_source: LiveTiming::default(),
            working: AtomicBool::new(false),
            finishing: AtomicBool::new(false),
            ended: AtomicBool::new(false),
        }
    }

    pub(super) fn count_in(&self) {
        self.items_in.store(self.items_in() + 1, Ordering::Relaxed);
    }

    pub(super) fn count_out(&self) {
        self.items_out.store(self.items_out() + 1, Ordering::Relaxed);
    }

    pub(super) fn set_units(&self, units: Units) {
        self.units.store(units.count, Ordering::Relaxed);
    }

    pub(super) fn note_depth(&self, depth: usize) {
        if depth > self.queue_depth_max() {
            self.queue_depth_max.store(depth, Ordering::Relaxed);
        }
    }

    pub(super) fn count_step(&self) {
        self.steps.store(self.steps.load(Ordering::Relaxed) + 1, Ordering::Relaxed);
    }

    pub(super) fn set_working(&self, working: bool) {
        self.working.store(working, Ordering::Relaxed);
    }

    pub(super) fn is_working(&self) -> bool {
        self.working.load(Ordering::Relaxed) && !self.ended.load(Ordering::Relaxed)
    }

    pub(super) fn set_finishing(&self) {
        self.finishing.store(true, Ordering::Relaxed);
    }

    pub(super) fn is_finishing(&self) -> bool {
        self.finishing.load(Ordering::Relaxed)
    }

    /// Values of which at least one changes with any progress of the stage.
    pub(super) fn progress_marks(&self) -> [u64; 4] {
        let ended = u64::from(self.ended.load(Ordering::Relaxed));
        [self.items_in(), self.items_out(), self.steps.load(Ordering::Relaxed), ended]
    }

    pub(super) fn end(&self) {
        self.ended.store(true, Ordering::Relaxed);
    }

    pub(super) fn items_in(&self) -> u64 {
        self.items_in.load(Ordering::Relaxed)
    }

    pub(super) fn items_out(&self) -> u64 {
        self.items_out.load(Ordering::Relaxed)
    }

    pub(super) fn units(&self) -> Units {
        Units::of(self.units.load(Ordering::Relaxed), self.unit)
    }

    pub(super) fn queue_depth_max(&self) -> usize {
        self.queue_depth_max.load(Ordering::Relaxed)
    }

    fn progress(&self) -> StageProgress {
        StageProgress {
            name: self.name.clone(),
            items_in: self.items_in(),
            items_out: self.items_out(),
            units: self.units(),
            queue_depth_max: self.queue_depth_max(),
            queue_capacity: self.queue_capacity,
            working: self.working_time.read(),
            since_source: self.since_source.read(),
            is_working: self.is_working(),
            ended: self.ended.load(Ordering::Relaxed),
        }
    }
}

/// Snapshot of the counters of one stage.
#[derive(Clone, Debug, PartialEq)]
pub struct StageProgress {
    /// Name of the stage.
    pub name: String,
    /// Items received, including the one being processed.
    pub items_in: u64,
    /// Items sent.
    pub items_out: u64,
    /// Units processed up to the last completed step.
    pub units: Units,
    /// Maximum number of items found in the queue before the stage.
    pub queue_depth_max: usize,
    /// Capacity of the queue before the stage; `None` for a source.
    pub queue_capacity: Option<usize>,
    /// Time of work in each step.
    pub working: DurationCounts,
    /// Time from the push of an item by the source, or from its arrival there, to the end of the step on the items made from it.
    pub since_source: DurationCounts,
    /// Whether the stage is in a step and not waiting for space in its queue.
    pub is_working: bool,
    /// Whether the stage has ended.
    pub ended: bool,
}

/// Live counters of the stages of a graph. Reading them does not delay the stages.
#[derive(Debug, Default)]
pub struct Metrics(Mutex<Vec<Arc<Counters>>>);

impl Metrics {
    /// Snapshots of the counters of all stages, in the order in which they were added.
    #[must_use]
    pub fn snapshot(&self) -> Vec<StageProgress> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner).iter().map(|c| c.progress()).collect()
    }

    pub(super) fn add(&self, counters: Arc<Counters>) {
        self.0.lock().unwrap_or_else(PoisonError::into_inner).push(counters);
    }

    pub(super) fn knows(&self, name: &str) -> bool {
        self.0.lock().unwrap_or_else(PoisonError::into_inner).iter().any(|c| c.name == name)
    }
}
