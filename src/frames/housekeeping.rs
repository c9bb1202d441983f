//! What the spacecraft says of its own counting.

use crate::units::MissionTime;

/// Visibilities counted on board since the mission epoch, so that the ground can close its ledger.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, bincode::Encode, bincode::Decode)]
pub struct Housekeeping {
    /// Time up to which the counts hold.
    pub time: MissionTime,
    /// Visibilities the mother integrated.
    pub sampled: u64,
    /// Those of them that she dropped before they were sent.
    pub dropped: u64,
}
