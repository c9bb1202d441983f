//! Frames between the stages of the ground.

use super::{Housekeeping, Instrument, PlacedVisibilities};

/// Frames from calibration to accumulation.
#[derive(Clone, Debug, PartialEq)]
pub enum PlacedFrame {
    /// The instrument description; once, before any visibility.
    Instrument(Instrument),
    /// Calibrated visibilities with the positions of their satellites.
    Visibilities(PlacedVisibilities),
    /// Visibilities of a channel that is not summed, which are counted instead.
    Elsewhere(CountedVisibilities),
    /// The spacecraft's own counts up to a time.
    Housekeeping(Housekeeping),
}

/// Visibilities of which only their number matters.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct CountedVisibilities {
    /// Mission time of the middle of the first, s.
    pub first_s: f64,
    /// How many.
    pub visibilities: u64,
}
