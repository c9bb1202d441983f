//! Why visibilities could not be summed.

use thiserror::Error;

use crate::response::pixel::ResponseError;
use crate::units::{ChannelId, InvalidValue};

/// Why visibilities could not be summed.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum AccumulationError {
    /// Rows of B cannot be made.
    #[error(transparent)]
    Response(#[from] ResponseError),
    /// An engine that cannot be.
    #[error("engine of a map: {name} = {value}: expected {expected}")]
    Setup {
        /// Quantity.
        name: &'static str,
        /// Value found.
        value: f64,
        /// Range that is accepted.
        expected: &'static str,
    },
    /// Data of a channel that the instrument description does not have.
    #[error("visibilities of channel {0} arrived, which the instrument description does not have")]
    UnknownChannel(ChannelId),
    /// Data to be taken out of sums that are not there.
    #[error("visibilities of channel {0} are to be taken out, but nothing of it was ever put in")]
    NothingHeld(ChannelId),
    /// Data of another frequency.
    #[error("a block at {found_hz} Hz was given to an engine for {expected_hz} Hz")]
    Frequency {
        /// The engine's, Hz.
        expected_hz: f64,
        /// The block's, Hz.
        found_hz: f64,
    },
    /// Settings by channel that do not fit the instrument.
    #[error("the downlink's channels: {0}")]
    Misfit(#[from] InvalidValue),
    /// Engines that cannot be merged.
    #[error("engines of different {what} cannot be merged")]
    Mismatch {
        /// What differs.
        what: &'static str,
    },
    /// Engines whose sums together would be greater than there is room for, or less than nothing.
    #[error(
        "merged sums would leave the range of an engine: expected more in the first than is taken out, and room for \
         both at this map.weight_max"
    )]
    Range,
    /// A checkpoint that cannot be read or written.
    #[error("checkpoint: {0}")]
    Io(#[from] std::io::Error),
    /// A checkpoint that is damaged or foreign.
    #[error("checkpoint: found {found}, expected {expected}")]
    Checkpoint {
        /// What was found.
        found: String,
        /// What was expected.
        expected: &'static str,
    },
}
