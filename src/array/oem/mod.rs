//! Orbits from CCSDS Orbit Ephemeris Messages.

mod checks;
mod form;
mod interpolate;
mod kvn;
mod message;
mod orbit;
mod xml;

pub(super) use form::{Message, at_line, error, read_message};
pub(super) use message::{Fault, Metadata, Useable, read_epoch, short, to_equatorial, turned, useable_s};
pub(super) use orbit::{OrbitArc, TableOrbit, read};
