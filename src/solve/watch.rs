//! What a long solution tells of itself while it works, and how it is asked to end.

use std::sync::{Arc, Mutex, PoisonError};

use crate::runtime::Cancel;

/// How far a solution is.
#[derive(Clone, Debug, PartialEq)]
pub struct Solving {
    /// Number of the work since the start, so that a new one can be told from the last.
    pub number: u64,
    /// What is done: `map at 10.000 MHz`.
    pub what: String,
    /// Products with BtN^-1B so far.
    pub iteration: usize,
    /// Residual reached.
    pub residual: f64,
    /// Residual at which it ends.
    pub target: f64,
}

/// Shared between a solver, whoever shows its progress, and whoever may interrupt it.
#[derive(Clone, Debug, Default)]
pub struct SolveWatch {
    cancel: Cancel,
    state: Arc<Mutex<(u64, Option<Solving>)>>,
}

/// Iterations that a solution still gets when the run was interrupted before it began: enough for the well-measured
/// part of a map.
const ITERATIONS_WHEN_CANCELLED: usize = 12;

impl SolveWatch {
    /// A watch whose solutions end early when `cancel` is triggered.
    #[must_use]
    pub fn new(cancel: Cancel) -> Self {
        Self { cancel, state: Arc::default() }
    }

    /// What is being solved now, if anything.
    #[must_use]
    pub fn now(&self) -> Option<Solving> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner).1.clone()
    }

    /// Starts a piece of work.
    pub(super) fn start(&self, what: String, target: f64) -> Work<'_> {
        let mut state = self.state.lock().unwrap_or_else(PoisonError::into_inner);
        state.0 += 1;
        let number = state.0;
        state.1 = Some(Solving { number, what, iteration: 0, residual: 1.0, target });
        Work { watch: self, was_cancelled: self.cancel.is_cancelled() }
    }
}

/// One piece of work under watch.
pub(super) struct Work<'a> {
    watch: &'a SolveWatch,
    was_cancelled: bool,
}

impl Work<'_> {
    /// Notes an iteration; whether to go on.
    pub(super) fn goes_on(&self, iteration: usize, residual: f64) -> bool {
        let mut state = self.watch.state.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(solving) = &mut state.1 {
            solving.iteration = iteration;
            solving.residual = residual;
        }
        if self.was_cancelled {
            iteration < ITERATIONS_WHEN_CANCELLED
        } else {
            !self.watch.cancel.is_cancelled()
        }
    }
}

impl Drop for Work<'_> {
    fn drop(&mut self) {
        self.watch.state.lock().unwrap_or_else(PoisonError::into_inner).1 = None;
    }
}
