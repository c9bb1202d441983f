//! Counters of the data that the ground has received, lost and refused.

use serde::Serialize;

use super::cadu::FrameCounters;
use crate::downlink::error::PayloadFault;
use crate::downlink::wire::PacketKind;

/// Counters of the packets of one kind.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, bincode::Encode, bincode::Decode)]
pub struct KindCounts {
    /// Valid packets, without duplicates.
    pub packets: u64,
    /// Bytes of these packets.
    pub bytes: u64,
    /// Packets with valid headers and an invalid packet checksum.
    pub damaged: u64,
    /// Packets received before.
    pub duplicates: u64,
    /// Gaps in the packet count.
    pub gaps: u64,
    /// Packets missing in these gaps.
    pub missing: u64,
    /// Packets that arrived later and filled a gap or replaced a damaged packet.
    pub late: u64,
    /// Restarts of the packet count.
    pub restarts: u64,
    /// Incomplete payloads, and segments without the rest of their payload.
    pub orphans: u64,
}

/// Counters of the payloads refused in spite of valid checksums, by reason.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, bincode::Encode, bincode::Decode)]
pub struct FaultCounts {
    /// Unknown format version.
    pub version: u64,
    /// Malformed record.
    pub record: u64,
    /// Length other than the record requires.
    pub length: u64,
    /// Value out of range.
    pub value: u64,
    /// Times that do not increase.
    pub order: u64,
}

/// Why a payload was refused.
#[derive(Clone, Copy, Debug, PartialEq, Eq, bincode::Encode, bincode::Decode)]
pub enum FaultKind {
    /// Unknown format version.
    Version,
    /// Malformed record.
    Record,
    /// Length other than the record requires.
    Length,
    /// Value out of range.
    Value,
    /// Times that do not increase.
    Order,
}

impl From<&PayloadFault> for FaultKind {
    fn from(fault: &PayloadFault) -> Self {
        match fault {
            PayloadFault::Version { .. } => Self::Version,
            PayloadFault::Record { .. } => Self::Record,
            PayloadFault::Length { .. } => Self::Length,
            PayloadFault::Value { .. } => Self::Value,
            PayloadFault::Order => Self::Order,
        }
    }
}

/// Result of decoding the payload that a packet completed.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, bincode::Encode, bincode::Decode)]
pub enum PayloadOutcome {
    /// The payload was decoded, or the packet completed none.
    #[default]
    Decoded,
    /// The payload was refused.
    Refused(FaultKind),
    /// The payload came before any instrument description.
    BeforeInstrument,
    /// The payload followed a contradictory instrument description.
    Foreign,
    /// The payload is a contradictory instrument description.
    Contradictory,
}

/// Result of decoding one packet: what it adds to the counters, apart from the packet and its bytes.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, bincode::Encode, bincode::Decode)]
pub struct PacketOutcome {
    /// Result of the payload.
    pub payload: PayloadOutcome,
    /// Visibilities decoded.
    pub visibilities_decoded: u32,
    /// Visibilities dropped for a bad value.
    pub visibilities_bad_value: u32,
    /// Visibilities of a payload that was not decoded.
    pub visibilities_unread: u32,
    /// Partial payloads discarded with this packet, and segments that belong to none.
    pub orphans: u32,
}

impl FaultCounts {
    fn count_mut(&mut self, fault: FaultKind) -> &mut u64 {
        match fault {
            FaultKind::Version => &mut self.version,
            FaultKind::Record => &mut self.record,
            FaultKind::Length => &mut self.length,
            FaultKind::Value => &mut self.value,
            FaultKind::Order => &mut self.order,
        }
    }

    /// Number of all refused payloads.
    #[must_use]
    pub fn total(&self) -> u64 {
        self.version + self.record + self.length + self.value + self.order
    }
}

