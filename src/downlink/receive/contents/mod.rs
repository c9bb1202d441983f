//! What is in a downlink file: the library side of `lunarray inspect`.
//!
//! The file is streamed; what is kept grows with what the file says, not with its length: one row for each
//! pair and channel, and at most [`LISTED_MAX`] entries in each list.

mod calendar;
mod survey;
mod table;

use std::fs::File;
use std::io::Read;
use std::path::Path;

use serde::Serialize;

use super::cadu::FrameCounters;
use super::{Decoder, Intake, ReceptionCounters};
use crate::downlink::error::{DownlinkError, io_error, require_packets};
use crate::downlink::wire::{Format, Kind};
use crate::frames::GroundFrame;

pub use calendar::tai_text;

/// Entries of a list that are kept; the others are counted.
pub const LISTED_MAX: usize = 1_000;

/// The first entries of a list, and how many there are.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Listing<T> {
    /// All entries, listed or not.
    pub count: u64,
    /// The first [`LISTED_MAX`] of them.
    pub listed: Vec<T>,
}

impl<T> Default for Listing<T> {
    fn default() -> Self {
        Self { count: 0, listed: Vec::new() }
    }
}

impl<T> Listing<T> {
    pub(crate) fn push(&mut self, entry: T) {
        self.count += 1;
        if self.listed.len() < LISTED_MAX {
            self.listed.push(entry);
        }
    }
}

/// A stretch of time.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Span {
    /// Beginning, s since the mission epoch.
    pub start_s: f64,
    /// End, s since the mission epoch.
    pub end_s: f64,
    /// Beginning as a date, TAI.
    pub start_tai: String,
    /// End as a date, TAI.
    pub end_tai: String,
    /// Beginning as a date, UTC with the 37 leap seconds that hold since 2017.
    pub start_utc: String,
    /// End as a date, UTC with the 37 leap seconds that hold since 2017.
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
    /// Band and channels of the spectrometer behind the daughters, if there is one.
    pub spectrometer: Option<String>,
}

/// Packets of one kind.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct KindSummary {
    /// Kind.
    pub kind: Kind,
    /// Application process identifier.
    pub apid: u16,
    /// Good packets.
    pub packets: u64,
    /// Bytes of those.
    pub bytes: u64,
    /// Count of the first packet received: so many were sent before this file begins.
    pub first_count: Option<u64>,
    /// Greatest count received.
    pub last_count: Option<u64>,
}

/// Visibilities of some pairs and channels.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct VisibilityCounts {
    /// Visibilities.
    pub count: u64,
    /// Their integration times together, s.
    pub integration_s: f64,
    /// Those of them that are flagged.
    pub flagged: u64,
}

/// A channel and what is in it.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct ChannelSummary {
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
    /// Stretches covered: beginning and end, s since the mission epoch.
    pub covered: Listing<[f64; 2]>,
}

/// The spacecraft's own counts, the latest that came.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct HousekeepingSummary {
    /// Time up to which they hold, s since the mission epoch.
    pub time_s: f64,
    /// Visibilities sampled since the mission epoch.
    pub sampled: u64,
    /// Visibilities dropped on board since the mission epoch.
    pub dropped: u64,
}

/// Packets missing. Counts have 46 bits in our packets, so that no gap is ambiguous.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct GapEntry {
    /// Kind.
    pub kind: Kind,
    /// Application process identifier.
    pub apid: u16,
    /// Count of the first missing packet.
    pub from: u64,
    /// Count of the last missing packet.
    pub to: u64,
    /// How many are missing.
    pub count: u64,
    /// Place of the packet after the gap.
    pub offset: u64,
    /// When the last packet of the kind before the gap was made, s since the mission epoch.
    pub after_s: Option<f64>,
    /// When the packet after the gap was made, s since the mission epoch.
    pub before_s: Option<f64>,
}

/// A packet whose headers hold but whose body does not.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct DamagedEntry {
    /// Place in the file.
    pub offset: u64,
    /// Kind.
    pub kind: Kind,
    /// Application process identifier.
    pub apid: u16,
    /// Packet count.
    pub count: u64,
    /// Length that its headers give.
    pub bytes: u64,
    /// When it was made, s since the mission epoch.
    pub time_s: Option<f64>,
}

