//! Counts of the spacecraft.

use crate::units::{MissionTime, TICKS_PER_SECOND};

/// Numbers of visibilities counted on board since the mission epoch, with which the ground balances its ledger.
///
/// Each pass begins and ends with a report of the same counts, so that a truncated pass still tells how much it held. The
/// reports of the last pass are valid for all time: see [`Housekeeping::FOREVER`].
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, bincode::Encode, bincode::Decode)]
pub struct Housekeeping {
    /// Time up to which the counts are valid.
    pub time: MissionTime,
    /// Number of visibilities that the mother integrated.
    pub sampled: u64,
    /// Number of visibilities that the mother dropped before they were sent.
    pub dropped: u64,
}

impl Housekeeping {
    /// The time of the last report of a mission: the end of the time range, 136 years after the epoch. Nothing is sampled
    /// after that report.
    #[doc(hidden)]
    pub const FOREVER: MissionTime = MissionTime((1 << 32) * TICKS_PER_SECOND);

    /// Whether this is the last report of a mission.
    #[must_use]
    #[doc(hidden)]
    pub fn is_last(&self) -> bool {
        self.time >= Self::FOREVER
    }
}
