//! A gap, and the packets that it is estimated from.

use std::ops::Range;

use serde::Serialize;

use super::entry::JournalEntry;
use crate::downlink::PacketKind;
use crate::units::{ChannelId, Pair};

/// Channel and pair: each sends its packets in turn, pass by pass.
pub(super) type Stream = (ChannelId, Pair);

/// A packet of visibilities.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct VisibilityPacket {
    /// Its content.
    pub entry: JournalEntry,
    /// Whether its positions are missing.
    pub waits: bool,
    /// Share of its placed visibilities that are in the map; `None` if it is not known.
    pub share: Option<f64>,
}

impl VisibilityPacket {
    pub(super) fn stream(&self) -> Stream {
        (self.entry.channel, self.entry.pair)
    }

    /// Whether it holds auto-correlations, which are in no map.
    pub(super) fn is_auto(&self) -> bool {
        self.entry.pair.i == self.entry.pair.j
    }
}

/// An estimate of what the missing packets of one channel and pair held; or held packets that wait for missing positions.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct LostStream {
    /// Channel, from 0.
    pub channel: u16,
    /// Pair, as in "1-2".
    pub pair: String,
    /// Packets.
    pub packets: u64,
    /// Integration time in them, s.
    pub integration_s: f64,
    /// Sum of their weights in the map, (K sr)^-2.
    pub weight: f64,
}

impl LostStream {
    pub(super) fn nothing((channel, pair): Stream) -> Self {
        Self { channel: channel.0, pair: pair.to_string(), packets: 0, integration_s: 0.0, weight: 0.0 }
    }
}

/// A run of missing packets, to be requested again.
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
    /// Mission time of the last visibility before it and the first after it, s, if there are any.
    pub between_s: [Option<f64>; 2],
    /// Integration time in it, s, over all channels and pairs.
    pub integration_s: f64,
    /// Its weight over that in the map of the same channel, in the mean over all channels; 1 for a channel of
    /// which the map has nothing.
    pub gain: f64,
    /// By channel and pair: missing visibilities, or those that wait for missing positions.
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
