//! What the harmonic model refuses.

use thiserror::Error;

/// Why a harmonic model cannot be, or a state cannot be computed.
#[derive(Clone, Debug, Error, PartialEq)]
#[non_exhaustive]
pub enum HarmonicError {
    /// A parameter outside its range.
    #[error("harmonic model: {name} = {value}: expected {expected}")]
    Parameter {
        /// Which.
        name: &'static str,
        /// Value found.
        value: f64,
        /// Range that is accepted.
        expected: &'static str,
    },
    /// A state with a value that is not a number.
    #[error("state {index}: node, phase, baseline and span must be finite numbers")]
    NotFinite {
        /// Its place among the states.
        index: usize,
    },
    /// A baseline beyond what the model was made for.
    #[error(
        "state {index}: a baseline of {u} wavelengths is outside 0 to {u_max}, for which the model was made; \
         raise its u_max"
    )]
    Baseline {
        /// Its place among the states.
        index: usize,
        /// Its baseline in wavelengths.
        u: f64,
        /// Greatest baseline covered.
        u_max: f64,
    },
    /// Input and output differ in length.
    #[error("{states} states, but room for {values} visibilities")]
    Lengths {
        /// States given.
        states: usize,
        /// Values asked for.
        values: usize,
    },
}
