//! What can be wrong with a map file.

use std::error::Error;
use std::fmt;
use std::io;
use std::path::{Path, PathBuf};

use thiserror::Error;

use crate::sky::MapError;

/// A file and what is wrong with it.
#[derive(Debug)]
pub struct FitsError {
    /// The file.
    pub path: PathBuf,
    /// What is wrong.
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

/// What is wrong with a map file.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum FitsProblem {
    /// The operating system refused.
    #[error("cannot {action}: {source}")]
    Io {
        /// What was tried.
        action: &'static str,
        /// The system's answer.
        source: io::Error,
    },
    /// The file has no bytes.
    #[error("the file is empty; expected a FITS file with a HEALPix map")]
    Empty,
    /// The file does not start as FITS files do.
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
        /// Where that would end.
        needed: u64,
        /// Length of the file, bytes.
        length: u64,
    },
    /// A header without END.
    #[error("the header at byte {start} has no END card within {limit} cards; expected one")]
    EndlessHeader {
        /// Where the header starts.
        start: u64,
        /// Most cards a header may have here.
        limit: usize,
    },
    /// The file holds no binary table.
    #[error(
        "no binary table among its {units} units; expected an extension with XTENSION = 'BINTABLE', as \
             healpy writes maps"
    )]
    NoTable {
        /// Header-data units found.
        units: usize,
    },
    /// A keyword is not there.
    #[error("the keyword {keyword} is missing; expected {expected}")]
    Missing {
        /// The keyword.
        keyword: String,
        /// What it should hold.
        expected: String,
    },
    /// A keyword has a value that makes no sense.
    #[error("the keyword {keyword} is {found}; expected {expected}")]
    Keyword {
        /// The keyword.
        keyword: String,
        /// What it holds.
        found: String,
        /// What it should hold.
        expected: String,
    },
    /// The file does not say in which frame its map is.
    #[error(
        "the keyword COORDSYS is missing, so the map's frame is unknown; expected 'E', 'G' or 'C': add \
             the keyword, or name the frame to assume"
    )]
    NoFrame,
    /// A map of something else than temperature.
    #[error(
        "the map's unit (TUNIT) is `{found}`; expected K, mK, uK, kK, MK or none, which is K: convert the map"
    )]
    Unit {
        /// The unit.
        found: String,
    },
    /// No such column.
    #[error("the table has no map column {column} (counted from 0); expected one of its {columns}")]
    NoColumn {
        /// Column asked for.
        column: usize,
        /// Number of map columns.
        columns: usize,
    },
    /// The table's size is not that of the map it claims to hold.
    #[error("column {name} has {found} values; expected {expected} for nside {nside}")]
    ValueCount {
        /// Name of the column.
        name: String,
        /// Values in the table.
        found: u64,
        /// Pixels of the map.
        expected: u64,
        /// Its nside.
        nside: usize,
    },
    /// An explicitly numbered pixel does not exist, or is there twice.
    #[error("row {row} gives pixel {pixel}; expected each of 0 to {last} at most once")]
    Pixel {
        /// Row of the table, counted from 0.
        row: u64,
        /// The pixel number.
        pixel: i64,
        /// Greatest allowed pixel number.
        last: u64,
    },
    /// A partial map so sparse that the full map would be out of proportion to its file.
    #[error(
        "{found} pixels of a map of nside {nside} are too few to expand; expected nside up to {limit}, or \
             at least 1/16 of the sky"
    )]
    Sparse {
        /// Pixels in the file.
        found: u64,
        /// Claimed nside.
        nside: usize,
        /// Greatest nside that any partial map may have.
        limit: usize,
    },
    /// A header card that cannot be written.
    #[error("the header card {key} cannot be written: {reason}")]
    Card {
        /// Its keyword.
        key: String,
        /// What is wrong, and what was expected.
        reason: &'static str,
    },
    /// A value too great for the precision asked for.
    #[error(
        "pixel {pixel} of column {name} is {value:e}, too great for single precision; write double precision"
    )]
    Overflow {
        /// Name of the column.
        name: String,
        /// RING pixel.
        pixel: usize,
        /// Its value.
        value: f64,
    },
    /// The map itself is not usable.
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
