//! Frames between the stages of the ground.

use super::{Housekeeping, Instrument, PlacedVisibilities};

/// Frames from calibration to accumulation.
#[derive(Clone, Debug, PartialEq)]
pub enum PlacedFrame {
    /// The instrument description; once, before any visibility.
    Instrument(Instrument),
    /// Calibrated visibilities with the positions of their satellites.
    Visibilities(PlacedVisibilities),
    /// Number of visibilities of a channel that is not mapped.
    NotMapped(CountedVisibilities),
    /// The spacecraft's counts up to a time.
    Housekeeping(Housekeeping),
}

/// A number of visibilities, in place of the visibilities.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct CountedVisibilities {
    /// Mission time of the middle of the first visibility, s.
    pub first_s: f64,
    /// Number of visibilities.
    pub visibilities: u64,
}
