//! Errors of transforms.

use thiserror::Error;

use crate::sky::healpix::NSIDE_MAX;

/// Why a transform failed.
#[derive(Clone, Debug, Error, PartialEq)]
#[non_exhaustive]
pub enum HarmonicsError {
    /// Invalid nside.
    #[error("nside {nside} is not allowed; expected a power of two from 1 to {NSIDE_MAX}")]
    Nside {
        /// Value found.
        nside: usize,
    },
    /// A degree beyond the range of the transforms, or beyond what the map determines.
    #[error("l_max {l_max} is too large; expected at most {most}")]
    Degree {
        /// Value found.
        l_max: usize,
        /// Maximum value.
        most: usize,
    },
    /// Coefficients whose `l_max` differs from the transform's.
    #[error("the coefficients end at l = {found}; expected l_max {expected}")]
    Coefficients {
        /// Value found.
        found: usize,
        /// `l_max` of the transform.
        expected: usize,
    },
    /// A map whose nside differs from the transform's.
    #[error("the map has {found} pixels; expected those of nside {nside}")]
    Pixels {
        /// Number of pixels found.
        found: usize,
        /// nside of the transform.
        nside: usize,
    },
    /// A pixel value that is not a finite number.
    #[error("RING pixel {pixel} is {value}; expected finite values everywhere")]
    NotFinite {
        /// RING number of the pixel.
        pixel: usize,
        /// Value of the pixel.
        value: f64,
    },
    /// The iteration did not reach its tolerance.
    #[error(
        "after {iterations} iterations the residual is {residual:e}; expected {tolerance:e}: allow more \
         iterations or lower l_max: beyond 2.5 nside the pixels hardly distinguish harmonics"
    )]
    NotConverged {
        /// Number of iterations done.
        iterations: usize,
        /// Relative residual reached.
        residual: f64,
        /// Relative residual required.
        tolerance: f64,
    },
}
