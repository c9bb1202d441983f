//! Why visibilities could not be summed.

use std::path::PathBuf;

use thiserror::Error;

use crate::response::general::RowsRefusal;
use crate::response::pixel::ResponseError;
use crate::units::{ChannelId, Dimension, InvalidValue};

/// Why visibilities could not be summed.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum AccumulationError {
    /// Rows of B cannot be computed.
    #[error(transparent)]
    Response(#[from] ResponseError),
    /// A block whose arrays are not of one length.
    #[error(transparent)]
    Lengths(#[from] crate::frames::UnequalLengths),
    /// A prior map that cannot be used.
    #[error("map.prior_files: {0}")]
    Prior(#[from] crate::sky::fits::FitsError),
    /// A table of the sky's power that cannot be used.
    #[error("map.beyond_files: {0}")]
    Beyond(String),
    /// A setup out of range.
    #[error("invalid setup of an engine: {name} = {value}: expected {expected}")]
    Setup {
        /// Quantity.
        name: &'static str,
        /// Value found.
        value: f64,
        /// Range that is accepted.
        expected: &'static str,
    },
    /// Data of a channel that is not in the instrument description.
    #[error("visibilities of channel {0}, which is not in the instrument description")]
    UnknownChannel(ChannelId),
    /// Data to be removed that the sums do not hold.
    #[error("visibilities of channel {0} are to be removed, but its sums do not hold them")]
    NothingHeld(ChannelId),
    /// Data of another frequency.
    #[error("a block at {} for an engine at {}", Dimension::Frequency.show(*found_hz), Dimension::Frequency.show(*expected_hz))]
    Frequency {
        /// The engine's, Hz.
        expected_hz: f64,
        /// The block's, Hz.
        found_hz: f64,
    },
    /// Settings by channel do not match the instrument.
    #[error("the downlink's channels: {0}")]
    Misfit(#[from] InvalidValue),
    /// The sums of an instrument take more memory than there is.
    #[error(
        "the sums of the downlink's {channels} channels take at least {:.1} GB: expected at most {:.1} GB; lower \
         map.nside, map some channels at a time (--groups auto), or state another limit, as in --memory-max {}GB",
        *needed_bytes as f64 / 1e9, *limit_bytes as f64 / 1e9, needed_bytes.div_ceil(1_000_000_000)
    )]
    Memory {
        /// Channels of the instrument.
        channels: usize,
        /// Estimated need, bytes.
        needed_bytes: u64,
        /// The limit, bytes.
        limit_bytes: u64,
    },
    /// Sums that wait on disk cannot be written.
    #[error("cannot keep sums in {}: {source}; expected room for all of them", folder.display())]
    Store {
        /// Folder.
        folder: PathBuf,
        /// The system's error.
        source: std::io::Error,
    },
    /// Engines of different setups.
    #[error("engines of different {what} cannot be merged")]
    Mismatch {
        /// What differs.
        what: &'static str,
    },
    /// Engines whose combined sums would exceed the range, or fall below nothing.
    #[error(
        "combined sums would leave the range of an engine: expected room for both at this map.weight_max, and no more \
         removed than held"
    )]
    Range,
    /// Positions without a row of B.
    #[error("a visibility has no row of the beam matrix: {0}")]
    Rows(RowsRefusal),
    /// More visibilities than may be held for refinement.
    #[error(
        "channel {channel} of the merged states holds {found} visibilities for refinement; expected at most \
         map.refine.visibilities_max = {most}: raise it"
    )]
    TooManyVisibilities {
        /// Channel.
        channel: ChannelId,
        /// Visibilities of all.
        found: u64,
        /// The limit.
        most: u64,
    },
    /// Ranks that hold visibilities one by one.
    #[error(
        "map.refine with a saved state of several ranks; expected one process, or map.refine.passes_max = 0"
    )]
    HeldByRank,
    /// A segment of visibilities that is missing or damaged.
    #[error("{}: found {found}; expected the visibilities that the checkpoint names", path.display())]
    Segment {
        /// The file.
        path: PathBuf,
        /// What was found.
        found: String,
    },
    /// A checkpoint could not be read or written.
    #[error("checkpoint: {0}")]
    Io(#[from] std::io::Error),
    /// A checkpoint is damaged or of another format.
    #[error("checkpoint: found {found}, expected {expected}")]
    Checkpoint {
        /// What was found.
        found: String,
        /// What was expected.
        expected: &'static str,
    },
}