/// Bytes that belong to no packet.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct GarbageEntry {
    /// Place in the file.
    pub offset: u64,
    /// How many.
    pub bytes: u64,
}

/// A payload that was refused although its packet's check held.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct FaultEntry {
    /// Place of its last packet.
    pub offset: u64,
    /// Why.
    pub reason: String,
}

/// What is in a downlink file.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Contents {
    /// The file.
    pub file: String,
    /// Its length.
    pub bytes: u64,
    /// Plain packets, or packets in coded frames; the places below then count in what was recovered.
    pub format: Format,
    /// From the first to the last integration.
    pub span: Option<Span>,
    /// The instrument description.
    pub instrument: Option<InstrumentSummary>,
    /// The channels, in the instrument's order.
    pub channels: Vec<ChannelSummary>,
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
    /// Missing packets.
    pub gaps: Listing<GapEntry>,
    /// Packets whose checksum fails.
    pub bad_checksums: Listing<DamagedEntry>,
    /// Bytes that belong to no packet.
    pub garbage: Listing<GarbageEntry>,
    /// Refused payloads.
    pub faults: Listing<FaultEntry>,
    /// Bytes of an unfinished packet at the end.
    pub truncated_bytes: u64,
    /// The account of the reception.
    pub reception: ReceptionCounters,
}

impl Contents {
    /// Looks through a file.
    ///
    /// # Errors
    /// A file that cannot be read, is empty, or holds no packet at all; damage is told in the result.
    pub fn read(path: &Path) -> Result<Self, DownlinkError> {
        Self::read_with(path, &mut |_| {})
    }

    /// Looks through a file, and shows `see` every frame.
    ///
    /// # Errors
    /// Those of [`Contents::read`].
    pub fn read_with(path: &Path, see: &mut dyn FnMut(&GroundFrame)) -> Result<Self, DownlinkError> {
        Self::read_from(File::open(path).map_err(io_error(path, "open the file"))?, path, see)
    }

    /// Looks through any source; `path` names it, `see` is shown every frame.
    ///
    /// # Errors
    /// Those of [`Contents::read`].
    pub fn read_from(
        mut source: impl Read,
        path: &Path,
        see: &mut dyn FnMut(&GroundFrame),
    ) -> Result<Self, DownlinkError> {
        let mut receiver = Intake::new();
        let mut decoder = Decoder::new();
        let mut survey = survey::Survey::default();
        let mut at_end = false;
        while !at_end {
            if receiver.fill_from(&mut source).map_err(io_error(path, "read"))? == 0 {
                receiver.finish();
                at_end = true;
            }
            while let Some(event) = receiver.next_event() {
                survey.see_event(&event);
                if let Some(frame) = decoder.accept(&event) {
                    survey.see_frame(&frame);
                    see(&frame);
                }
                if let Some((offset, fault)) = decoder.take_fault() {
                    survey.faults.push(FaultEntry { offset, reason: fault.to_string() });
                }
            }
        }
        decoder.finish();
        require_packets(path, receiver.bytes(), decoder.counters().packets())?;
        let mut reception = ReceptionCounters { frames: receiver.frames(), ..decoder.counters().clone() };
        for kind in Kind::ALL {
            reception.kind_mut(kind).restarts = receiver.restarts(kind);
        }
        Ok(survey.conclude(path, receiver.bytes(), &reception))
    }

    /// Whether nothing is missing or damaged, and everything could be understood.
    #[must_use]
    pub fn is_sound(&self) -> bool {
        let clean = self.gaps.count + self.bad_checksums.count + self.garbage.count + self.faults.count == 0;
        let frames_sound = self.reception.frames.as_ref().is_none_or(FrameCounters::is_sound);
        let understood =
            self.reception.instruments_contradictory + self.reception.payloads_before_instrument == 0;
        frames_sound && clean && self.truncated_bytes == 0 && understood
    }
}
