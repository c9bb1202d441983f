//! The data that pass between stages, and the reasons why some do not reach the result.
//!
//! Uses [`crate::units`] only. These are plain data. Their invariants are checked where they enter: by the configuration on
//! the spacecraft, by the decoder on the ground.

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
#[doc(hidden)]
pub use ground::CountedVisibilities;
pub use ground::PlacedFrame;
pub use housekeeping::Housekeeping;
#[doc(hidden)]
pub use instrument::Spectrometer;
pub use instrument::{AntennaResponse, Channel, Instrument};
#[doc(hidden)]
pub use reason::SampleReason;
pub use reason::VisibilityReason;
#[doc(hidden)]
pub use samples::{SampleBlock, Samples, SpaceFrame};
#[doc(hidden)]
pub use visibility::AutoPower;
pub(crate) use visibility::ERROR_DRAWS_MAX;
pub use visibility::{PlacedVisibilities, UnequalLengths, VisibilityBlock};

/// A frame that the ground reads from a downlink.
#[derive(Clone, Debug, PartialEq)]
pub enum GroundFrame {
    /// The instrument description; the first frame of every downlink.
    Instrument(Instrument),
    /// Satellite positions over an interval without manoeuvres.
    Ephemeris(EphemerisSegment),
    /// Integrated visibilities of one pair and channel.
    Visibilities(VisibilityBlock),
    /// Counts of the spacecraft so far.
    Housekeeping(Housekeeping),
}

/// An observing window: an interval in which the Moon hides the Earth from the first daughter.
#[derive(Clone, Copy, Debug, PartialEq)]
#[doc(hidden)]
pub struct ObservingWindow {
    /// Number of the window since the mission epoch, with one window per orbit.
    pub index: u64,
    /// First instant.
    pub start: crate::units::MissionTime,
    /// Last instant.
    pub end: crate::units::MissionTime,
}
