//! Mission time as whole microseconds.

use std::fmt;

/// Ticks of [`MissionTime`] in one second.
pub const TICKS_PER_SECOND: i64 = 1_000_000;

/// Time since the mission epoch in whole microseconds.
///
/// Time tags are sent in this unit, so that both ends of the downlink have the same value. In one
/// tick a 100 km baseline moves by 76 micrometres, 3e-5 rad of phase at 30 MHz.
#[derive(
    Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash, bincode::Encode, bincode::Decode,
)]
pub struct MissionTime(pub i64);

impl MissionTime {
    /// The tick nearest to `t_s` seconds.
    #[must_use]
    pub fn from_seconds(t_s: f64) -> Self {
        Self((t_s * TICKS_PER_SECOND as f64).round() as i64)
    }

    /// Seconds since the mission epoch.
    #[must_use]
    pub fn seconds(self) -> f64 {
        self.0 as f64 / TICKS_PER_SECOND as f64
    }

    /// This time plus a number of ticks (us), saturating at the ends of the range.
    #[must_use]
    #[doc(hidden)]
    pub fn plus_ticks(self, ticks: i64) -> Self {
        Self(self.0.saturating_add(ticks))
    }
}

impl fmt::Display for MissionTime {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{:.6} s", self.seconds())
    }
}
