//! The reasons why samples and visibilities do not reach the result: the entries of the two ledgers.

use crate::units::Reason;

/// Why a visibility is not in the map.
///
/// Checkpoints store the index of a reason in this list: append new reasons at the end, and change the version of checkpoints
/// when one is removed.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, bincode::Encode, bincode::Decode)]
#[non_exhaustive]
pub enum VisibilityReason {
    /// It is flagged: radio-frequency interference.
    Interference,
    /// It is flagged: samples are missing for part of the integration.
    Incomplete,
    /// It is flagged: a receiver was saturated.
    Saturated,
    /// It is flagged: calibration rejected it.
    Uncalibrated,
    /// It has a flag that this version does not know.
    UnknownFlag,
    /// Its block was used before.
    Duplicate,
    /// No instrument description has its channel.
    NoInstrument,
    /// No ephemeris covers its time.
    NoEphemeris,
    /// A gain is zero, not finite, or out of range.
    UnusableGain,
    /// It is an auto-correlation, and none are kept.
    Auto,
    /// It is an auto-correlation, and the table of auto-correlations is full.
    AutoTableFull,
    /// It is a second auto-correlation of an integration.
    AutoRepeated,
    /// Its baseline is longer than the configuration of the map allows.
    BaselineBeyondMap,
    /// The engine refused it: a position is not finite.
    PositionNotFinite,
    /// The engine refused it: its satellites are at the same position, or opposite each other.
    NoDirection,
    /// The engine refused it: the plane of its satellites is not that of the orbit.
    OutOfPlane,
    /// The engine refused it: its satellites are too high or too low.
    OffAltitude,
    /// The engine refused it: one satellite is much higher than the other.
    UnequalAltitudes,
    /// The engine refused it: its baseline is longer than the engine supports.
    BaselineBeyondEngine,
    /// The engine refused it: its value or weight cannot be summed.
    ValueNotFinite,
    /// The engine refused it: its weight, or its value in units of its noise, is outside the range of the sums.
    WeightOutOfRange,
    /// The engine refused it: the sums have reached their maximum weight, or refinement its maximum number of visibilities.
    SumsFull,
    /// The onboard store dropped it.
    StoreFull,
    /// It was sent and did not arrive.
    NotReceived,
    /// Its packet is missing, and no report has the number of visibilities in it: at least one.
    NotReceivedAtLeast,
    /// It was received with an invalid value, weight or duration.
    BadValue,
    /// It arrived after the session was interrupted, and is kept for the next session.
    NextSession,
    /// It is flagged: the Earth was visible from one of its daughters.
    EarthInSight,
    /// Its channel is not mapped.
    ChannelNotMapped,
    /// It is flagged: the artificial signal for calibration was on.
    Beacon,
    /// It is flagged: the ground found a burst of a point source at its time.
    Burst,
    /// The Moon hides the patch that is imaged.
    PatchHidden,
    /// The Moon's limb crosses the patch that is imaged.
    PatchOnLimb,
    /// Its baseline is shorter than the limit.
    BaselineShort,
    /// Its antennas hardly respond to the patch that is imaged.
    PatchInsensitive,
}

impl VisibilityReason {
    /// Whether the accumulation of the map leaves visibilities out for this reason, not calibration or reception.
    #[must_use]
    #[doc(hidden)]
    pub fn is_of_accumulation(self) -> bool {
        matches!(
            self,
            Self::BaselineBeyondMap
                | Self::PositionNotFinite
                | Self::NoDirection
                | Self::OutOfPlane
                | Self::OffAltitude
                | Self::UnequalAltitudes
                | Self::BaselineBeyondEngine
                | Self::ValueNotFinite
                | Self::WeightOutOfRange
                | Self::SumsFull
                | Self::ChannelNotMapped
                | Self::Burst
        )
    }
}

