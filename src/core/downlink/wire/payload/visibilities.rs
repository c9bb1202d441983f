//! Integrated visibilities.
//!
//! Record: `channel` u16, `i` u8, `j` u8 (satellites from 0), `start_ticks` i64, `count` u32. Arrays of `count`
//! each: `offset_ticks` u32, `duration_ticks` u32, value (re, im) f32 x 2, `weight` f32, `flags` u8.
//!
//! A pair of a satellite with itself (`i` = `j`) is an auto-correlation: the mean of |x|^2, with the weight n / P^2. A
//! spectrometer has the satellite number and the channel numbers that follow the last ones.
//!
//! A long block is divided among packets that can each be decoded alone. Their records differ only in the count.

use std::ops::Range;

use bincode::{Decode, Encode};

use super::arrays::{Arrays, put_complex32, put_f32, put_u32};
use super::{PayloadFault, put_record, require, require_length, require_time, take_record};
use crate::frames::{Flags, Instrument, VisibilityBlock};
use crate::units::{ChannelId, MissionTime, Pair};

const RECORD_BYTES: usize = 16;
pub(crate) const VISIBILITY_BYTES: usize = 21;

#[derive(Encode, Decode)]
struct VisibilityRecord {
    channel: u16,
    i: u8,
    j: u8,
    start_ticks: i64,
    count: u32,
}

/// Number of visibilities that fit into a payload of `bytes`.
pub(crate) fn capacity(bytes: usize) -> usize {
    bytes.saturating_sub(RECORD_BYTES) / VISIBILITY_BYTES
}

/// Appends the visibilities in `range` of a block that [`check`] has passed.
pub(crate) fn encode(
    block: &VisibilityBlock,
    range: Range<usize>,
    out: &mut Vec<u8>,
) -> Result<(), PayloadFault> {
    let record = VisibilityRecord {
        channel: block.channel.0,
        i: block.pair.i,
        j: block.pair.j,
        start_ticks: block.start.0,
        count: range.len() as u32,
    };
    put_record("visibility", record, out)?;
    put_u32(&block.offset_ticks[range.clone()], out);
    put_u32(&block.duration_ticks[range.clone()], out);
    put_complex32(&block.value_k_sr[range.clone()], out);
    put_f32(&block.weight[range.clone()], out);
    out.extend(block.flags[range].iter().map(|flags| flags.0));
    Ok(())
}

/// Decodes a block; returns it without its bad visibilities, and their number. They are not finite, or their weight or
/// duration is not positive.
pub(crate) fn decode(bytes: &[u8], instrument: &Instrument) -> Result<(VisibilityBlock, u64), PayloadFault> {
    let (record, rest) = take_record::<VisibilityRecord>("visibility", bytes)?;
    let count = record.count as usize;
    require_length("visibility arrays", count.saturating_mul(VISIBILITY_BYTES), rest.len())?;
    let mut arrays = Arrays(rest);
    let mut block = VisibilityBlock {
        channel: ChannelId(record.channel),
        pair: Pair { i: record.i, j: record.j },
        start: MissionTime(record.start_ticks),
        offset_ticks: arrays.u32(count),
        duration_ticks: arrays.u32(count),
        value_k_sr: arrays.complex32(count),
        weight: arrays.f32(count),
        flags: arrays.u8(count).iter().map(|flags| Flags(*flags)).collect(),
    };
    check(&block, instrument)?;
    let bad = if has_bad_values(&block) { drop_bad_values(&mut block) } else { 0 };
    Ok((block, bad))
}

/// Number of visibilities that a payload claims to hold, for the counters of refused payloads.
pub(crate) fn count(bytes: &[u8]) -> u64 {
    take_record::<VisibilityRecord>("visibility", bytes)
        .map_or(0, |(record, rest)| u64::from(record.count).min((rest.len() / VISIBILITY_BYTES) as u64))
}

