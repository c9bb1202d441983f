//! Solvers that all map methods share: conjugate gradients, eigenvalues, traces of covariances, and progress reports.

mod conjugate_gradients;
mod fit;
mod lanczos;
mod prologue;
mod traces;
mod vectors;
mod watch;

pub use conjugate_gradients::{Convergence, StoppingRule};
pub(super) use conjugate_gradients::{System, solve_one};
pub use fit::Fit;
pub(super) use fit::FitInputs;
pub use lanczos::{LargestEigenvalue, W_MAX_EXACT, largest_eigenvalue};
pub(super) use lanczos::{largest_eigenvalue_from, normalised, random_vector};
pub use prologue::{Diagnostics, PointBeam};
pub(super) use prologue::{check_request, right_hand_side};
pub use traces::{Estimate, STORED_MAX, Traces, UnsupportedEpsilon, probed_traces, traces};
pub(super) use vectors::{add, dot, orthogonalise, subtract};
pub(super) use watch::SolveTask;
pub use watch::{NamedWatch, SolutionClock, SolveWatch, Solving, SolvingPart};
