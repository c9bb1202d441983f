//! What can be wrong with a picture.

use std::path::PathBuf;

use thiserror::Error;

/// Why there is no picture.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum PictureError {
    /// The number of values is not that of a HEALPix map.
    #[error("panel {panel}: {pixels} values are no HEALPix map; expected 12 nside^2, nside a power of two")]
    PixelCount {
        /// Number of the panel, from 0.
        panel: usize,
        /// Number of values found.
        pixels: usize,
    },
    /// A size that is not drawn.
    #[error("a picture with {what} {value} is not drawn; expected {expected}")]
    Size {
        /// What is too small or too large.
        what: &'static str,
        /// Value found.
        value: usize,
        /// Range that is accepted.
        expected: &'static str,
    },
    /// Limits of a scale that leave nothing to draw.
    #[error("limits {low:e} to {high:e} are no {stretch} scale; expected finite low < high{more}")]
    Limits {
        /// Value found for the lower end.
        low: f64,
        /// Value found for the upper end.
        high: f64,
        /// The scale.
        stretch: &'static str,
        /// What else is expected.
        more: &'static str,
    },
    /// The PNG encoder gave up.
    #[error("{path}: cannot encode the picture")]
    Encode {
        /// File that was to be written.
        path: PathBuf,
        /// Its reason.
        source: png::EncodingError,
    },
    /// The file could not be written.
    #[error("{path}: cannot write the picture; check that the folder exists and is writable")]
    Write {
        /// File that was to be written.
        path: PathBuf,
        /// The system's reason.
        source: std::io::Error,
    },
}
