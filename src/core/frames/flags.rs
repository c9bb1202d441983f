//! Flags of visibilities.

use super::VisibilityReason;

/// The flags of a visibility: why it should not be used. A set of bits, 0 for a good visibility.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Flags(pub u8);

impl Flags {
    /// No flag.
    pub const GOOD: Self = Self(0);
    /// Radio-frequency interference.
    #[doc(hidden)]
    pub const INTERFERENCE: Self = Self(1);
    /// Samples are missing for part of the integration.
    #[doc(hidden)]
    pub const INCOMPLETE: Self = Self(2);
    /// A receiver was saturated.
    #[doc(hidden)]
    pub const SATURATED: Self = Self(4);
    /// Calibration rejected the visibility.
    #[doc(hidden)]
    pub const UNCALIBRATED: Self = Self(8);
    /// The Earth was visible from one of the two daughters during part of the integration.
    #[doc(hidden)]
    pub const EARTH: Self = Self(16);
    /// The artificial signal for calibration was on.
    #[doc(hidden)]
    pub const BEACON: Self = Self(32);

    /// Whether no bit is set.
    #[must_use]
    pub fn is_good(self) -> bool {
        self.0 == 0
    }

    /// The reason for the lowest bit that is set; `None` for a good visibility.
    #[must_use]
    pub fn reason(self) -> Option<VisibilityReason> {
        match Self(self.0 & self.0.wrapping_neg()) {
            Self::GOOD => None,
            Self::INTERFERENCE => Some(VisibilityReason::Interference),
            Self::INCOMPLETE => Some(VisibilityReason::Incomplete),
            Self::SATURATED => Some(VisibilityReason::Saturated),
            Self::UNCALIBRATED => Some(VisibilityReason::Uncalibrated),
            Self::EARTH => Some(VisibilityReason::EarthInSight),
            Self::BEACON => Some(VisibilityReason::Beacon),
            _ => Some(VisibilityReason::UnknownFlag),
        }
    }
}
