//! Faults of single payloads, which are counted.

use thiserror::Error;

/// Why a payload with a valid checksum was refused.
#[derive(Clone, Debug, Error, PartialEq)]
#[non_exhaustive]
pub enum PayloadFault {
    /// Unknown format version.
    #[error("format version {found}: this program reads version {expected}")]
    Version {
        /// Version found.
        found: u8,
        /// Version expected.
        expected: u8,
    },
    /// The record cannot be decoded.
    #[error("the {what} record is malformed")]
    Record {
        /// Kind of record.
        what: &'static str,
    },
    /// Payload and record disagree about a length.
    #[error("{what}: {found} bytes or elements, but the record requires {expected}")]
    Length {
        /// The quantity.
        what: &'static str,
        /// Required length.
        expected: u64,
        /// Length found.
        found: u64,
    },
    /// A value is out of range.
    #[error("{what} = {value}: expected {expected}")]
    Value {
        /// The quantity.
        what: &'static str,
        /// The value.
        value: f64,
        /// Accepted range.
        expected: &'static str,
    },
    /// The mid-times of the integrations do not increase.
    #[error("the mid-times of the integrations do not increase")]
    Order,
}
