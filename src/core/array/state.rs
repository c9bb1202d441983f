//! State of a satellite.

use crate::units::vector::Vec3;

/// Position and velocity of one daughter.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SatelliteState {
    /// Position, m.
    pub position_m: Vec3,
    /// Velocity, m/s, with orbital motion, precession and breathing.
    pub velocity_m_s: Vec3,
}
