//! Finds gains, clocks and positions from visibilities of a known signal, pass by pass.
//!
//! | file | holds |
//! |---|---|
//! | `model` | the known signal: a map, an artificial signal, or both |
//! | `circle` | the sky of a map by spherical harmonics |
//! | `sums` | what a solution needs of the data, by channel and pair |
//! | `layout` | parameters and priors |
//! | `start` | starting values |
//! | `newton` | Gauss-Newton |
//! | `detect` | whether a daughter delivers signal |
//! | `robust` | outliers, and pairs whose model is not as good as their noise |
//! | `robust_fit` | robust rounds among the daughters that deliver signal |
//! | `stability` | gains that change within an interval, jumps, errors of the model |
//! | `fit` | how much of the signal a solution leaves |
//! | `verdict` | stated errors, and which gains are good |
//! | `solution` | solutions of a pass, in parts where gains jump |
//! | `agree` | whether daughters contradict one another |
//! | `positions` | positions that are off by a good part of a wavelength |
//! | `global` | positions that are off by radians: a search over all offsets |
//! | `reach` | how far they are searched |
//! | `moments` | a pair at any offset |
//! | `expansion` | a plane wave of an offset by spherical harmonics |
//! | `passes` | a pass from packets to its solutions |
//! | `bound` | what a pass can tell at best |
//! | `monitor` | what happened to the instrument |
//! | `table` | tables, and the file of gains |

mod agree;
mod bound;
mod circle;
mod config;
#[cfg(test)]
mod cramer_rao;
mod dense;
mod detect;
mod estimates;
mod expansion;
mod fit;
mod global;
mod layout;
mod model;
mod moments;
mod monitor;
mod newton;
mod passes;
#[cfg(test)]
mod position_tests;
mod positions;
mod reach;
mod robust;
mod robust_fit;
#[cfg(test)]
mod scenario_tests;
mod smooth;
mod solution;
mod stability;
mod start;
mod sums;
mod table;
#[cfg(test)]
mod tests;
mod verdict;

pub use bound::{DaughterBound, GainBound, bounds};
pub use circle::wavelengths_max as known_wavelengths_max;
pub use config::{AmplitudeScale, CalibrationMode, SkyModel, SolverConfig};
pub use estimates::{DaughterEstimate, GainEstimate, GainState, OutlierParts};
pub use model::{KnownSignal, Offsets};
pub use monitor::{InstrumentEvent, instrument_events};
pub use passes::{PassBlocks, PassSolver, SolvedPass};
pub use solution::{PassData, PassSolution, solve_pass, solve_pass_in_parts};
pub use sums::{MODEL_TERMS, ModelTerms, ModelledBlock};
pub use table::{gains_file, solutions_csv};
