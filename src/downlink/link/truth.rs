//! What became of everything that was sent over a simulated link.

use std::fmt;
use std::ops::RangeInclusive;

use serde::{Deserialize, Serialize};

use super::config::LinkConfig;
use crate::downlink::wire::Format;

/// Why a frame cannot be recovered on the ground. Of several copies the one that got furthest counts.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum FrameFate {
    /// Its pass did not arrive.
    PassLost,
    /// Its pass was cut off before its end.
    CutOff,
    /// It did not arrive.
    Lost,
    /// A bit was lost or added in it.
    Slipped,
    /// More of it is wrong than can be corrected; of a plain packet, anything.
    Spoilt,
}

/// Consecutive frames of one virtual channel that cannot be recovered.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct LostFrames {
    /// Virtual channel.
    pub channel: u8,
    /// Count of the first.
    pub from: u32,
    /// Count of the last.
    pub to: u32,
    /// Why.
    pub fate: FrameFate,
}

/// Consecutive packets of one kind.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct PacketRange {
    /// Application process identifier.
    pub apid: u16,
    /// Count of the first, 46 bits; the sequence count is its lower 14.
    pub from: u64,
    /// Count of the last.
    pub to: u64,
}

impl PacketRange {
    /// Counts.
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
    /// What the link was told to do.
    pub link: LinkConfig,
    /// Plain packets, or coded frames.
    pub format: Format,
    /// Passes sent.
    pub passes: u64,
    /// Passes that did not arrive.
    pub passes_lost: u64,
    /// Passes cut off.
    pub passes_cut: u64,
    /// Passes that arrived after the one that followed them.
    pub passes_swapped: u64,
    /// Frames sent (packets where these are sent plain).
    pub frames_sent: u64,
    /// Frames of which at least one copy can be recovered.
    pub frames_recoverable: u64,
    /// Copies that arrived, whole or not.
    pub copies_delivered: u64,
    /// Copies beyond the first of frames that arrived twice.
    pub copies_duplicate: u64,
    /// Copies that arrived later than they should.
    pub copies_delayed: u64,
    /// Copies with wrong bits.
    pub copies_damaged: u64,
    /// Copies with a bit lost or added.
    pub copies_slipped: u64,
    /// Wrong bits.
    pub bits_flipped: u64,
    /// Bytes delivered.
    pub bytes_delivered: u64,
    /// Packets sent, idle ones left out.
    pub packets_sent: u64,
    /// Visibilities that the spacecraft had integrated by the end of the last pass, as she counts.
    pub visibilities_sampled: u64,
    /// Visibilities of those that she dropped because her store was full.
    pub visibilities_dropped: u64,
    /// Visibilities sent.
    pub visibilities_sent: u64,
    /// Visibilities in packets that cannot be recovered.
    pub visibilities_lost: u64,
    /// Coded frames that cannot be recovered.
    pub frames_lost: Vec<LostFrames>,
    /// Packets that cannot be recovered.
    pub packets_lost: Vec<PacketRange>,
    /// Packets of which more than one copy can be recovered.
    pub packets_duplicate: Vec<PacketRange>,
}

impl fmt::Display for LinkTruth {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let what = if self.format == Format::Cadu { "coded frames" } else { "packets" };
        writeln!(
            f,
            "passes         {} sent, {} lost, {} cut off, {} swapped",
            self.passes, self.passes_lost, self.passes_cut, self.passes_swapped
        )?;
        writeln!(
            f,
            "{what:<14} {} sent, {} recoverable; copies: {} delivered, {} with wrong bits ({} bits), {} slipped, {} \
             late, {} to spare",
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
    pub(super) fn lose_frame(&mut self, channel: u8, count: u32, fate: FrameFate) {
        match self.frames_lost.last_mut() {
            Some(last) if (last.channel, last.fate, last.to.wrapping_add(1)) == (channel, fate, count) => {
                last.to = count;
            }
            _ => self.frames_lost.push(LostFrames { channel, from: count, to: count, fate }),
        }
    }
}

/// Adds a packet to a list of ranges.
pub(super) fn list_packet(list: &mut Vec<PacketRange>, apid: u16, count: u64) {
    match list.last_mut() {
        Some(last) if (last.apid, last.to + 1) == (apid, count) => last.to = count,
        _ => list.push(PacketRange { apid, from: count, to: count }),
    }
}