/// Counters of a reception.
///
/// `bytes` is the sum of `bytes_garbage`, `bytes_truncated`, `bytes_damaged`, `bytes_duplicate`, `bytes_beyond` and the
/// `bytes` of all kinds. The number of visibilities in valid packets is
/// `decoded + bad_value + refused + before_instrument + foreign`.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, bincode::Encode, bincode::Decode)]
pub struct ReceptionCounters {
    /// Counters of a coded stream; `None` for plain packets. All other counters are of recovered packets.
    pub frames: Option<FrameCounters>,
    /// Bytes received, without idle packets; for coded frames, recovered packet bytes.
    pub bytes: u64,
    /// Bytes that belong to no packet.
    pub bytes_garbage: u64,
    /// Number of runs of such bytes.
    pub garbage_stretches: u64,
    /// Bytes of truncated packets at the end of a stream.
    pub bytes_truncated: u64,
    /// Bytes of damaged packets.
    pub bytes_damaged: u64,
    /// Bytes of duplicate packets.
    pub bytes_duplicate: u64,
    /// Bytes of new packets that were refused because the received set was full.
    pub bytes_beyond: u64,
    /// New packets that were refused because the received set was full.
    pub packets_beyond: u64,
    /// Packets of instrument descriptions.
    pub instrument: KindCounts,
    /// Packets of satellite positions.
    pub ephemeris: KindCounts,
    /// Packets of visibilities.
    pub visibilities: KindCounts,
    /// Calibration packets, a reserved kind that is counted and skipped.
    pub calibration: KindCounts,
    /// Packets of the spacecraft's counts.
    pub housekeeping: KindCounts,
    /// Refused payloads.
    pub faults: FaultCounts,
    /// Instrument descriptions that contradict the first.
    pub instruments_contradictory: u64,
    /// Payloads refused because they followed a contradictory instrument description.
    pub payloads_foreign: u64,
    /// Payloads that could not be decoded because they came before any instrument description.
    pub payloads_before_instrument: u64,
    /// Visibilities decoded.
    pub visibilities_decoded: u64,
    /// Visibilities dropped because they are not finite, or their weight or duration is not positive.
    pub visibilities_bad_value: u64,
    /// Visibilities in refused payloads.
    pub visibilities_refused: u64,
    /// Visibilities that came before any instrument description.
    pub visibilities_before_instrument: u64,
    /// Visibilities that followed a contradictory instrument description.
    pub visibilities_foreign: u64,
}

impl ReceptionCounters {
    /// Counters of one kind.
    #[must_use]
    #[doc(hidden)]
    pub fn kind(&self, kind: PacketKind) -> &KindCounts {
        match kind {
            PacketKind::Instrument => &self.instrument,
            PacketKind::Ephemeris => &self.ephemeris,
            PacketKind::Visibilities => &self.visibilities,
            PacketKind::Calibration => &self.calibration,
            PacketKind::Housekeeping => &self.housekeeping,
        }
    }

    pub(crate) fn kind_mut(&mut self, kind: PacketKind) -> &mut KindCounts {
        match kind {
            PacketKind::Instrument => &mut self.instrument,
            PacketKind::Ephemeris => &mut self.ephemeris,
            PacketKind::Visibilities => &mut self.visibilities,
            PacketKind::Calibration => &mut self.calibration,
            PacketKind::Housekeeping => &mut self.housekeeping,
        }
    }

    /// Adds a valid packet that is not a duplicate.
    pub(crate) fn add_packet(&mut self, kind: PacketKind, bytes: u32, outcome: &PacketOutcome) {
        let PacketOutcome { payload, orphans, visibilities_unread: unread, .. } = *outcome;
        // The sums saturate, as a forged journal may contain any numbers.
        let add = |count: &mut u64, more: u32| *count = count.saturating_add(u64::from(more));
        add(&mut self.bytes, bytes);
        let counts = self.kind_mut(kind);
        add(&mut counts.packets, 1);
        add(&mut counts.bytes, bytes);
        add(&mut counts.orphans, orphans);
        add(&mut self.visibilities_decoded, outcome.visibilities_decoded);
        add(&mut self.visibilities_bad_value, outcome.visibilities_bad_value);
        match payload {
            PayloadOutcome::Decoded => {}
            PayloadOutcome::Refused(fault) => {
                add(self.faults.count_mut(fault), 1);
                add(&mut self.visibilities_refused, unread);
            }
            PayloadOutcome::BeforeInstrument => {
                add(&mut self.payloads_before_instrument, 1);
                add(&mut self.visibilities_before_instrument, unread);
            }
            PayloadOutcome::Foreign => {
                add(&mut self.payloads_foreign, 1);
                add(&mut self.visibilities_foreign, unread);
            }
            PayloadOutcome::Contradictory => add(&mut self.instruments_contradictory, 1),
        }
    }