/// Pair and time span that a payload of visibilities claims, without a check of its values.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct VisibilitiesOutline {
    /// The pair.
    pub pair: Pair,
    /// Start of the first and end of the last integration.
    pub span: [MissionTime; 2],
    /// Middle of the first integration, s since the epoch.
    pub middle_s: f64,
}

/// The outline of a payload, if it can be read.
pub(crate) fn outline(bytes: &[u8]) -> Option<VisibilitiesOutline> {
    let (record, rest) = take_record::<VisibilityRecord>("visibility", bytes).ok()?;
    let count = record.count as usize;
    require_length("visibility arrays", count.saturating_mul(VISIBILITY_BYTES), rest.len()).ok()?;
    let mut arrays = Arrays(rest);
    let (offsets, durations) = (arrays.u32(count), arrays.u32(count));
    let start = MissionTime(record.start_ticks);
    let first = start.plus_ticks(i64::from(*offsets.first()?));
    let end = i64::from(*offsets.last()?) + i64::from(*durations.last()?);
    Some(VisibilitiesOutline {
        pair: Pair { i: record.i, j: record.j },
        span: [first, start.plus_ticks(end)],
        // The same bits as a block's middle time.
        middle_s: start.seconds()
            + (f64::from(*offsets.first()?) + 0.5 * f64::from(*durations.first()?)) * 1e-6,
    })
}

/// Checks the invariants of a block as a whole.
pub(crate) fn check(block: &VisibilityBlock, instrument: &Instrument) -> Result<(), PayloadFault> {
    let Pair { i, j } = block.pair;
    require(i <= j, "trailing satellite of a pair", f64::from(j), "the leading one or after it")?;
    let exists = j < instrument.satellites || instrument.is_spectrum(block.pair);
    require(exists, "satellite of a pair", f64::from(j), "one of the instrument's")?;
    let channel = block.channel.0;
    let exists = instrument.channel_of(block.channel, block.pair).is_some();
    require(exists, "channel", f64::from(channel), "one of the instrument's")?;
    require_time(block.start)?;
    for length in
        [block.offset_ticks.len(), block.duration_ticks.len(), block.weight.len(), block.flags.len()]
    {
        require_length("visibility arrays", block.len(), length)?;
    }
    let twice_middle = |k: usize| 2 * u64::from(block.offset_ticks[k]) + u64::from(block.duration_ticks[k]);
    let is_unordered = (1..block.len()).fold(false, |bad, k| bad | (twice_middle(k - 1) >= twice_middle(k)));
    if is_unordered { Err(PayloadFault::Order) } else { Ok(()) }
}

/// Whether any visibility is bad. The loops have no branches, so they are vectorised.
fn has_bad_values(block: &VisibilityBlock) -> bool {
    let durations = block.duration_ticks.iter().fold(false, |bad, ticks| bad | (*ticks == 0));
    let weights = block.weight.iter().fold(false, |bad, w| bad | !(*w > 0.0 && *w < f32::INFINITY));
    let values = block.value_k_sr.iter().fold(false, |bad, v| bad | !v.re.is_finite() | !v.im.is_finite());
    durations | weights | values
}

fn drop_bad_values(block: &mut VisibilityBlock) -> u64 {
    let is_good = |k: &usize| {
        let (value, weight) = (block.value_k_sr[*k], block.weight[*k]);
        value.is_finite() && weight > 0.0 && weight.is_finite() && block.duration_ticks[*k] > 0
    };
    let good: Vec<usize> = (0..block.len()).filter(is_good).collect();
    let bad = block.len() - good.len();
    *block = VisibilityBlock {
        offset_ticks: good.iter().map(|k| block.offset_ticks[*k]).collect(),
        duration_ticks: good.iter().map(|k| block.duration_ticks[*k]).collect(),
        value_k_sr: good.iter().map(|k| block.value_k_sr[*k]).collect(),
        weight: good.iter().map(|k| block.weight[*k]).collect(),
        flags: good.iter().map(|k| block.flags[*k]).collect(),
        ..*block
    };
    bad as u64
}
