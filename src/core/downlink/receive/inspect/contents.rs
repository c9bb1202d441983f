//! The contents of a downlink file, as written to JSON.

use serde::Serialize;

use crate::downlink::receive::cadu::FrameCounters;
use crate::downlink::receive::{Listing, ReceptionCounters};
use crate::downlink::wire::{Format, PacketKind};

/// An interval of mission time, with its dates.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct TimeSpan {
    /// Start, s since the mission epoch.
    pub start_s: f64,
    /// End, s since the mission epoch.
    pub end_s: f64,
    /// Start as a date, TAI.
    pub start_tai: String,
    /// End as a date, TAI.
    pub end_tai: String,
    /// Start as a date, UTC.
    pub start_utc: String,
    /// End as a date, UTC.
    pub end_utc: String,
}

/// The instrument description.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct InstrumentSummary {
    /// Name of the pipeline or mission.
    pub name: String,
    /// Mission epoch, TAI seconds since 1958-01-01.
    pub epoch_tai_s: f64,
    /// Mission epoch as a date, TAI.
    pub epoch_tai: String,
    /// Mission epoch as a date, UTC.
    pub epoch_utc: String,
    /// Number of daughters.
    pub satellites: u8,
    /// Radius of the Moon, m.
    pub moon_radius_m: f64,
    /// Antenna response.
    pub response: String,
    /// Seed of a simulation.
    pub seed: u64,
    /// Hash of the space segment's configuration, hexadecimal.
    pub configuration_hash: String,
    /// Band and channels of the spectrometer, if there is one.
    pub spectrometer: Option<String>,
}

/// Summary of the packets of one kind.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct KindSummary {
    /// Kind of the packets.
    pub kind: PacketKind,
    /// Application process identifier.
    pub apid: u16,
    /// Valid packets.
    pub packets: u64,
    /// Bytes of these packets.
    pub bytes: u64,
    /// Lowest count received: unless counts restarted, the number of packets sent before it.
    pub first_count: Option<u64>,
    /// Highest count received.
    pub last_count: Option<u64>,
}

/// Counts of visibilities.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct VisibilityCounts {
    /// Number of visibilities.
    pub count: u64,
    /// Sum of their integration times, s.
    pub integration_s: f64,
    /// Number of flagged visibilities.
    pub flagged: u64,
}

/// A channel and the counts of its visibilities.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct ChannelContents {
    /// Index of the channel in the instrument description.
    pub channel: u16,
    /// Centre frequency, Hz.
    pub frequency_hz: f64,
    /// Width, Hz.
    pub width_hz: f64,
    /// Counts for all pairs.
    #[serde(flatten)]
    pub visibilities: VisibilityCounts,
}

/// Counts of the visibilities of one pair in one channel.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct PairSummary {
    /// Satellites of the pair, numbered from 1, as in "1-2".
    pub pair: String,
    /// Index of the channel in the instrument description.
    pub channel: u16,
    /// Counts.
    #[serde(flatten)]
    pub visibilities: VisibilityCounts,
}

/// Summary of the ephemeris.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct EphemerisSummary {
    /// Number of segments, including repeats.
    pub segments: u64,
    /// Number of nodes of these segments.
    pub nodes: u64,
    /// Time covered, s.
    pub covered_s: f64,
    /// Intervals covered: start and end, s since the mission epoch.
    pub covered: Listing<[f64; 2]>,
    /// Segments whose positions contradict an earlier segment with the same start, which the ground keeps.
    pub contradictory: u64,
    /// Segments at whose ends the Moon occults the Earth as it is at their dates: all, unless the mission's Earth is idealised.
    pub earth_hidden_by_date: u64,
    /// Maximum interpolation error of positions between nodes, m, estimated from the nodes; `None` without segments.
    pub interpolation_error_m_max: Option<f64>,
}

/// The latest report of the spacecraft's counts.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct HousekeepingSummary {
    /// Time up to which the counts are valid, s since the mission epoch; `None` in the last report of a mission, which is
    /// valid for all time.
    pub time_s: Option<f64>,
    /// Visibilities sampled since the mission epoch.
    pub sampled: u64,
    /// Visibilities dropped on board since the mission epoch.
    pub dropped: u64,
}

/// A gap in the packet counts of one kind.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct GapEntry {
    /// Kind of the packets.
    pub kind: PacketKind,
    /// Application process identifier.
    pub apid: u16,
    /// Count of the first missing packet.
    pub from: u64,
    /// Count of the last missing packet.
    pub to: u64,
    /// Number of missing packets.
    pub count: u64,
    /// Offset of the packet after the gap, bytes.
    pub offset: u64,
    /// Creation time of the packet before the gap, s since the mission epoch.
    pub after_s: Option<f64>,
    /// Creation time of the packet after the gap, s since the mission epoch.
    pub before_s: Option<f64>,
}