    /// Number of faults in a stream: damaged packets, runs of bytes that belong to no packet, a truncated end, uncorrectable frames
    /// and losses of synchronisation.
    pub(crate) fn faults(&self) -> u64 {
        let damaged: u64 = PacketKind::ALL.into_iter().map(|kind| self.kind(kind).damaged).sum();
        let of_frames =
            self.frames.as_ref().map_or(0, |frames| frames.frames_uncorrectable + frames.sync_losses);
        damaged + self.garbage_stretches + u64::from(self.bytes_truncated > 0) + of_frames
    }

    /// Adds a stream's counters of garbage, damage, truncation and frames, but not of valid packets.
    pub(crate) fn add_stream(&mut self, other: &Self) {
        self.bytes += other.bytes_garbage + other.bytes_truncated + other.bytes_damaged;
        self.bytes_garbage += other.bytes_garbage;
        self.garbage_stretches += other.garbage_stretches;
        self.bytes_truncated += other.bytes_truncated;
        self.bytes_damaged += other.bytes_damaged;
        for kind in PacketKind::ALL {
            self.kind_mut(kind).damaged += other.kind(kind).damaged;
        }
        if let Some(frames) = &other.frames {
            self.frames.get_or_insert_default().add(frames);
        }
    }

    /// A sentence about the restarts of the packet counts; `None` if there were none.
    pub(crate) fn restarts_text(&self) -> Option<String> {
        let kinds = PacketKind::ALL.into_iter().filter(|kind| self.kind(*kind).restarts > 0);
        let counts: Vec<String> = kinds.map(|kind| format!("{kind} {}", self.kind(kind).restarts)).collect();
        (!counts.is_empty()).then(|| {
            format!(
                "the spacecraft restarted its packet counts (number of restarts: {}): packets lost just before a restart are not known",
                counts.join(", ")
            )
        })
    }

    /// Number of valid packets of all kinds.
    #[must_use]
    #[doc(hidden)]
    pub fn packets(&self) -> u64 {
        PacketKind::ALL.iter().map(|kind| self.kind(*kind).packets).sum()
    }
}

impl std::fmt::Display for ReceptionCounters {
    /// One line per kind of packet, then one about bad data.
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        if let Some(frames) = &self.frames {
            writeln!(f, "{frames}")?;
        }
        for kind in PacketKind::ALL {
            let counts = self.kind(kind);
            if *counts != KindCounts::default() {
                let KindCounts { packets, bytes, damaged, duplicates, missing, .. } = counts;
                let name = format!("{kind:?}").to_lowercase();
                write!(f, "{name:<14} {packets:>10} packets {bytes:>14} bytes")?;
                writeln!(f, "  {missing} missing, {damaged} damaged, {duplicates} duplicate")?;
            }
        }
        if let Some(restarts) = self.restarts_text() {
            writeln!(f, "{restarts}")?;
        }
        if self.packets_beyond > 0 {
            writeln!(
                f,
                "{} new packets refused: the set of received packets is full, which only forged packets can cause",
                self.packets_beyond
            )?;
        }
        if self.payloads_before_instrument > 0 {
            let (payloads, visibilities) =
                (self.payloads_before_instrument, self.visibilities_before_instrument);
            writeln!(
                f,
                "{payloads} payloads with {visibilities} visibilities before any instrument description"
            )?;
        }
        write!(
            f,
            "{} bytes between packets, {} in a truncated end, {} payloads refused, {} visibilities with invalid values",
            self.bytes_garbage,
            self.bytes_truncated,
            self.faults.total(),
            self.visibilities_bad_value
        )
    }
}
