//! Tabulated satellite positions.

use crate::units::MissionTime;
use crate::units::vector::Vec3;

/// Positions of all satellites at equal time steps over an interval without manoeuvres.
///
/// The motion is smooth within a segment, and interpolation never crosses its ends.
#[derive(Clone, Debug, PartialEq, bincode::Encode, bincode::Decode)]
pub struct EphemerisSegment {
    /// Time of the first node.
    pub start: MissionTime,
    /// Time between nodes, us; positive.
    pub step_ticks: u32,
    /// Number of satellites.
    pub satellites: u8,
    /// Positions, m, Moon-centred with ecliptic axes: `satellites` positions for each node.
    pub positions_m: Vec<Vec3>,
}

impl EphemerisSegment {
    /// Number of nodes.
    #[must_use]
    pub fn nodes(&self) -> usize {
        self.positions_m.len() / usize::from(self.satellites).max(1)
    }

    /// Time of the last node.
    #[must_use]
    pub fn end(&self) -> MissionTime {
        let last = self.nodes().saturating_sub(1) as i64;
        self.start.plus_ticks(last * i64::from(self.step_ticks))
    }

    /// Whether `time` lies between the first and the last node.
    #[must_use]
    pub fn covers(&self, time: MissionTime) -> bool {
        self.start <= time && time <= self.end()
    }
}