impl Reason for VisibilityReason {
    fn text(self) -> &'static str {
        match self {
            Self::Interference => "interference",
            Self::Incomplete => "incomplete integration",
            Self::Saturated => "saturated receiver",
            Self::Uncalibrated => "uncalibrated",
            Self::UnknownFlag => "unknown flag",
            Self::Duplicate => "duplicate",
            Self::NoInstrument => "no instrument description",
            Self::NoEphemeris => "no ephemeris",
            Self::UnusableGain => "unusable gain",
            Self::Auto => "auto-correlation",
            Self::AutoTableFull => "auto-correlation beyond the table",
            Self::AutoRepeated => "auto-correlation of an integration that has one",
            Self::BaselineBeyondMap => "baseline beyond the map's limit",
            Self::PositionNotFinite => "refused by the engine: a position is not finite",
            Self::NoDirection => "refused by the engine: the baseline has no direction",
            Self::OutOfPlane => "refused by the engine: out of the orbit's plane",
            Self::OffAltitude => "refused by the engine: off the orbit's altitude",
            Self::UnequalAltitudes => "refused by the engine: unequal altitudes of a pair",
            Self::BaselineBeyondEngine => "refused by the engine: baseline beyond its limit",
            Self::ValueNotFinite => {
                "refused by the engine: value or weight not finite, or weight not positive"
            }
            Self::WeightOutOfRange => {
                "refused by the engine: weight above map.weight_max or vanishing beside it, or value far above its noise"
            }
            Self::SumsFull => {
                "refused by the engine: full at this map.weight_max, or map.refine.visibilities_max"
            }
            Self::StoreFull => "full",
            Self::NotReceived => "not received",
            Self::NotReceivedAtLeast => "not received (at least)",
            Self::BadValue => "value or weight that cannot be used, as it was sent",
            Self::NextSession => "left for the next session",
            Self::EarthInSight => "Earth in sight of a daughter",
            Self::ChannelNotMapped => "channel not among map.channels",
            Self::Beacon => "artificial signal on",
            Self::Burst => "burst of a point source",
            Self::PatchHidden => "patch behind the Moon",
            Self::PatchOnLimb => "the Moon's limb in the patch",
            Self::BaselineShort => "baseline shorter than the limit",
            Self::PatchInsensitive => "antennas insensitive to the patch",
        }
    }

    fn lost_in(self) -> Option<&'static str> {
        match self {
            Self::StoreFull => Some("store"),
            Self::NotReceived | Self::NotReceivedAtLeast => Some("downlink"),
            _ => None,
        }
    }
}

/// Why a sample of a daughter was not correlated.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
#[non_exhaustive]
pub enum SampleReason {
    /// The link to the mother had no capacity, or no time left in the window.
    LinkOverrun,
    /// Its block arrived after the others had been correlated.
    Late,
    /// Its block is malformed.
    Malformed,
    /// Its block belongs to no window.
    OutsideWindow,
}

impl Reason for SampleReason {
    fn text(self) -> &'static str {
        match self {
            Self::LinkOverrun => "no room or no time",
            Self::Late => "late",
            Self::Malformed => "malformed",
            Self::OutsideWindow => "outside any window",
        }
    }

    fn lost_in(self) -> Option<&'static str> {
        match self {
            Self::LinkOverrun => Some("link"),
            Self::Late | Self::Malformed | Self::OutsideWindow => Some("correlate"),
        }
    }
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;

    use super::*;

    #[test]
    fn every_reason_has_a_unique_text_and_a_fixed_index_in_checkpoints() {
        let stored = |index: u8| {
            let decoded = bincode::decode_from_slice(&[index], bincode::config::standard());
            decoded.ok().map(|(reason, _): (VisibilityReason, usize)| reason)
        };
        let all: Vec<VisibilityReason> = (0..=250).map_while(stored).collect();
        let texts: BTreeSet<_> = all.iter().map(|reason| (reason.lost_in(), reason.text())).collect();
        assert_eq!(texts.len(), all.len());
        // Some fixed indices, so that a change of the order is detected.
        assert_eq!((all[5], all[12]), (VisibilityReason::Duplicate, VisibilityReason::BaselineBeyondMap));
        assert_eq!((all.len(), all[23]), (35, VisibilityReason::NotReceived));
        assert_eq!(all[30], VisibilityReason::Burst);
        assert_eq!(all.last(), Some(&VisibilityReason::PatchInsensitive));
    }
}
