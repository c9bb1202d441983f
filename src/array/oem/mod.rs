//! Orbits from CCSDS Orbit Ephemeris Messages.

mod file;
mod orbit;

pub(super) use file::seconds;
pub(super) use orbit::{TableOrbit, read};