/// A packet with valid headers and an invalid checksum.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct DamagedEntry {
    /// Offset in the file, bytes.
    pub offset: u64,
    /// Kind of the packets.
    pub kind: PacketKind,
    /// Application process identifier.
    pub apid: u16,
    /// Packet count.
    pub count: u64,
    /// Length according to its headers.
    pub bytes: u64,
    /// Creation time, s since the mission epoch.
    pub time_s: Option<f64>,
}

/// Bytes that belong to no packet.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct GarbageEntry {
    /// Offset in the file, bytes.
    pub offset: u64,
    /// Number of bytes.
    pub bytes: u64,
}

/// A payload that was refused in spite of a valid checksum.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct FaultEntry {
    /// Offset of its last packet, bytes.
    pub offset: u64,
    /// Reason.
    pub reason: String,
}

/// The contents of a downlink file: instrument, visibilities, ephemeris, and all damage.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Contents {
    /// Path of the file.
    pub file: String,
    /// Length of the file, bytes.
    pub bytes: u64,
    /// Format of the file. In coded frames, the offsets below count the recovered packet bytes.
    pub format: Format,
    /// Time from the start of the first to the end of the last integration.
    pub span: Option<TimeSpan>,
    /// The instrument description.
    pub instrument: Option<InstrumentSummary>,
    /// The channels, in the instrument's order.
    pub channels: Vec<ChannelContents>,
    /// Packets by kind.
    pub packets: Vec<KindSummary>,
    /// Counts of all visibilities.
    pub visibilities: VisibilityCounts,
    /// Counts of visibilities by pair and channel.
    pub baselines: Vec<PairSummary>,
    /// The ephemeris.
    pub ephemeris: EphemerisSummary,
    /// The spacecraft's counts.
    pub housekeeping: Option<HousekeepingSummary>,
    /// Gaps in the packet counts.
    pub gaps: Listing<GapEntry>,
    /// Packets with a bad checksum.
    pub bad_checksums: Listing<DamagedEntry>,
    /// Bytes that belong to no packet.
    pub garbage: Listing<GarbageEntry>,
    /// Refused payloads.
    pub faults: Listing<FaultEntry>,
    /// Bytes of a truncated packet at the end.
    pub truncated_bytes: u64,
    /// Bytes of idle packets.
    pub idle_bytes: u64,
    /// Good cross-correlations for whose times the file has no positions; 0 until the caller has counted them.
    #[serde(skip)]
    pub without_positions: u64,
    /// All counters of the reception.
    pub reception: ReceptionCounters,
}

impl Contents {
    /// Number of visibilities in valid packets minus the number that the spacecraft's latest report counts as sampled and not
    /// dropped on board: 0 if the file is complete. `None` without a report.
    #[must_use]
    #[doc(hidden)]
    pub fn found_minus_reported(&self) -> Option<i64> {
        let HousekeepingSummary { sampled, dropped, .. } = self.housekeeping.as_ref()?;
        let found = self.visibilities.count + self.reception.visibilities_bad_value;
        Some(
            i64::try_from(i128::from(found) + i128::from(*dropped) - i128::from(*sampled))
                .unwrap_or(i64::MIN),
        )
    }

    /// Whether the file is undamaged and complete: all visibilities that the spacecraft has sampled are in the file, with positions and finite
    /// values, or were dropped on board.
    #[must_use]
    pub fn is_sound(&self) -> bool {
        self.is_undamaged() && self.is_usable() && self.found_minus_reported() == Some(0)
    }

    /// Whether all its visibilities have positions, and values and weights that can be used.
    pub(super) fn is_usable(&self) -> bool {
        self.without_positions + self.reception.visibilities_bad_value == 0
    }

    /// Whether the file has no gaps and no damage, and every payload was decoded.
    #[must_use]
    #[doc(hidden)]
    pub fn is_undamaged(&self) -> bool {
        let has_no_entries =
            self.gaps.count + self.bad_checksums.count + self.garbage.count + self.faults.count == 0;
        let frames_undamaged = self.reception.frames.as_ref().is_none_or(FrameCounters::is_undamaged);
        let all_decoded =
            self.reception.instruments_contradictory + self.reception.payloads_before_instrument == 0;
        frames_undamaged && has_no_entries && self.truncated_bytes == 0 && all_decoded
    }
}
