//! Progress reports and interruption of long solutions.

use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use crate::ranks::Ranks;
use crate::runtime::Cancel;

/// Progress of a solution.
#[derive(Clone, Debug, PartialEq)]
pub struct Solving {
    /// Number of the task since the start.
    pub number: u64,
    /// Description of the task, such as `10.000 MHz: map`.
    pub what: String,
    /// Number of iterations so far.
    pub iteration: usize,
    /// Current residual.
    pub residual: f64,
    /// Target residual.
    pub target: f64,
    /// Progress of the inner iteration, if one is running.
    pub part: Option<SolvingPart>,
}

/// Progress of an inner iteration.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SolvingPart {
    /// Description of the inner iteration.
    pub what: &'static str,
    /// Number of iterations so far.
    pub iteration: usize,
    /// Current residual.
    pub residual: f64,
    /// Target residual.
    pub target: f64,
}

/// Estimates the time left of a solution from how its residual falls.
#[derive(Debug, Default)]
pub struct SolutionClock {
    /// The solution in progress: its number, when it was first seen, and its residual at that time.
    seen: Option<(u64, Instant, f64)>,
}

impl SolutionClock {
    /// Time left, s, if the residual keeps falling at the same rate; `None` at the beginning.
    pub fn left_s(&mut self, solving: &Solving) -> Option<f64> {
        let &Solving { number, residual, target, .. } = solving;
        let (_, since, first) = match self.seen {
            Some(seen) if seen.0 == number => seen,
            _ => *self.seen.insert((number, Instant::now(), residual)),
        };
        let (done, total) = ((first / residual).ln(), (first / target).ln());
        let elapsed_s = since.elapsed().as_secs_f64();
        (done > 0.05 * total && elapsed_s > 1.0).then(|| elapsed_s * (total / done - 1.0).max(0.0))
    }
}

/// The progress of a solver, which the progress display and the interrupt handler share.
#[derive(Clone, Debug)]
pub struct SolveWatch {
    cancel: Cancel,
    /// Time limit after cancellation; `None` for no limit.
    grace: Option<Duration>,
    state: Arc<Mutex<WatchState>>,
    /// The ranks that solve together; when one stops an iteration, all stop.
    ranks: Ranks,
}

#[derive(Debug, Default)]
struct WatchState {
    /// Number of tasks started so far.
    started: u64,
    current: Option<Solving>,
    /// Whether cancellation ended a solution before its end, since [`SolveWatch::begin`]: that of a map, and what is computed beside it.
    was_cut: [bool; 2],
}

/// A watch with the name under which a solution reports to it.
#[derive(Clone, Copy, Debug)]
pub struct NamedWatch<'a> {
    watch: &'a SolveWatch,
    name: &'a str,
    /// Whether it is of a final map, which may still begin after the run was cancelled, for few iterations and within the time limit.
    is_of_final_map: bool,
    /// Whether what is computed is beside the map: errors, beams, traces.
    is_beside_map: bool,
}

/// Maximum number of iterations of a solution that starts after cancellation without a time limit: enough for the well-measured modes of a map.
const ITERATIONS_WHEN_CANCELLED: usize = 12;

impl Default for SolveWatch {
    fn default() -> Self {
        Self::new(Cancel::new())
    }
}

impl SolveWatch {
    /// Creates a watch whose solutions end early when `cancel` is triggered.
    #[must_use]
    pub fn new(cancel: Cancel) -> Self {
        Self { cancel, grace: None, state: Arc::default(), ranks: Ranks::single() }
    }

    /// Makes it the watch of one rank: an iteration stops when any rank stops its own.
    #[must_use]
    pub fn with_ranks(self, ranks: &Ranks) -> Self {
        Self { ranks: ranks.clone(), ..self }
    }

    /// Whether all ranks have equal values.
    pub(in crate::imaging) fn agrees(&self, values: &[i64]) -> bool {
        self.ranks.have_equal(values)
    }

    /// Ends all iterations `grace` after cancellation.
    #[must_use]
    pub fn with_grace(self, grace: Duration) -> Self {
        Self { grace: Some(grace), ..self }
    }

    /// Whether `cancel` was triggered.
    #[must_use]
    pub fn is_cancelled(&self) -> bool {
        self.cancel.is_cancelled()
    }

    /// Whether the time limit after cancellation has passed.
    fn is_expired(&self) -> bool {
        self.cancel.elapsed().zip(self.grace).is_some_and(|(elapsed, grace)| elapsed >= grace)
    }

    /// The progress of the current task, if any.
    #[must_use]
    pub fn progress(&self) -> Option<Solving> {
        self.state().current.clone()
    }

    /// Begins a solution of its own.
    pub(in crate::imaging) fn begin(&self) {
        self.state().was_cut = [false; 2];
    }

    /// Whether cancellation ended the solution of the map and its noise map before its end, so that they are not those of the data.
    pub(in crate::imaging) fn was_cut(&self) -> bool {
        self.state().was_cut[0]
    }

    /// Whether it ended what is computed beside the map before its end.
    pub(in crate::imaging) fn was_cut_beside(&self) -> bool {
        self.state().was_cut[1]
    }

