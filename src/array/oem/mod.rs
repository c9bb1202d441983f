//! Orbits from CCSDS Orbit Ephemeris Messages.

mod checks;
mod interpolate;
mod kvn;
mod message;
mod orbit;
mod xml;

pub(super) use message::to_equatorial;
pub(super) use orbit::{OrbitArc, TableOrbit, read};
