//! What a downlink file contains.

use serde::Serialize;

use crate::downlink::receive::cadu::FrameCounters;
use crate::downlink::receive::{Listing, ReceptionCounters};
use crate::downlink::wire::{Format, PacketKind};

/// An interval of mission time, with dates.
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

/// Packets of one kind.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct KindSummary {
    /// Kind of the packets.
    pub kind: PacketKind,
    /// Application process identifier.
    pub apid: u16,
    /// Sound packets.
    pub packets: u64,
    /// Bytes of those.
    pub bytes: u64,
    /// Count of the first packet received: the number of packets sent before it.
    pub first_count: Option<u64>,
    /// Highest count received.
    pub last_count: Option<u64>,
}

/// Numbers of visibilities, for some pairs and channels.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct VisibilityCounts {
    /// Number of visibilities.
    pub count: u64,
    /// Sum of their integration times, s.
    pub integration_s: f64,
    /// Number of flagged ones.
    pub flagged: u64,
}

/// A channel and its visibilities.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct ChannelContents {
    /// Index in the instrument description.
    pub channel: u16,
    /// Centre frequency, Hz.
    pub frequency_hz: f64,
    /// Width, Hz.
    pub width_hz: f64,
    /// Visibilities of all pairs.
    #[serde(flatten)]
    pub visibilities: VisibilityCounts,
}

/// Visibilities of one pair in one channel.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct PairSummary {
    /// Pair, counted from 1, as in "1-2".
    pub pair: String,
    /// Index in the instrument description.
    pub channel: u16,
    /// Visibilities.
    #[serde(flatten)]
    pub visibilities: VisibilityCounts,
}

/// The ephemeris.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct EphemerisSummary {
    /// Segments, repeats included.
    pub segments: u64,
    /// Nodes of those.
    pub nodes: u64,
    /// Time covered, s.
    pub covered_s: f64,
    /// Intervals covered: start and end, s since the mission epoch.
    pub covered: Listing<[f64; 2]>,
    /// Segments that say other positions than one that begins at the same time, which the ground keeps.
    pub contradictory: u64,
    /// Segments at whose ends the Moon hides the Earth, where that is by the dates: all, unless the mission's Earth is idealised.
    pub earth_hidden_by_date: u64,
    /// Greatest error of positions between nodes, m, as the nodes themselves tell; `None` without segments.
    pub interpolation_error_m_max: Option<f64>,
}

/// The spacecraft's own counts: the latest report.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct HousekeepingSummary {
    /// Time up to which the counts hold, s since the mission epoch; `None` for all time: the last report of a mission.
    pub time_s: Option<f64>,
    /// Visibilities sampled since the mission epoch.
    pub sampled: u64,
    /// Visibilities dropped on board since the mission epoch.
    pub dropped: u64,
}

/// A gap in the packet counts of a kind. Counts have 46 bits, so no gap is ambiguous.
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
    /// Creation time of the last packet before the gap, s since the mission epoch.
    pub after_s: Option<f64>,
    /// Creation time of the packet after the gap, s since the mission epoch.
    pub before_s: Option<f64>,
}

/// A packet with sound headers and a bad checksum.
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
    /// Length by its headers.
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

/// A payload that was refused although its packet's checksum is right.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct FaultEntry {
    /// Offset of its last packet, bytes.
    pub offset: u64,
    /// Reason.
    pub reason: String,
}

/// What a downlink file contains.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Contents {
    /// The file.
    pub file: String,
    /// Its length, bytes.
    pub bytes: u64,
    /// Plain packets, or packets in coded frames. For frames, the offsets below count the recovered packet bytes.
    pub format: Format,
    /// From the start of the first to the end of the last integration.
    pub span: Option<TimeSpan>,
    /// The instrument description.
    pub instrument: Option<InstrumentSummary>,
    /// The channels, in the instrument's order.
    pub channels: Vec<ChannelContents>,
    /// Packets by kind.
    pub packets: Vec<KindSummary>,
    /// All visibilities.
    pub visibilities: VisibilityCounts,
    /// Visibilities by pair and channel.
    pub baselines: Vec<PairSummary>,
    /// The ephemeris.
    pub ephemeris: EphemerisSummary,
    /// The spacecraft's own counts.
    pub housekeeping: Option<HousekeepingSummary>,
    /// Gaps in the packet counts.
    pub gaps: Listing<GapEntry>,
    /// Packets with a bad checksum.
    pub bad_checksums: Listing<DamagedEntry>,
    /// Bytes that belong to no packet.
    pub garbage: Listing<GarbageEntry>,
    /// Refused payloads.
    pub faults: Listing<FaultEntry>,
    /// Bytes of an unfinished packet at the end.
    pub truncated_bytes: u64,
    /// Bytes of idle packets.
    pub idle_bytes: u64,
    /// All counters of the reception.
    pub reception: ReceptionCounters,
}

impl Contents {
    /// Visibilities in sound packets less those that the spacecraft's latest report counts as sampled and not dropped on board: 0
    /// if all that were sent are in the file. `None` without a report.
    #[must_use]
    #[doc(hidden)]
    pub fn found_less_reported(&self) -> Option<i64> {
        let HousekeepingSummary { sampled, dropped, .. } = self.housekeeping.as_ref()?;
        let found = self.visibilities.count + self.reception.visibilities_bad_value;
        Some(
            i64::try_from(i128::from(found) + i128::from(*dropped) - i128::from(*sampled))
                .unwrap_or(i64::MIN),
        )
    }

    /// Whether nothing is missing or damaged and every payload was decoded, and all visibilities that the spacecraft has sampled are
    /// in the file or were dropped on board.
    #[must_use]
    pub fn is_sound(&self) -> bool {
        self.is_undamaged() && self.found_less_reported() == Some(0)
    }

    /// Whether it has no gaps and no damage, and every payload was decoded.
    #[must_use]
    #[doc(hidden)]
    pub fn is_undamaged(&self) -> bool {
        let clean = self.gaps.count + self.bad_checksums.count + self.garbage.count + self.faults.count == 0;
        let frames_sound = self.reception.frames.as_ref().is_none_or(FrameCounters::is_sound);
        let all_decoded =
            self.reception.instruments_contradictory + self.reception.payloads_before_instrument == 0;
        frames_sound && clean && self.truncated_bytes == 0 && all_decoded
    }
}
