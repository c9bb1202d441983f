//! Errors of map files.

use std::error::Error;
use std::fmt;
use std::io;
use std::path::{Path, PathBuf};

use thiserror::Error;

use crate::sky::MapError;

/// Problem with a map file, and the path of the file.
#[derive(Debug)]
pub struct FitsError {
    /// Path of the file.
    pub path: PathBuf,
    /// Problem with the file.
    pub problem: Box<FitsProblem>,
}

impl FitsError {
    pub(super) fn new(path: &Path, problem: FitsProblem) -> Self {
        Self { path: path.to_owned(), problem: Box::new(problem) }
    }
}

impl fmt::Display for FitsError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}: {}", self.path.display(), self.problem)
    }
}

impl Error for FitsError {
    fn source(&self) -> Option<&(dyn Error + 'static)> {
        self.problem.source()
    }
}

/// Problem with a map file.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum FitsProblem {
    /// An input or output error.
    #[error("cannot {action}: {source}")]
    Io {
        /// The operation.
        action: &'static str,
        /// Error of the operating system.
        source: io::Error,
    },
    /// The file is empty.
    #[error("the file is empty; expected a FITS file with a HEALPix map")]
    Empty,
    /// The file does not start like a FITS file.
    #[error("not a FITS file: it starts with {found}; expected `SIMPLE  =                    T`")]
    NotFits {
        /// The first bytes, escaped, or the name of the format they belong to.
        found: String,
    },
    /// The file ends early.
    #[error(
        "the file ends at byte {length}; expected {expected} up to byte {needed}: it is truncated or \
             its header is wrong"
    )]
    Truncated {
        /// What was being read.
        expected: &'static str,
        /// Byte at which it would end.
        needed: u64,
        /// Length of the file, bytes.
        length: u64,
    },
    /// A header without END.
    #[error("the header at byte {start} has no END card within {limit} cards; expected one")]
    EndlessHeader {
        /// Byte at which the header starts.
        start: u64,
        /// Maximum number of cards.
        limit: usize,
    },
    /// The file holds no binary table.
    #[error(
        "no binary table of a map among its {units} units (images are none); expected an extension with XTENSION = 'BINTABLE', as \
         healpy writes maps"
    )]
    NoTable {
        /// Number of header-data units found.
        units: usize,
    },
    /// A keyword is missing.
    #[error("the keyword {keyword} is missing; expected {expected}")]
    Missing {
        /// The keyword.
        keyword: String,
        /// Expected value.
        expected: String,
    },
    /// A keyword has an invalid value.
    #[error("the keyword {keyword} is {found}; expected {expected}")]
    Keyword {
        /// The keyword.
        keyword: String,
        /// Value found.
        found: String,
        /// Expected value.
        expected: String,
    },
    /// The file does not state the frame of its map.
    #[error(
        "the keyword COORDSYS is missing, so the map's frame is unknown; expected 'E', 'G' or 'C': add the keyword, or name the \
         frame with --frame (compare, predict, export, calibrate, sky) or the keys sky.frame and map.prior_frame (pipelines): ecliptic, \
         galactic or equatorial"
    )]
    NoFrame,
    /// A map of a quantity other than temperature.
    #[error(
        "the map's unit (TUNIT) is `{found}`; expected K, mK, uK, kK or MK, thermodynamic or Rayleigh-Jeans (K_CMB, K_RJ), Jy/sr, \
         kJy/sr or MJy/sr in a map that states its frequency (FREQ), or none, which is K: convert the map"
    )]
    Unit {
        /// The unit.
        found: String,
    },
    /// No such column.
    #[error("the table has no map column {column} (counted from 0); expected one of its {columns}")]
    NoColumn {
        /// Requested column.
        column: usize,
        /// Number of map columns.
        columns: usize,
    },
    /// The size of the table does not match its nside.
    #[error("column {name} has {found} values; expected {expected} for nside {nside}")]
    ValueCount {
        /// Name of the column.
        name: String,
        /// Values in the table.
        found: u64,
        /// Pixels of the map.
        expected: u64,
        /// nside of the map.
        nside: usize,
    },
    /// An explicitly numbered pixel does not exist or occurs twice.
    #[error("row {row} gives pixel {pixel}; expected each of 0 to {last} at most once")]
    Pixel {
        /// Row of the table, counted from 0.
        row: u64,
        /// The pixel number.
        pixel: i64,
        /// Maximum pixel number.
        last: u64,
    },
    /// A partial map that is too sparse: the full map would be out of proportion to its file.
    #[error(
        "{found} pixels of a map of nside {nside} are too few to expand; expected nside up to {limit}, or \
             at least 1/16 of the sky"
    )]
    Sparse {
        /// Pixels in the file.
        found: u64,
        /// Claimed nside.
        nside: usize,
        /// Maximum nside of partial maps with any number of pixels.
        limit: usize,
    },
    /// A header card that cannot be written.
    #[error("the header card {key} cannot be written: {reason}")]
    Card {
        /// Keyword of the card.
        key: String,
        /// What was expected.
        reason: &'static str,
    },
    /// A value beyond the range of the precision.
    #[error(
        "pixel {pixel} of column {name} is {value:e}, beyond the range of single precision; write double precision"
    )]
    Overflow {
        /// Name of the column.
        name: String,
        /// RING number of the pixel.
        pixel: usize,
        /// Value of the pixel.
        value: f64,
    },
    /// An image of incomplete rows.
    #[error("an image of {found} pixels; expected a multiple of its width, {expected}")]
    ImageSize {
        /// Number of values.
        found: u64,
        /// Number of values in a row.
        expected: u64,
    },
    /// The map itself is invalid.
    #[error(transparent)]
    Map(#[from] MapError),
}

impl FitsProblem {
    pub(super) fn io(action: &'static str) -> impl FnOnce(io::Error) -> Self {
        move |source| Self::Io { action, source }
    }

    pub(super) fn keyword(keyword: &str, found: impl fmt::Display, expected: impl Into<String>) -> Self {
        Self::Keyword { keyword: keyword.to_owned(), found: found.to_string(), expected: expected.into() }
    }

    pub(super) fn missing(keyword: &str, expected: impl Into<String>) -> Self {
        Self::Missing { keyword: keyword.to_owned(), expected: expected.into() }
    }
}