    /// The watch with a solution's name; see [`NamedWatch::of_final_map`] for its priority.
    #[must_use]
    pub fn named<'a>(&'a self, name: &'a str) -> NamedWatch<'a> {
        NamedWatch { watch: self, name, is_of_final_map: true, is_beside_map: false }
    }

    fn state(&self) -> MutexGuard<'_, WatchState> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl<'a> NamedWatch<'a> {
    /// Whether the solution is of a final map.
    pub(in crate::imaging) fn is_of_final_map(self) -> bool {
        self.is_of_final_map
    }

    /// Sets whether the solution is of a final map (the default), which may still begin after cancellation, or of an intermediate one.
    #[must_use]
    pub fn of_final_map(self, is_of_final_map: bool) -> Self {
        Self { is_of_final_map, ..self }
    }

    /// The watch of what is computed beside the map: if it ends early, the map is whole.
    pub(in crate::imaging) fn beside_map(self) -> Self {
        Self { is_beside_map: true, ..self }
    }

    /// Remembers what cancellation ended.
    fn note_cut(self, is_cut: bool) {
        // A rank does not know of signals to others.
        let is_cancelled = self.watch.cancel.is_cancelled() || self.watch.ranks.is_distributed();
        self.watch.state().was_cut[usize::from(self.is_beside_map)] |= is_cut && is_cancelled;
    }

    /// Whether `holds` is true on all ranks.
    pub(in crate::imaging) fn all(self, holds: bool) -> bool {
        self.watch.ranks.all(holds)
    }

    /// Whether the solution may continue on all ranks.
    pub(in crate::imaging) fn may_continue(self) -> bool {
        let continues = self.all(self.may_continue_here());
        self.note_cut(!continues);
        continues
    }

    fn may_continue_here(self) -> bool {
        if self.is_of_final_map { !self.watch.is_expired() } else { !self.watch.cancel.is_cancelled() }
    }

    /// Starts a task with the residual `target`.
    pub(in crate::imaging) fn start(self, what: &str, target: f64) -> SolveTask<'a> {
        let Self { watch, name, .. } = self;
        let mut state = watch.state();
        state.started += 1;
        let number = state.started;
        let what = format!("{name}: {what}");
        let solving = Solving { number, what, iteration: 0, residual: 1.0, target, part: None };
        let before = state.current.replace(solving);
        SolveTask { named: self, watch, was_cancelled: watch.cancel.is_cancelled(), inner: None, before }
    }

    /// Starts an inner iteration of the current task, with its own residual `target`.
    pub(in crate::imaging) fn inner(self, what: &'static str, target: f64) -> SolveTask<'a> {
        let was_cancelled = self.watch.cancel.is_cancelled();
        SolveTask { named: self, watch: self.watch, was_cancelled, inner: Some((what, target)), before: None }
    }
}

pub(in crate::imaging) struct SolveTask<'a> {
    named: NamedWatch<'a>,
    watch: &'a SolveWatch,
    was_cancelled: bool,
    /// Description and target residual, for an inner iteration.
    inner: Option<(&'static str, f64)>,
    /// The task of which it is a step.
    before: Option<Solving>,
}

impl SolveTask<'_> {
    /// Reports an iteration, and returns whether all ranks continue.
    pub(in crate::imaging) fn report(&self, iteration: usize, residual: f64) -> bool {
        self.report_step(true, iteration, residual)
    }

    /// Reports an iteration that needs another step if `needs_step`, and returns whether all ranks continue.
    pub(in crate::imaging) fn report_step(&self, needs_step: bool, iteration: usize, residual: f64) -> bool {
        // A rank that has converged takes part too: on other processors rounding may differ.
        let continues = self.watch.ranks.all(self.report_here(iteration, residual) && needs_step);
        self.named.note_cut(needs_step && !continues);
        continues
    }

    /// Reports several iterations that share products, and returns which of them continue on all ranks.
    pub(in crate::imaging) fn report_each(
        &self,
        needs_step: &[bool],
        iteration: usize,
        residual: f64,
    ) -> Vec<bool> {
        let continues = self.report_here(iteration, residual);
        let mut stops: Vec<i64> =
            needs_step.iter().map(|needs_step| i64::from(!(continues && *needs_step))).collect();
        self.watch.ranks.max(&mut stops);
        self.named.note_cut(needs_step.iter().zip(&stops).any(|(needs, stops)| *needs && *stops != 0));
        stops.into_iter().map(|stops| stops == 0).collect()
    }

    fn report_here(&self, iteration: usize, residual: f64) -> bool {
        if let Some(solving) = &mut self.watch.state().current {
            match self.inner {
                Some((what, target)) => {
                    solving.part = Some(SolvingPart { what, iteration, residual, target });
                }
                None => (solving.iteration, solving.residual) = (iteration, residual),
            }
        }
        if self.named.is_of_final_map && self.watch.grace.is_some() {
            return self.named.may_continue_here();
        }
        match self.was_cancelled {
            true => iteration < ITERATIONS_WHEN_CANCELLED && self.named.may_continue_here(),
            false => !self.watch.cancel.is_cancelled(),
        }
    }
}

impl Drop for SolveTask<'_> {
    fn drop(&mut self) {
        let mut state = self.watch.state();
        match (self.inner, &mut state.current) {
            (Some(_), Some(solving)) => solving.part = None,
            _ => state.current = self.before.take(),
        }
    }
}
