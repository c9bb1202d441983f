//! CCSDS unsegmented time code (CUC), 301.0-B, section 3.2.

use serde::Serialize;

use crate::units::{MissionTime, TICKS_PER_SECOND};

/// P-field: no extension, time code 001 (TAI since 1958-01-01), 4 bytes of seconds, 3 of fraction.
pub(super) const P_FIELD: u8 = 0x1F;

/// Latest epoch that 4 bytes of seconds can express.
const SECONDS_MAX: f64 = u32::MAX as f64;

/// TAI since 1958-01-01 in units of 2^-24 s (60 ns).
#[derive(
    Clone,
    Copy,
    Debug,
    Default,
    PartialEq,
    Eq,
    PartialOrd,
    Ord,
    Hash,
    Serialize,
    bincode::Encode,
    bincode::Decode,
)]
pub struct CucTime(pub u64);

impl CucTime {
    /// The time code of a mission time, for a mission epoch in TAI seconds since 1958; `None` outside 1958-2094, which
    /// the code cannot express.
    #[must_use]
    pub fn new(epoch_tai_s: f64, time: MissionTime) -> Option<Self> {
        if !(0.0..=SECONDS_MAX).contains(&epoch_tai_s) {
            return None;
        }
        let epoch_units = (epoch_tai_s * f64::from(1 << 24)).round() as i64;
        let seconds = time.0.div_euclid(TICKS_PER_SECOND);
        let ticks = time.0.rem_euclid(TICKS_PER_SECOND);
        let fraction = ((ticks << 24) + TICKS_PER_SECOND / 2) / TICKS_PER_SECOND;
        let units = epoch_units.checked_add(seconds.checked_mul(1 << 24)?)?.checked_add(fraction)?;
        u64::try_from(units).ok().filter(|units| *units < 1 << 56).map(Self)
    }

    /// TAI seconds since 1958-01-01.
    #[must_use]
    pub fn tai_s(self) -> f64 {
        self.0 as f64 / f64::from(1 << 24)
    }

    /// Encodes the time as P-field and T-field.
    #[must_use]
    pub fn to_bytes(self) -> [u8; 8] {
        let mut bytes = self.0.to_be_bytes();
        bytes[0] = P_FIELD;
        bytes
    }

    /// Decodes P-field and T-field; `None` for another P-field.
    #[must_use]
    pub fn from_bytes(mut bytes: [u8; 8]) -> Option<Self> {
        let p_field = std::mem::take(&mut bytes[0]);
        (p_field == P_FIELD).then(|| Self(u64::from_be_bytes(bytes)))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bytes_follow_the_standard() {
        // 2020-01-01T00:00:00 TAI is 22645 days after 1958-01-01: 1 956 528 000 s = 0x749E_3F80.
        let time = CucTime::new(1_956_528_000.0, MissionTime(500_000)).unwrap();
        assert_eq!(time.to_bytes(), [0x1F, 0x74, 0x9E, 0x3F, 0x80, 0x80, 0, 0]);
        assert_eq!(CucTime::from_bytes(time.to_bytes()), Some(time));
        assert_eq!(time.tai_s(), 1_956_528_000.5);
    }

    #[test]
    fn times_before_the_mission_epoch_are_kept() {
        let early = CucTime::new(10.0, MissionTime(-250_000)).unwrap();
        assert_eq!(early.tai_s(), 9.75);
        assert_eq!(CucTime::new(10.0, MissionTime(-10_000_001)), None);
        assert_eq!(CucTime::new(f64::NAN, MissionTime(0)), None);
        assert_eq!(CucTime::new(0.0, MissionTime(i64::MAX)), None);
        assert_eq!(CucTime::new(f64::from(u32::MAX), MissionTime(1_000_000)), None);
    }

    #[test]
    fn ticks_keep_their_order() {
        let code = |ticks| CucTime::new(1e9, MissionTime(ticks)).unwrap();
        assert!((-3_000_000..3_000_000).step_by(997).all(|tick| code(tick) < code(tick + 1)));
    }
}
