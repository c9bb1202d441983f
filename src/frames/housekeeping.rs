//! Counts of the spacecraft.

use crate::units::MissionTime;

/// Visibilities counted on board since the mission epoch; the ground closes its ledger with them.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, bincode::Encode, bincode::Decode)]
pub struct Housekeeping {
    /// Time up to which the counts hold.
    pub time: MissionTime,
    /// Visibilities the mother integrated.
    pub sampled: u64,
    /// Those that it dropped before they were sent.
    pub dropped: u64,
}
