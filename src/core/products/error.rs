//! Errors of products.

use std::path::{Path, PathBuf};

use thiserror::Error;

use crate::files::write_atomically;
use crate::sky::MapError;
use crate::sky::fits::FitsError;

/// What to do about a folder that cannot be written. A refused name, and a folder in use, say themselves what was expected.
fn folder_hint(source: &std::io::Error) -> &'static str {
    match source.kind() {
        std::io::ErrorKind::InvalidInput | std::io::ErrorKind::ResourceBusy => "",
        _ => "; expected a writable folder (choose one with --out)",
    }
}

/// Writes a product, which is there whole or not at all.
///
/// # Errors
/// [`ProductsError::Write`].
pub fn write_product(path: &Path, bytes: impl AsRef<[u8]>) -> Result<(), ProductsError> {
    write_atomically(path, bytes.as_ref()).map_err(ProductsError::write(path))
}

/// Creates a folder for products.
///
/// # Errors
/// [`ProductsError::Write`].
pub fn create_folder(path: &Path) -> Result<(), ProductsError> {
    std::fs::create_dir_all(path).map_err(ProductsError::write(path))
}

impl ProductsError {
    /// The error of a file or folder that cannot be written.
    #[doc(hidden)]
    pub fn write(path: &Path) -> impl FnOnce(std::io::Error) -> Self + use<> {
        let path = path.to_owned();
        move |source| Self::Write { path, source }
    }
}

/// Errors of products.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum ProductsError {
    /// A file or folder that cannot be written.
    #[error("cannot write {}: {source}{}", path.display(), folder_hint(source))]
    Write {
        /// Path of the file or folder.
        path: PathBuf,
        /// Error of the system.
        source: std::io::Error,
    },
    /// A folder that is not empty.
    #[error("{}: the folder contains files; expected a new or empty folder", path.display())]
    NotEmpty {
        /// The folder.
        path: PathBuf,
    },
    /// The summary of a run that cannot be read.
    #[error("cannot read {}: {source}; expected the folder of a finished run", path.display())]
    Read {
        /// Path of the file or folder.
        path: PathBuf,
        /// Error of the system.
        source: std::io::Error,
    },
    /// A file that is not the summary of a run of this version.
    #[error("{}: {reason}; expected a summary.json that `lunarray run`, `replay` or `study` wrote", path.display())]
    NotASummary {
        /// Path of the file or folder.
        path: PathBuf,
        /// Description of the problem.
        reason: String,
    },
    /// Data that cannot be encoded.
    #[error("cannot encode {}: {reason}", path.display())]
    Encode {
        /// Path of the file or folder.
        path: PathBuf,
        /// Error of the encoder.
        reason: String,
    },
    /// A downlink file that cannot be read.
    #[error(transparent)]
    Downlink {
        /// Error of the downlink.
        source: Box<crate::downlink::DownlinkError>,
    },
    /// A downlink file without a description of the instrument.
    #[error("{}: no description of the instrument; expected a file from the start of a downlink", path.display())]
    NoInstrument {
        /// The file.
        path: PathBuf,
    },
    /// An interrupted read.
    #[error("{}: reading was interrupted before the end of the file", path.display())]
    Interrupted {
        /// The file.
        path: PathBuf,
    },
    /// An invalid map.
    #[error(transparent)]
    Map(#[from] MapError),
    /// A picture that cannot be drawn or written.
    #[error(transparent)]
    Picture(#[from] crate::products::pictures::PictureError),
    /// A map file that cannot be written.
    #[error(transparent)]
    Fits(#[from] FitsError),
}
