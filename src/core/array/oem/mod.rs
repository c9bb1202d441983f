//! Orbits from CCSDS Orbit Ephemeris Messages and SPK kernels.

mod checks;
mod file;
mod form;
mod interpolate;
mod kvn;
mod message;
mod orbit;
mod spk;
mod xml;

pub(super) use file::{at_line, error, read_message};
pub(super) use form::{Fault, Message, short};
pub(super) use message::{Metadata, SegmentTimes, read_epoch};
pub(super) use orbit::{TableOrbit, TableSpan, read};
