//! The spacecraft's own counts.
//!
//! Record: `time_ticks` i64, `sampled` u64, `dropped` u64. No arrays.

use bincode::{Decode, Encode};

use super::{PayloadFault, put_record, require, require_length, require_time, take_record};
use crate::frames::Housekeeping;
use crate::units::MissionTime;

#[derive(Encode, Decode)]
struct HousekeepingRecord {
    time_ticks: i64,
    sampled: u64,
    dropped: u64,
}

pub(crate) fn encode(counts: &Housekeeping, out: &mut Vec<u8>) -> Result<(), PayloadFault> {
    check(counts)?;
    let Housekeeping { time, sampled, dropped } = *counts;
    put_record("housekeeping", HousekeepingRecord { time_ticks: time.0, sampled, dropped }, out)
}

pub(crate) fn decode(bytes: &[u8]) -> Result<Housekeeping, PayloadFault> {
    let (record, rest) = take_record::<HousekeepingRecord>("housekeeping", bytes)?;
    require_length("housekeeping", 0, rest.len())?;
    let HousekeepingRecord { time_ticks, sampled, dropped } = record;
    let counts = Housekeeping { time: MissionTime(time_ticks), sampled, dropped };
    check(&counts)?;
    Ok(counts)
}

fn check(counts: &Housekeeping) -> Result<(), PayloadFault> {
    require_time(counts.time)?;
    let good = counts.dropped <= counts.sampled;
    require(good, "dropped visibilities", counts.dropped as f64, "no more than were sampled")
}
