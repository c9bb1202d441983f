//! Errors of pictures.

use std::path::PathBuf;

use thiserror::Error;

/// Why a picture could not be drawn or written.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum PictureError {
    /// The number of values is not that of a HEALPix map.
    #[error(
        "panel {panel}: {pixels} values are not a HEALPix map; expected 12 nside^2 of them, with nside a power of two"
    )]
    PixelCount {
        /// Number of the panel, from 0.
        panel: usize,
        /// Number of values found.
        pixels: usize,
    },
    /// An invalid size or count.
    #[error("invalid {what} {value}; expected {expected}")]
    Size {
        /// Which quantity is invalid.
        what: &'static str,
        /// Value found.
        value: usize,
        /// Range that is accepted.
        expected: &'static str,
    },
    /// Invalid limits of a scale.
    #[error("invalid limits {low:e} to {high:e} of a {scaling} scale; expected finite low < high{more}")]
    Limits {
        /// Lower limit found.
        low: f64,
        /// Upper limit found.
        high: f64,
        /// Scaling: linear or logarithmic.
        scaling: &'static str,
        /// Further condition.
        more: &'static str,
    },
    /// The PNG encoder failed.
    #[error("{path}: cannot encode the picture")]
    Encode {
        /// File that was to be written.
        path: PathBuf,
        /// The encoder's reason.
        source: png::EncodingError,
    },
    /// The PNG encoder failed on a tile.
    #[error("cannot encode a tile")]
    EncodeTile {
        /// The encoder's reason.
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
