//! What travels between the ground's stages.

use super::{Housekeeping, Instrument, PlacedVisibilities};

/// What calibration hands to accumulation.
#[derive(Clone, Debug, PartialEq)]
pub enum PlacedFrame {
    /// The instrument description; before any visibility, once.
    Instrument(Instrument),
    /// Calibrated visibilities with the positions of their satellites.
    Visibilities(PlacedVisibilities),
    /// The spacecraft's own counts up to a time.
    Housekeeping(Housekeeping),
}
