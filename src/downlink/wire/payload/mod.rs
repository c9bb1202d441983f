//! What packets carry: a bincode-2 record, then raw little-endian arrays.
//!
//! Records are little-endian with fixed widths: other languages read them with a struct of the fields in
//! the order in which they are listed here. What comes out of `decode` meets every invariant that the
//! ground relies on; `encode` refuses what `decode` would.

mod arrays;
mod ephemeris;
mod housekeeping;
mod instrument;
mod visibilities;

use bincode::config::{Configuration, Fixint, Limit, LittleEndian};
use bincode::{Decode, Encode};
use thiserror::Error;

use crate::units::{MissionTime, TICKS_PER_SECOND};

pub use ephemeris::NODES_MIN;
pub(crate) use ephemeris::{decode as decode_ephemeris, encode as encode_ephemeris};
pub(crate) use housekeeping::{decode as decode_housekeeping, encode as encode_housekeeping};
pub(crate) use instrument::{decode as decode_instrument, encode as encode_instrument};
pub(crate) use visibilities::{
    VISIBILITY_BYTES, capacity as visibilities_in, check as check_visibilities, count as count_visibilities,
    decode as decode_visibilities, encode as encode_visibilities, span as visibilities_span,
};

/// Bytes that any record may take; bincode refuses to allocate more whatever a length field says.
const RECORD_BYTES_MAX: usize = 512;

/// Seconds that the four bytes of a packet's time code can count; bounds every time in a payload.
const TIME_S_MAX: i64 = 1 << 32;

/// Why a payload was refused although its packet's check held.
#[derive(Clone, Debug, Error, PartialEq)]
#[non_exhaustive]
pub enum PayloadFault {
    /// A format version that this program does not know.
    #[error("format version {found}: this program reads version {expected}")]
    Version {
        /// Version found.
        found: u8,
        /// Version expected.
        expected: u8,
    },
    /// The record could not be decoded.
    #[error("the {what} record is malformed")]
    Record {
        /// Kind of record.
        what: &'static str,
    },
    /// Payload and record disagree about the length.
    #[error("{what}: {found} bytes or elements where its record asks for {expected}")]
    Length {
        /// What has the length.
        what: &'static str,
        /// Length asked for.
        expected: u64,
        /// Length found.
        found: u64,
    },
    /// A value out of range.
    #[error("{what} = {value}: expected {expected}")]
    Value {
        /// What has the value.
        what: &'static str,
        /// The value.
        value: f64,
        /// Range that is accepted.
        expected: &'static str,
    },
    /// The middles of the integrations should increase and do not.
    #[error("the middles of the integrations do not increase")]
    Order,
}

/// A fault unless `good`.
fn require(good: bool, what: &'static str, value: f64, expected: &'static str) -> Result<(), PayloadFault> {
    if good { Ok(()) } else { Err(PayloadFault::Value { what, value, expected }) }
}

fn require_length(what: &'static str, expected: usize, found: usize) -> Result<(), PayloadFault> {
    let (expected, found) = (expected as u64, found as u64);
    if expected == found { Ok(()) } else { Err(PayloadFault::Length { what, expected, found }) }
}

/// Times within one span of the time code about the epoch: no sum of ticks overflows later.
fn require_time(time: MissionTime) -> Result<(), PayloadFault> {
    let good = time.0.unsigned_abs() <= (TIME_S_MAX * TICKS_PER_SECOND) as u64;
    require(good, "time (s)", time.seconds(), "within 136 years of the mission epoch")
}

fn config() -> Configuration<LittleEndian, Fixint, Limit<RECORD_BYTES_MAX>> {
    bincode::config::standard().with_fixed_int_encoding().with_limit::<RECORD_BYTES_MAX>()
}

/// Appends a record.
fn put_record<R: Encode>(what: &'static str, record: R, out: &mut Vec<u8>) -> Result<(), PayloadFault> {
    bincode::encode_into_std_write(record, out, config()).map_err(|_| PayloadFault::Record { what })?;
    Ok(())
}

/// A record and what follows it.
fn take_record<'a, R: Decode<()>>(
    what: &'static str,
    bytes: &'a [u8],
) -> Result<(R, &'a [u8]), PayloadFault> {
    let fault = || PayloadFault::Record { what };
    let (record, consumed) = bincode::decode_from_slice(bytes, config()).map_err(|_| fault())?;
    Ok((record, bytes.get(consumed..).ok_or_else(fault)?))
}
