//! Payloads of packets: a bincode-2 record, then raw little-endian arrays.
//!
//! Records are little-endian with fixed widths. Other languages read them as a struct of the fields in the order
//! listed in each module. `decode` returns only values that meet every invariant the ground relies on, and `encode`
//! refuses all others.

mod arrays;
mod ephemeris;
mod housekeeping;
mod instrument;
mod visibilities;

use bincode::config::{Configuration, Fixint, Limit, LittleEndian};
use bincode::{Decode, Encode};

use crate::downlink::error::PayloadFault;
use crate::units::{MissionTime, TICKS_PER_SECOND};

pub use ephemeris::NODES_MIN;
pub(crate) use ephemeris::{decode as decode_ephemeris, encode as encode_ephemeris};
pub(crate) use housekeeping::{decode as decode_housekeeping, encode as encode_housekeeping};
pub(crate) use instrument::{decode as decode_instrument, encode as encode_instrument};
pub use visibilities::VisibilitiesOutline;
pub(crate) use visibilities::{
    VISIBILITY_BYTES, capacity as visibilities_in, check as check_visibilities, count as count_visibilities,
    decode as decode_visibilities, encode as encode_visibilities, outline as visibilities_outline,
};

/// Maximum length of a record; bincode refuses to allocate more, for any value of a length field.
const RECORD_BYTES_MAX: usize = 512;

/// Range of the four bytes of seconds in a packet's time code; bounds every time in a payload.
const TIME_S_MAX: i64 = 1 << 32;

fn require(
    is_valid: bool,
    what: &'static str,
    value: f64,
    expected: &'static str,
) -> Result<(), PayloadFault> {
    if is_valid { Ok(()) } else { Err(PayloadFault::Value { what, value, expected }) }
}

fn require_length(what: &'static str, expected: usize, found: usize) -> Result<(), PayloadFault> {
    let (expected, found) = (expected as u64, found as u64);
    if expected == found { Ok(()) } else { Err(PayloadFault::Length { what, expected, found }) }
}

/// Requires a time at most the range of the time code before or after the epoch, so that no sum of ticks overflows later.
fn require_time(time: MissionTime) -> Result<(), PayloadFault> {
    let is_near = time.0.unsigned_abs() <= (TIME_S_MAX * TICKS_PER_SECOND) as u64;
    require(is_near, "time (s)", time.seconds(), "within 136 years of the mission epoch")
}

fn config() -> Configuration<LittleEndian, Fixint, Limit<RECORD_BYTES_MAX>> {
    bincode::config::standard().with_fixed_int_encoding().with_limit::<RECORD_BYTES_MAX>()
}

fn put_record<R: Encode>(what: &'static str, record: R, out: &mut Vec<u8>) -> Result<(), PayloadFault> {
    bincode::encode_into_std_write(record, out, config()).map_err(|_| PayloadFault::Record { what })?;
    Ok(())
}

fn take_record<'a, R: Decode<()>>(
    what: &'static str,
    bytes: &'a [u8],
) -> Result<(R, &'a [u8]), PayloadFault> {
    let fault = || PayloadFault::Record { what };
    let (record, consumed) = bincode::decode_from_slice(bytes, config()).map_err(|_| fault())?;
    Ok((record, bytes.get(consumed..).ok_or_else(fault)?))
}
