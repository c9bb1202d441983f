//! Errors of maps.

use thiserror::Error;

use super::healpix::NSIDE_MAX;

/// Why an operation on a map failed.
#[derive(Clone, Debug, Error, PartialEq)]
#[non_exhaustive]
pub enum MapError {
    /// The number of values does not fit a HEALPix map.
    #[error(
        "{pixels} values do not make a HEALPix map; expected 12 nside^2, nside a power of two up to {NSIDE_MAX}"
    )]
    PixelCount {
        /// Number of values found.
        pixels: usize,
    },
    /// Invalid nside.
    #[error("nside {nside} is not allowed; expected a power of two from 1 to {NSIDE_MAX}")]
    Nside {
        /// Value found.
        nside: usize,
    },
    /// The target nside of an upgrade or degradation is in the wrong direction.
    #[error("a map of nside {from} cannot be {verb} to nside {to}; expected {expected}")]
    Direction {
        /// The operation, "degraded" or "upgraded".
        verb: &'static str,
        /// nside of the map.
        from: usize,
        /// Requested nside.
        to: usize,
        /// Allowed values.
        expected: &'static str,
    },
    /// Pixels without a usable value.
    #[error(
        "{count} of {total} pixels have no usable value, the first is RING pixel {first} with {value:e}; \
         expected finite numbers everywhere (UNSEEN is -1.6375e30, in another unit a power of ten of it): fill or mask these pixels first"
    )]
    BadPixels {
        /// Number of pixels that are NaN, infinite or UNSEEN.
        count: usize,
        /// Number of pixels of the map.
        total: usize,
        /// RING number of the first such pixel.
        first: usize,
        /// Value of the first such pixel.
        value: f64,
    },
    /// Pixels that are no temperature of a sky.
    #[error(
        "{count} of {total} pixels are no temperature of a sky, the first is RING pixel {first} with {value:e} K; expected \
         -{most:e} K to {most:e} K everywhere"
    )]
    NoTemperature {
        /// Number of such pixels.
        count: usize,
        /// Number of pixels of the map.
        total: usize,
        /// RING number of the first such pixel.
        first: usize,
        /// Value of the first such pixel, K.
        value: f64,
        /// Maximum temperature, K.
        most: f64,
    },
    /// A sky without power, with receivers without noise.
    #[error(
        "the mean of the pixels is {value:e} K: without power visibilities have no weight; expected a mean of 1e-16 K or more, or \
         spacecraft.receiver_noise_k_sr above 0"
    )]
    Dark {
        /// Mean of the pixels, K.
        value: f64,
    },
    /// A sky without power, with which nothing can be calibrated.
    #[error(
        "the mean of the pixels is {value:e} K, a sky of which nothing can be known; expected a mean of 1e-16 K or more, to calibrate with"
    )]
    NothingKnown {
        /// Mean of the pixels, K.
        value: f64,
    },
    /// Invalid width of a Gaussian beam.
    #[error("a beam of FWHM {fwhm_rad} rad is not allowed; expected a finite width of at least 0")]
    Width {
        /// Value found, rad.
        fwhm_rad: f64,
    },
    /// A transform of the map failed.
    #[error(transparent)]
    Harmonics(#[from] crate::sky::harmonics::HarmonicsError),
}
