//! Errors of the harmonic model.

use thiserror::Error;

/// Why a harmonic model cannot be built or evaluated.
#[derive(Clone, Debug, Error, PartialEq)]
#[non_exhaustive]
pub enum HarmonicError {
    /// A parameter outside its range.
    #[error("harmonic model: {name} = {value}: expected {expected}")]
    Parameter {
        /// Name of the parameter.
        name: &'static str,
        /// Value of the parameter.
        value: f64,
        /// Accepted range.
        expected: &'static str,
    },
    /// A state with a value that is not finite.
    #[error("state {index}: node, phase, baseline and span must be finite numbers")]
    NotFinite {
        /// Index of the state.
        index: usize,
    },
    /// A baseline beyond the range of the model.
    #[error(
        "state {index}: a baseline of {u} wavelengths is outside the range of the model, 0 to {u_max}; raise its \
         u_max"
    )]
    Baseline {
        /// Index of the state.
        index: usize,
        /// Baseline of the state, wavelengths.
        u: f64,
        /// Longest baseline of the model, wavelengths.
        u_max: f64,
    },
    /// Input and output differ in length.
    #[error("{states} states, but an output of {values} visibilities; expected equal numbers")]
    Lengths {
        /// Number of states.
        states: usize,
        /// Length of the output.
        values: usize,
    },
}
