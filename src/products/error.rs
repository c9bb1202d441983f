//! Why a product could not be made.

use std::path::PathBuf;

use thiserror::Error;

use crate::sky::MapError;
use crate::sky::fits::FitsError;

/// Why a product could not be made.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum ProductsError {
    /// A file or folder that cannot be written.
    #[error("cannot write {}: {source}; expected a writable place (choose one with --out)", path.display())]
    Write {
        /// Path.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// Something that has no encoding.
    #[error("cannot encode {}: {reason}", path.display())]
    Encode {
        /// Path.
        path: PathBuf,
        /// What the encoder said.
        reason: String,
    },
    /// A map.
    #[error(transparent)]
    Map(#[from] MapError),
    /// A picture.
    #[error(transparent)]
    Picture(#[from] crate::products::pictures::PictureError),
    /// A map file.
    #[error(transparent)]
    Fits(#[from] FitsError),
}
