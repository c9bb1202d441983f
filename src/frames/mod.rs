//! What travels between stages.
//!
//! Uses [`crate::units`] only. These are plain data: every invariant that a stage relies on is
//! checked where the data enters (the configuration on the spacecraft, the decoder on the ground).

mod ephemeris;
mod flags;
mod ground;
mod housekeeping;
mod instrument;
mod reason;
mod samples;
mod visibility;

pub use ephemeris::EphemerisSegment;
pub use flags::Flags;
pub use ground::PlacedFrame;
pub use housekeeping::Housekeeping;
pub use instrument::{AntennaResponse, Channel, Instrument, Spectrometer};
pub use reason::{SampleReason, VisibilityReason};
pub use samples::{SampleBlock, Samples, SpaceFrame};
pub use visibility::{AutoPower, PlacedVisibilities, VisibilityBlock};

/// What the ground reads from a downlink, in the order in which it was sent.
#[derive(Clone, Debug, PartialEq)]
pub enum GroundFrame {
    /// The instrument description; the first frame of every downlink.
    Instrument(Instrument),
    /// Satellite positions over a stretch of time without manoeuvres.
    Ephemeris(EphemerisSegment),
    /// Integrated visibilities of one pair and channel.
    Visibilities(VisibilityBlock),
    /// What the spacecraft has counted so far.
    Housekeeping(Housekeeping),
}

/// A stretch of time in which the Earth is hidden from the first daughter.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ObservingWindow {
    /// Number of the window since the mission epoch; one an orbit.
    pub index: u64,
    /// First instant.
    pub start: crate::units::MissionTime,
    /// Last instant.
    pub end: crate::units::MissionTime,
}
