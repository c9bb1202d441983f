//! Housekeeping: the spacecraft's counts.
//!
//! Record: `time_ticks` i64, `sampled` u64, `dropped` u64. No arrays. The last report of a mission has the time 2^32 s, the
//! end of the range: see [`Housekeeping::FOREVER`].

use bincode::{Decode, Encode};

use super::{PayloadFault, put_record, require, require_length, require_time, take_record};
use crate::frames::Housekeeping;
use crate::units::MissionTime;

/// Maximum number of visibilities in a report: a third of a million times that of 30 channels over 1.3 years.
const SAMPLED_MAX: u64 = 1 << 48;

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
    let is_possible = counts.sampled <= SAMPLED_MAX;
    require(is_possible, "sampled visibilities", counts.sampled as f64, "at most 2^48")?;
    let is_possible = counts.dropped <= counts.sampled;
    require(is_possible, "dropped visibilities", counts.dropped as f64, "no more than were sampled")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_last_report_is_encoded_and_impossible_counts_are_refused() {
        let last = Housekeeping { time: Housekeeping::FOREVER, sampled: 9, dropped: 2 };
        let mut bytes = Vec::new();
        encode(&last, &mut bytes).unwrap();
        assert_eq!(decode(&bytes), Ok(last));
        let forged = |time: i64, sampled: u64, dropped: u64| {
            let mut bytes = Vec::new();
            put_record("housekeeping", HousekeepingRecord { time_ticks: time, sampled, dropped }, &mut bytes)
                .unwrap();
            decode(&bytes)
        };
        assert!(forged(0, SAMPLED_MAX, SAMPLED_MAX).is_ok());
        let refused = [(0, u64::MAX, u64::MAX), (0, SAMPLED_MAX + 1, 0), (0, 1, 2), (last.time.0 + 1, 1, 0)];
        for (time, sampled, dropped) in refused {
            assert!(matches!(forged(time, sampled, dropped), Err(PayloadFault::Value { .. })), "{sampled}");
        }
    }
}
