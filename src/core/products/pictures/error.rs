//! Errors of pictures.

use std::path::PathBuf;

use thiserror::Error;

/// Errors of drawing or writing a picture.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum PictureError {
    /// A number of values that is not that of a HEALPix map.
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
        /// Name of the quantity.
        what: &'static str,
        /// Value found.
        value: usize,
        /// Accepted range.
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
    /// An error of the PNG encoder.
    #[error("{path}: cannot encode the picture")]
    Encode {
        /// Path of the picture.
        path: PathBuf,
        /// Error of the encoder.
        source: png::EncodingError,
    },
    /// An error of the PNG encoder for a tile.
    #[error("cannot encode a tile")]
    EncodeTile {
        /// Error of the encoder.
        source: png::EncodingError,
    },
    /// A file that cannot be written.
    #[error("{path}: cannot write the picture; check that the folder exists and is writable")]
    Write {
        /// Path of the picture.
        path: PathBuf,
        /// Error of the system.
        source: std::io::Error,
    },
}
