//! Frames between the stages of the ground.

use super::{Housekeeping, Instrument, PlacedVisibilities};

/// Frames from calibration to accumulation.
#[derive(Clone, Debug, PartialEq)]
pub enum PlacedFrame {
    /// The instrument description; once, before any visibility.
    Instrument(Instrument),
    /// Calibrated visibilities with the positions of their satellites.
    Visibilities(PlacedVisibilities),
    /// The spacecraft's own counts up to a time.
    Housekeeping(Housekeeping),
}
