//! Errors of accumulation.

use std::path::PathBuf;

use thiserror::Error;

use crate::response::MeasuredAntennasError;
use crate::response::general::RowsRefusal;
use crate::response::pixel::ResponseError;
use crate::units::{ChannelId, Dimension, InvalidValue, bytes_text};

/// Why visibilities could not be accumulated.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum AccumulationError {
    /// Rows of B cannot be computed.
    #[error(transparent)]
    Response(#[from] ResponseError),
    /// The arrays of a block have unequal lengths.
    #[error(transparent)]
    Lengths(#[from] crate::frames::UnequalLengths),
    /// A prior map cannot be used.
    #[error("map.prior_files: {0}")]
    Prior(#[from] crate::sky::fits::FitsError),
    /// A table of the sky's power that cannot be used.
    #[error("{0}")]
    Beyond(String),
    /// A quantity of an engine's setup is out of range.
    #[error("invalid setup of an engine: {name} = {value}: expected {expected}")]
    Setup {
        /// Quantity.
        name: &'static str,
        /// The value that was found.
        value: f64,
        /// The accepted range.
        expected: &'static str,
    },
    /// Data of a channel that is not in the instrument description.
    #[error("visibilities of channel {0}, which is not in the instrument description")]
    UnknownChannel(ChannelId),
    /// Data to be removed are not in the sums.
    #[error("visibilities of channel {0} are to be removed, but its sums do not hold them")]
    NothingHeld(ChannelId),
    /// A block has another frequency than its engine.
    #[error("a block at {} for an engine at {}", Dimension::Frequency.show(*found_hz), Dimension::Frequency.show(*expected_hz))]
    Frequency {
        /// Frequency of the engine, Hz.
        expected_hz: f64,
        /// Frequency of the block, Hz.
        found_hz: f64,
    },
    /// Per-channel settings do not match the instrument.
    #[error("the downlink's channels: {0}")]
    ChannelSettings(#[from] InvalidValue),
    /// The sums of an instrument would exceed the memory limit.
    #[error(
        "the sums of the downlink's {channels} channels take at least {}: expected at most {}; lower \
         map.nside, map some channels at a time (--groups auto), or state another limit, as in --memory-max {}GB",
        bytes_text(*needed_bytes as f64), bytes_text(*limit_bytes as f64), needed_bytes.div_ceil(1_000_000_000)
    )]
    Memory {
        /// Channels of the instrument.
        channels: usize,
        /// Estimated memory, bytes.
        needed_bytes: u64,
        /// The limit, bytes.
        limit_bytes: u64,
    },
    /// Sums cannot be written to disk.
    #[error("cannot keep sums in {}: {source}; expected room for all of them", folder.display())]
    Store {
        /// Folder.
        folder: PathBuf,
        /// The system's error.
        source: std::io::Error,
    },
    /// Engines of different setups cannot be merged.
    #[error("engines of different {what} cannot be merged")]
    Mismatch {
        /// What differs.
        what: &'static str,
    },
    /// Parts of the sums come from an engine that does not divide its sums among ranks.
    #[error(
        "the sums of this engine are not divided among ranks; expected parts of harmonic sums (map.engine = \"harmonic\")"
    )]
    Undivided,
    /// Combined sums would exceed the range of an engine, or become negative.
    #[error(
        "combined sums would leave the range of an engine: expected room for both at this map.weight_max, and no more \
         removed than held"
    )]
    Range,
    /// The positions of a visibility have no row of B.
    #[error("a visibility has no row of the beam matrix: {0}")]
    Rows(RowsRefusal),
    /// Antennas that files do not say.
    #[error("map.antennas.files: {0}")]
    Antennas(#[from] MeasuredAntennasError),
    /// Merged states hold more visibilities than the limit.
    #[error(
        "channel {channel} of the merged states holds {found} visibilities for refinement; expected at most \
         map.refine.visibilities_max = {limit}: raise it"
    )]
    TooManyVisibilities {
        /// Channel.
        channel: ChannelId,
        /// Number of visibilities of all states.
        found: u64,
        /// The limit.
        limit: u64,
    },
    /// Stored visibilities cannot be divided among ranks.
    #[error(
        "map.refine with a saved state of several ranks; expected one process, or map.refine.passes_max = 0"
    )]
    HeldByRank,
    /// Bodies that move are to be solved for where that is not possible.
    #[error("map.movers with {what}; expected none, or one process without a saved state")]
    Movers {
        /// What they are not solved with.
        what: &'static str,
    },
    /// A segment of visibilities is missing or damaged.
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
