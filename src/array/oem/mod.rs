//! Orbits from CCSDS Orbit Ephemeris Messages.

mod file;
mod orbit;

pub(super) use file::{epoch_text, seconds, to_equatorial};
pub(super) use orbit::{Stretch, TableOrbit, read};
