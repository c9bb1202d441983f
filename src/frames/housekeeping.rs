//! Counts of the spacecraft.

use crate::units::{MissionTime, TICKS_PER_SECOND};

/// Visibilities counted on board since the mission epoch; the ground closes its ledger with them.
///
/// Each pass begins and ends with a report of the same counts, so that a pass that is cut short still tells what it
/// held. Those of the last pass hold for all time: see [`Housekeeping::FOREVER`].
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, bincode::Encode, bincode::Decode)]
pub struct Housekeeping {
    /// Time up to which the counts hold.
    pub time: MissionTime,
    /// Visibilities the mother integrated.
    pub sampled: u64,
    /// Visibilities that it dropped before they were sent.
    pub dropped: u64,
}

impl Housekeeping {
    /// The time of the last report of a mission: the end of the range of times, 136 years after the epoch. Nothing is
    /// sampled after that report.
    #[doc(hidden)]
    pub const FOREVER: MissionTime = MissionTime((1 << 32) * TICKS_PER_SECOND);

    /// Whether this is the last report of a mission.
    #[must_use]
    #[doc(hidden)]
    pub fn is_last(&self) -> bool {
        self.time >= Self::FOREVER
    }
}
