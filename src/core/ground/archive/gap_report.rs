//! Report on a gap, and the packets from which its content is estimated.

use std::ops::Range;

use serde::Serialize;

use super::entry::JournalEntry;
use crate::downlink::PacketKind;
use crate::units::{ChannelId, Pair};

/// Channel and pair of a stream of packets. In each window the streams are sent one after another.
pub(super) type Stream = (ChannelId, Pair);

/// A received packet of visibilities.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct VisibilityPacket {
    /// Summary of its content.
    pub entry: JournalEntry,
    /// Whether the ephemeris does not cover it.
    pub is_waiting: bool,
    /// Fraction of its visibilities offered to the sums that were accumulated; `None` if unknown.
    pub share: Option<f64>,
}

impl VisibilityPacket {
    pub(super) fn stream(&self) -> Stream {
        (self.entry.channel, self.entry.pair)
    }

    /// Whether it holds auto-correlations, which are not mapped.
    pub(super) fn is_auto(&self) -> bool {
        self.entry.pair.i == self.entry.pair.j
    }
}

/// Estimated content of the missing packets of one channel and pair, or packets that wait for a missing ephemeris.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct LostStream {
    /// Channel, from 0.
    pub channel: u16,
    /// Pair, as in "1-2".
    pub pair: String,
    /// Number of packets.
    pub packets: u64,
    /// Integration time in the packets, s.
    pub integration_s: f64,
    /// Sum of the weights in the map, (K sr)^-2.
    pub weight: f64,
}

impl LostStream {
    pub(super) fn empty((channel, pair): Stream) -> Self {
        Self { channel: channel.0, pair: pair.to_string(), packets: 0, integration_s: 0.0, weight: 0.0 }
    }
}

/// A range of missing packets, to be requested again.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct GapReport {
    /// Kind of the packets.
    pub kind: PacketKind,
    /// Application process identifier.
    pub apid: u16,
    /// Count of the first missing packet.
    pub from: u64,
    /// Count of the last missing packet.
    pub to: u64,
    /// Mission times of the last visibility before and the first after the gap, s; `None` if there is none.
    pub between_s: [Option<f64>; 2],
    /// Integration time in the gap, s, over all channels and pairs.
    pub integration_s: f64,
    /// Weight relative to the weight in the map of the same channel, averaged over all channels; 1 for a channel without
    /// data in the map.
    pub gain: f64,
    /// Missing visibilities, or those that wait for a missing ephemeris, by channel and pair.
    pub lost: Vec<LostStream>,
}

impl GapReport {
    pub(super) fn new(
        kind: PacketKind,
        gap: &Range<u64>,
        between_s: [Option<f64>; 2],
        lost: Vec<LostStream>,
    ) -> Self {
        // An empty sum of floats is -0.
        let integration_s = lost.iter().map(|lost| lost.integration_s).sum::<f64>() + 0.0;
        let (from, to, apid) = (gap.start, gap.end - 1, kind.apid());
        Self { kind, apid, from, to, between_s, integration_s, gain: 0.0, lost }
    }
}
