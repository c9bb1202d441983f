//! Maps from normal equations: `T = (BtN^-1B + R)^-1 BtN^-1 (V - B T_p) + T_p` with `R = epsilon W_max I`,
//! W_max the largest eigenvalue of `BtN^-1B` (the paper, Sect. 4), or another [`Regulariser`].
//!
//! Pixels are solved by Cholesky factorisation, harmonics and pixels without their matrix by preconditioned conjugate gradients. [`Solver`] is the stage
//! that turns snapshots into maps. Every result has the same bits for any number of threads. Uses
//! [`crate::accumulation`] and [`crate::sky`].

mod beams;
mod cholesky;
mod conjugate_gradients;
mod diagnostics;
mod error;
mod fit;
mod harmonic;
mod lanczos;
mod noises;
mod passes;
mod probing;
mod refined;
mod regulariser;
mod remade;
mod stage;
mod tikhonov;
mod traces;
mod vectors;
mod watch;

pub use beams::harmonic_beams;
pub use cholesky::{Cholesky, NotPositive};
pub use conjugate_gradients::{Convergence, StoppingRule};
pub use diagnostics::{Spectrum, spectrum};
pub use error::SolveError;
pub use fit::Fit;
pub use harmonic::{HarmonicRequest, HarmonicSolution, solve_harmonics, solve_regularised};
pub use lanczos::{LargestEigenvalue, W_MAX_EXACT, largest_eigenvalue};
pub use noises::{NOISES_TOGETHER, solve_noises};
pub use probing::{effective_beam, noise_variance, regularisation};
pub use refined::{ChiSquares, RefineRule, RefineSteps, Refinement, solve_refined};
pub use regulariser::Regulariser;
pub use remade::solve_remade;
pub use stage::{Solution, Solver, SolverSetup};
pub use tikhonov::{Diagnostics, PixelExtras, PixelSolution, PointBeam, solve_pixels, solve_pixels_with};
pub use traces::{Estimate, HELD_MAX, Traces, UnsupportedEpsilon, probed_traces, traces};
pub use watch::{NamedWatch, SolveWatch, Solving, SolvingPart};
