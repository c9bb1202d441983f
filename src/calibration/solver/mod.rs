//! Finds gains, clocks and positions from visibilities of a known signal, pass by pass.
//!
//! | file | holds |
//! |---|---|
//! | `model` | the known signal: a map, an artificial signal, or both |
//! | `sums` | what a solution needs of the data, by channel and pair |
//! | `newton` | parameters, priors, starting values, Gauss-Newton |
//! | `solution` | robust rounds, and the solution of a pass |
//! | `passes` | a pass from packets to its solutions |
//! | `monitor` | what happened to the instrument |
//! | `table` | tables, and the file of gains |

mod config;
#[cfg(test)]
mod cramer_rao;
mod dense;
mod model;
mod monitor;
mod newton;
mod passes;
mod solution;
mod sums;
mod table;
#[cfg(test)]
mod tests;

pub use config::{AmplitudeScale, CalibrationMode, SolverConfig};
pub use model::{KnownSignal, Offsets};
pub use monitor::{InstrumentEvent, instrument_events};
pub use passes::{PassBlocks, PassSolver, SolvedPass};
pub use solution::{
    DaughterEstimate, GainEstimate, GainState, OutlierParts, PassData, PassSolution, solve_pass,
};
pub use sums::{MODEL_TERMS, ModelTerms, ModelledBlock};
pub use table::{gains_file, solutions_csv};
