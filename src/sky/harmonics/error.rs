//! What can be wrong with a transform.

use thiserror::Error;

use crate::sky::healpix::NSIDE_MAX;

/// Why a transform cannot be made or used.
#[derive(Clone, Debug, Error, PartialEq)]
#[non_exhaustive]
pub enum HarmonicsError {
    /// Not an nside.
    #[error("nside {nside} is not allowed; expected a power of two from 1 to {NSIDE_MAX}")]
    Nside {
        /// Value found.
        nside: usize,
    },
    /// A degree beyond what the transforms can do, or what the map can determine.
    #[error("l_max {l_max} is too great; expected at most {most}")]
    Degree {
        /// Value found.
        l_max: usize,
        /// Greatest allowed value.
        most: usize,
    },
    /// Coefficients of another `l_max` than the transform's.
    #[error("the coefficients end at l = {found}; expected l_max {expected}")]
    Coefficients {
        /// Value found.
        found: usize,
        /// The transform's.
        expected: usize,
    },
    /// A map of another nside than the transform's.
    #[error("the map has {found} pixels; expected those of nside {nside}")]
    Pixels {
        /// Number found.
        found: usize,
        /// The transform's nside.
        nside: usize,
    },
    /// A pixel that is not a finite number.
    #[error("RING pixel {pixel} is {value}; expected finite values everywhere")]
    NotFinite {
        /// RING number.
        pixel: usize,
        /// Its value.
        value: f64,
    },
    /// An iteration that did not reach its tolerance.
    #[error(
        "after {iterations} iterations the residual is {residual:e}; expected {tolerance:e}: allow more \
         iterations, or lower l_max, as beyond 2.5 nside pixels hardly tell harmonics apart"
    )]
    NotConverged {
        /// Iterations done.
        iterations: usize,
        /// Relative residual reached.
        residual: f64,
        /// Relative residual asked for.
        tolerance: f64,
    },
}
