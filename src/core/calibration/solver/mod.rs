//! Finds gains, clocks and positions from visibilities of a known signal, pass by pass.
//!
//! | file | holds |
//! |---|---|
//! | `model` | the known signal: a map, an artificial signal, or both |
//! | `circle` | the sky of a map by spherical harmonics |
//! | `sums` | weighted sums of the data by channel and pair, from which a solution is computed |
//! | `layout` | parameters, their priors and their order |
//! | `start` | starting values |
//! | `newton` | Gauss-Newton |
//! | `detect` | whether a daughter delivers signal |
//! | `robust` | outliers, and pairs whose residuals exceed their noise |
//! | `robust_fit` | robust fit to the daughters that deliver signal |
//! | `stability` | drifts and jumps of gains within an interval, errors of the model |
//! | `fit` | fraction of the signal that a solution leaves unexplained |
//! | `assessment` | uncertainty and quality state of each gain |
//! | `solution` | solutions of a pass, divided where gains jump |
//! | `verdict` | what residuals say of the model |
//! | `diagnosis` | what is wrong with the model: its frequency, or a source |
//! | `agree` | whether daughters contradict one another |
//! | `positions` | position errors of a large fraction of a wavelength |
//! | `global` | position errors of radians of phase: a search over all offsets |
//! | `reach` | radius of the search for offsets |
//! | `moments` | the model of a pair at any offset, from moments of its fringe |
//! | `expansion` | expansion of a plane wave in spherical harmonics |
//! | `passes` | a pass, from packets to solutions |
//! | `bound` | Cramer-Rao bounds of a pass |
//! | `events` | events of the instrument |
//! | `monitor` | detection of events from solutions |
//! | `table` | solutions as a table and as a gains file |

mod agree;
mod assessment;
mod bound;
mod circle;
mod config;
#[cfg(test)]
mod cramer_rao;
mod detect;
mod diagnosis;
mod estimates;
mod events;
mod expansion;
mod fit;
mod global;
mod layout;
mod model;
mod moments;
mod monitor;
mod newton;
mod part_gains;
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

pub use assessment::CORRELATED_MAX;
pub use bound::{DaughterBound, GainBound, bounds};
pub use circle::wavelengths_max as known_wavelengths_max;
pub use config::{AmplitudeScale, CalibrationMode, SkyModel, SolverConfig};
pub use diagnosis::ModelFault;
pub use estimates::{DaughterEstimate, GainEstimate, GainState, OutlierFractions};
pub use events::InstrumentEvent;
pub use model::{KnownSignal, Offsets};
pub use monitor::instrument_events;
pub use passes::{PassBlocks, PassSolver, SolvedPass};
pub use solution::{PassData, PassSolution, solve_pass, solve_pass_in_parts};
pub use sums::{MODEL_TERMS, ModelTerms, ModelledBlock};
pub use table::{gains_file, solutions_csv};
pub use verdict::ModelVerdict;
