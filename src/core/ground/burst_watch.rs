//! Watches each pass for bursts, and takes the visibilities in them out of the sums again.
//!
//! Visibilities enter the sums when they arrive, so that nothing waits and a ground without bursts does what it did before. Copies of those of
//! the open pass are kept until it ends: with the spacecraft's report that closes it, with data that begin more than a gap
//! apart, or with the session. Sums are exact, so that what is subtracted has never been in them.

use std::collections::BTreeMap;
use std::mem;

use super::DeliveredPacket;
use crate::calibration::{BurstSearch, FoundBursts, PassAlerts, SearchedChannel, find_alerts, find_bursts};
use crate::downlink::receive::SendingKey;
use crate::frames::{PlacedFrame, PlacedVisibilities};
use crate::units::ChannelId;

/// Time without data between two passes, s.
const GAP_S: f64 = 600.0;

/// Maximum number of visibilities that are kept, some 30 MB: a pass of 30 channels has 160,000. Beyond it those of the pass so far are
/// judged without the rest.
const VISIBILITIES_MAX: usize = 1 << 18;

/// Part by which the visibilities of a channel grow between searches of an open pass while data arrive without pause: all searches of a pass
/// take as long as some nine of all of it.
const GROWTH: f64 = 1.0 / 8.0;

/// The same while nothing else waits: some 65 times.
const IDLE_GROWTH: f64 = 1.0 / 64.0;

/// A block of visibilities, and the packet that brought it.
pub(super) struct WatchedBlock {
    pub(super) placed: PlacedVisibilities,
    pub(super) sent: Option<SendingKey>,
    /// Whether some are in the sums.
    pub(super) is_used: bool,
}

/// The visibilities of the open pass in a channel.
#[derive(Default)]
struct WatchedChannel {
    blocks: Vec<WatchedBlock>,
    visibilities: usize,
    /// How many of them there were at the last search.
    searched: usize,
    alerts: PassAlerts,
}

/// The visibilities of the open pass, by channel.
#[derive(Default)]
pub(super) struct BurstWatch {
    channels: BTreeMap<ChannelId, WatchedChannel>,
    span_s: Option<[f64; 2]>,
    visibilities: usize,
}

impl BurstWatch {
    /// Whether a frame ends the open pass: it belongs to another one, or there is no room for it.
    pub(super) fn is_ended_by(&self, frame: &PlacedFrame) -> bool {
        match frame {
            PlacedFrame::Housekeeping(_) => self.visibilities > 0,
            PlacedFrame::Visibilities(placed) => {
                let Some([from_s, until_s]) = self.span_s else { return false };
                let ends = placed.time_s.first().zip(placed.time_s.last());
                let is_apart =
                    ends.is_some_and(|(first, last)| *first > until_s + GAP_S || *last < from_s - GAP_S);
                is_apart || self.visibilities + placed.len() > VISIBILITIES_MAX
            }
            _ => false,
        }
    }

    /// Keeps visibilities of a mapped channel; `is_used` tells whether some are in the sums.
    pub(super) fn keep(&mut self, placed: PlacedVisibilities, packets: &[DeliveredPacket], is_used: bool) {
        let Some((&first, &last)) = placed.time_s.first().zip(placed.time_s.last()) else { return };
        let [from_s, until_s] = self.span_s.unwrap_or([first, last]);
        self.span_s = Some([from_s.min(first), until_s.max(last)]);
        self.visibilities += placed.len();
        let sent = packets.first().map(|packet| (packet.header.time, packet.header.count));
        let channel = self.channels.entry(placed.channel).or_default();
        channel.visibilities += placed.len();
        channel.blocks.push(WatchedBlock { placed, sent, is_used });
    }

    /// Searches channels of the open pass: those that have grown enough, less while nothing else waits.
    pub(super) fn alert(&mut self, bursts: &FoundBursts, is_idle: bool) {
        for channel in self.channels.values_mut() {
            let new = channel.visibilities - channel.searched;
            let growth = if is_idle { IDLE_GROWTH } else { GROWTH };
            if new as f64 > growth * channel.searched as f64 {
                channel.searched = channel.visibilities;
                let placed: Vec<_> = channel.blocks.iter().map(|block| &block.placed).collect();
                bursts.alert(&mut channel.alerts, find_alerts(&placed));
            }
        }
    }

    /// Ends the open pass, and returns its visibilities by channel.
    pub(super) fn take(&mut self) -> Vec<Vec<PlacedVisibilities>> {
        let channels = mem::take(self).channels.into_values();
        channels.map(|channel| channel.blocks.into_iter().map(|block| block.placed).collect()).collect()
    }

    /// Ends the open pass: adds its bursts to a table, counts it there, and returns the blocks of channels with bursts.
    pub(super) fn end(&mut self, search: BurstSearch, bursts: &FoundBursts) -> Vec<WatchedBlock> {
        let Self { channels, .. } = mem::take(self);
        let mut disturbed = Vec::new();
        let searched = |channel: &WatchedChannel| {
            let placed: Vec<&PlacedVisibilities> = channel.blocks.iter().map(|block| &block.placed).collect();
            find_bursts(search, &placed)
        };
        let searched: Vec<SearchedChannel> = channels.values().map(searched).collect();
        bursts.add_pass(&searched);
        for (WatchedChannel { blocks, .. }, SearchedChannel { bursts: mut found, .. }) in
            channels.into_values().zip(searched)
        {
            // By a session that had the first visibilities of the pass.
            found.retain(|burst| !bursts.knows(burst));
            let has_new = found.into_iter().filter(|burst| bursts.add(burst.clone())).count() > 0;
            if has_new {
                disturbed.extend(blocks);
            }
        }
        disturbed
    }
}
