//! Orbits from CCSDS Orbit Ephemeris Messages.

mod file;
mod orbit;

pub(super) use file::to_equatorial;
pub(super) use orbit::{Stretch, TableOrbit, read};
