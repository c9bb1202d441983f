//! Progress of a long solution, and how it is interrupted.

use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use crate::ranks::Ranks;
use crate::runtime::Cancel;

/// Progress of a solution.
#[derive(Clone, Debug, PartialEq)]
pub struct Solving {
    /// Number of the task since the start, to tell a new one from the last.
    pub number: u64,
    /// The task: `map at 10.000 MHz`.
    pub what: String,
    /// Products with BtN^-1B so far.
    pub iteration: usize,
    /// Residual reached.
    pub residual: f64,
    /// Residual at which it ends.
    pub target: f64,
    /// The iteration within the one in progress.
    pub part: Option<SolvingPart>,
}

/// Progress of an iteration that is a step of another.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SolvingPart {
    /// What it solves.
    pub what: &'static str,
    /// Products so far.
    pub iteration: usize,
    /// Residual reached.
    pub residual: f64,
    /// Residual at which it ends.
    pub target: f64,
}

/// Shared between a solver, the progress display and the interrupt handler.
#[derive(Clone, Debug)]
pub struct SolveWatch {
    cancel: Cancel,
    /// Time for iterations after cancellation; `None` for no limit.
    time: Option<Duration>,
    state: Arc<Mutex<WatchState>>,
    /// Those who solve together: what one of them ends, all end.
    ranks: Ranks,
}

#[derive(Debug, Default)]
struct WatchState {
    /// Tasks started so far.
    started: u64,
    now: Option<Solving>,
}

/// A watch, and the name under which a solution reports to it.
#[derive(Clone, Copy, Debug)]
pub struct NamedWatch<'a> {
    watch: &'a SolveWatch,
    name: &'a str,
    /// Whether the solution is wanted although the run was cancelled.
    wanted: bool,
}

/// Iterations that a solution may take if the run was interrupted before it began: enough for the well-measured part of
/// a map.
const ITERATIONS_WHEN_CANCELLED: usize = 12;

impl Default for SolveWatch {
    fn default() -> Self {
        Self::new(Cancel::new())
    }
}

impl SolveWatch {
    /// A watch whose solutions end early when `cancel` is triggered.
    #[must_use]
    pub fn new(cancel: Cancel) -> Self {
        Self { cancel, time: None, state: Arc::default(), ranks: Ranks::one() }
    }

    /// The watch of one rank, whose solutions end when any of the ranks ends its own.
    #[must_use]
    pub fn with_ranks(self, ranks: &Ranks) -> Self {
        Self { ranks: ranks.clone(), ..self }
    }

    /// Whether all ranks are to solve the same.
    pub(in crate::imaging) fn agrees(&self, on: &[i64]) -> bool {
        self.ranks.agree(on)
    }

    /// Ends all iterations `time` after cancellation.
    #[must_use]
    pub fn within(self, time: Duration) -> Self {
        Self { time: Some(time), ..self }
    }

    /// Whether the time after cancellation is over.
    fn is_over(&self) -> bool {
        self.cancel.elapsed().zip(self.time).is_some_and(|(elapsed, time)| elapsed >= time)
    }

    /// The solution in progress, if any.
    #[must_use]
    pub fn now(&self) -> Option<Solving> {
        self.state().now.clone()
    }

    /// The watch for a solution of this name.
    #[must_use]
    pub fn named<'a>(&'a self, name: &'a str) -> NamedWatch<'a> {
        NamedWatch { watch: self, name, wanted: true }
    }

    fn state(&self) -> MutexGuard<'_, WatchState> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl<'a> NamedWatch<'a> {
    /// Whether the map is one that the run leaves, not one on the way.
    pub(in crate::imaging) fn is_wanted(self) -> bool {
        self.wanted
    }

    /// Whether the solution is wanted although the run was cancelled; it is unless this says otherwise.
    #[must_use]
    pub fn wanted(self, wanted: bool) -> Self {
        Self { wanted, ..self }
    }

    /// Whether something holds for all ranks.
    pub(in crate::imaging) fn all(self, holds: bool) -> bool {
        self.watch.ranks.all(holds)
    }

    /// Whether it is worth while to go on, for all ranks.
    pub(in crate::imaging) fn goes_on(self) -> bool {
        self.all(self.goes_on_here())
    }

    fn goes_on_here(self) -> bool {
        if self.wanted { !self.watch.is_over() } else { !self.watch.cancel.is_cancelled() }
    }

    /// Starts a task that ends at the residual `target`.
    pub(in crate::imaging) fn start(self, what: &str, target: f64) -> SolveTask<'a> {
        let Self { watch, name, .. } = self;
        let mut state = watch.state();
        state.started += 1;
        let number = state.started;
        let what = format!("{name}: {what}");
        state.now = Some(Solving { number, what, iteration: 0, residual: 1.0, target, part: None });
        SolveTask { named: self, watch, was_cancelled: watch.cancel.is_cancelled(), part: None }
    }

    /// A step of the task in progress that is an iteration of its own and ends at the residual `target`.
    pub(in crate::imaging) fn part(self, what: &'static str, target: f64) -> SolveTask<'a> {
        let was_cancelled = self.watch.cancel.is_cancelled();
        SolveTask { named: self, watch: self.watch, was_cancelled, part: Some((what, target)) }
    }
}

/// A task in progress.
pub(in crate::imaging) struct SolveTask<'a> {
    named: NamedWatch<'a>,
    watch: &'a SolveWatch,
    was_cancelled: bool,
    /// Of a step of another task: what it solves, and the residual at which it ends.
    part: Option<(&'static str, f64)>,
}

impl SolveTask<'_> {
    /// Reports an iteration; whether to continue, for all ranks.
    pub(in crate::imaging) fn report(&self, iteration: usize, residual: f64) -> bool {
        self.report_wanting(true, iteration, residual)
    }

    /// As [`SolveTask::report`], of an iteration that is to continue if it `wants` to.
    pub(in crate::imaging) fn report_wanting(&self, wants: bool, iteration: usize, residual: f64) -> bool {
        // One that has come to its end says so as well: where processors round in other ways, others may not have.
        self.watch.ranks.all(self.report_here(iteration, residual) && wants)
    }

    /// As [`SolveTask::report_wanting`], of several iterations that are made together: which of them continue, for all ranks.
    pub(in crate::imaging) fn report_each(
        &self,
        wants: &[bool],
        iteration: usize,
        residual: f64,
    ) -> Vec<bool> {
        let goes_on = self.report_here(iteration, residual);
        let mut ended: Vec<i64> = wants.iter().map(|wants| i64::from(!(goes_on && *wants))).collect();
        self.watch.ranks.greatest(&mut ended);
        ended.into_iter().map(|ended| ended == 0).collect()
    }

    fn report_here(&self, iteration: usize, residual: f64) -> bool {
        if let Some(solving) = &mut self.watch.state().now {
            match self.part {
                Some((what, target)) => {
                    solving.part = Some(SolvingPart { what, iteration, residual, target });
                }
                None => (solving.iteration, solving.residual) = (iteration, residual),
            }
        }
        if self.was_cancelled {
            iteration < ITERATIONS_WHEN_CANCELLED && self.named.goes_on_here()
        } else {
            !self.watch.cancel.is_cancelled()
        }
    }
}

impl Drop for SolveTask<'_> {
    fn drop(&mut self) {
        let mut state = self.watch.state();
        match (self.part, &mut state.now) {
            (Some(_), Some(solving)) => solving.part = None,
            _ => state.now = None,
        }
    }
}
