//! The truth about a simulated link: what happened to each frame and packet.

use std::fmt;
use std::ops::RangeInclusive;

use serde::{Deserialize, Serialize};

use crate::downlink::config::LinkConfig;
use crate::downlink::wire::Format;

/// Why a frame cannot be recovered on the ground. Of several copies, the greatest fate counts: that of the copy that got
/// furthest.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum FrameFate {
    /// The pass did not arrive.
    PassLost,
    /// The pass was truncated before the end of the frame.
    CutOff,
    /// The frame did not arrive.
    Lost,
    /// A bit was lost or added in the frame.
    Slipped,
    /// The frame has more errors than can be corrected; for a plain packet, any error.
    Spoilt,
}

/// Consecutive frames of one virtual channel that cannot be recovered.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct LostFrames {
    /// Virtual channel.
    pub channel: u8,
    /// Count of the first frame.
    pub from: u32,
    /// Count of the last frame.
    pub to: u32,
    /// Why they cannot be recovered.
    pub fate: FrameFate,
}

/// Consecutive packets of one kind.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct PacketRange {
    /// Application process identifier.
    pub apid: u16,
    /// Count of the first packet, 46 bits; the sequence count of the primary header is its lower 14.
    pub from: u64,
    /// Count of the last packet.
    pub to: u64,
}

impl PacketRange {
    /// The counts as a range.
    #[must_use]
    pub fn counts(&self) -> RangeInclusive<u64> {
        self.from..=self.to
    }
}

/// The truth about a damaged downlink.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct LinkTruth {
    /// Seed of all faults.
    pub seed: u64,
    /// Configuration of the link.
    pub link: LinkConfig,
    /// Plain packets, or coded frames.
    pub format: Format,
    /// Passes sent.
    pub passes: u64,
    /// Passes that did not arrive.
    pub passes_lost: u64,
    /// Passes truncated.
    pub passes_cut: u64,
    /// Passes that arrived after their successor.
    pub passes_swapped: u64,
    /// Frames sent, or packets if they are sent plain.
    pub frames_sent: u64,
    /// Frames with at least one recoverable copy.
    pub frames_recoverable: u64,
    /// Copies that arrived, complete or not.
    pub copies_delivered: u64,
    /// Recoverable copies of frames beyond the first one of each.
    pub copies_duplicate: u64,
    /// Copies that arrived late.
    pub copies_delayed: u64,
    /// Copies with bit errors.
    pub copies_damaged: u64,
    /// Copies with a bit lost or added.
    pub copies_slipped: u64,
    /// Wrong bits.
    pub bits_flipped: u64,
    /// Bytes that arrived.
    pub bytes_delivered: u64,
    /// Packets sent, without idle ones.
    pub packets_sent: u64,
    /// Visibilities that the spacecraft had integrated by the end of the last pass, by its own count.
    pub visibilities_sampled: u64,
    /// Visibilities that the spacecraft dropped because its store was full.
    pub visibilities_dropped: u64,
    /// Visibilities sent.
    pub visibilities_sent: u64,
    /// Visibilities in packets that cannot be recovered.
    pub visibilities_lost: u64,
    /// Coded frames that cannot be recovered.
    pub frames_lost: Vec<LostFrames>,
    /// Packets that cannot be recovered.
    pub packets_lost: Vec<PacketRange>,
    /// Packets with more than one recoverable copy.
    pub packets_duplicate: Vec<PacketRange>,
}

impl fmt::Display for LinkTruth {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let what = if self.format == Format::Cadu { "coded frames" } else { "packets" };
        writeln!(
            f,
            "passes         {} sent, {} lost, {} truncated, {} swapped",
            self.passes, self.passes_lost, self.passes_cut, self.passes_swapped
        )?;
        writeln!(
            f,
            "{what:<14} {} sent, {} recoverable; copies: {} delivered, {} with bit errors ({} bits), {} slipped, {} \
            late, {} duplicate",
            self.frames_sent,
            self.frames_recoverable,
            self.copies_delivered,
            self.copies_damaged,
            self.bits_flipped,
            self.copies_slipped,
            self.copies_delayed,
            self.copies_duplicate
        )?;
        let lost: u64 = self.packets_lost.iter().map(|range| range.to - range.from + 1).sum();
        writeln!(f, "packets        {} sent, {lost} lost", self.packets_sent)?;
        write!(
            f,
            "visibilities   {} sampled, {} dropped by a full store, {} sent, {} lost",
            self.visibilities_sampled,
            self.visibilities_dropped,
            self.visibilities_sent,
            self.visibilities_lost
        )
    }
}

impl LinkTruth {
    pub(super) fn add_lost_frame(&mut self, channel: u8, count: u32, fate: FrameFate) {
        match self.frames_lost.last_mut() {
            Some(last) if (last.channel, last.fate, last.to.wrapping_add(1)) == (channel, fate, count) => {
                last.to = count;
            }
            _ => self.frames_lost.push(LostFrames { channel, from: count, to: count, fate }),
        }
    }
}

pub(super) fn list_packet(list: &mut Vec<PacketRange>, apid: u16, count: u64) {
    match list.last_mut() {
        Some(last) if (last.apid, last.to + 1) == (apid, count) => last.to = count,
        _ => list.push(PacketRange { apid, from: count, to: count }),
    }
}
