//! Maps from normal equations: `T = (BtN^-1B + R)^-1 BtN^-1 (V - B T_p) + T_p` with `R = epsilon W_max I`,
//! W_max the largest eigenvalue of `BtN^-1B` (the paper, Sect. 4).
//!
//! Uses [`crate::accumulation`] and [`crate::sky`].

mod cholesky;
mod diagnostics;
mod error;
mod lanczos;
mod stage;
mod tikhonov;

pub use cholesky::{Cholesky, NotPositive};
pub use diagnostics::{Spectrum, spectrum};
pub use error::SolveError;
pub use lanczos::{LargestEigenvalue, largest_eigenvalue};
pub use stage::{Solution, Solver, SolverSetup};
pub use tikhonov::{Diagnostics, PixelSolution, solve_pixels};
