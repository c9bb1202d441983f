//! Summary of a packet of visibilities: the part of a journal record that is known before the packet is applied.

use bincode::{Decode, Encode};

use crate::downlink::CucTime;
use crate::downlink::receive::SendingKey;
use crate::frames::VisibilityBlock;
use crate::units::{ChannelId, MissionTime, Pair};

/// Summary of one packet of visibilities, as received.
#[derive(Clone, Copy, Debug, Default, PartialEq, Encode, Decode)]
pub struct JournalEntry {
    /// Count of the packet.
    pub count: u64,
    /// Time at which the packet was made.
    pub made: CucTime,
    /// Channel of the visibilities.
    pub channel: ChannelId,
    /// Pair of the visibilities.
    pub pair: Pair,
    /// Start of the first integration.
    pub start: MissionTime,
    /// End of the last integration.
    pub end: MissionTime,
    /// Number of visibilities.
    pub visibilities: u32,
    /// Total integration time, s.
    pub integration_s: f64,
    /// Sum of the weights of unflagged visibilities, (K sr)^-2.
    pub weight: f64,
}

impl JournalEntry {
    pub(super) fn sent(&self) -> SendingKey {
        (self.made, self.count)
    }

    pub(super) fn new(made: CucTime, count: u64, block: &VisibilityBlock) -> Self {
        let empty = Self { count, made, ..Self::default() };
        let Some(last) = block.len().checked_sub(1) else { return empty };
        let end = i64::from(block.offset_ticks[last]) + i64::from(block.duration_ticks[last]);
        let ticks: u64 = block.duration_ticks.iter().map(|&ticks| u64::from(ticks)).sum();
        let good = block.weight.iter().zip(&block.flags).filter(|(_, flags)| flags.is_good());
        Self {
            channel: block.channel,
            pair: block.pair,
            start: block.start.plus_ticks(i64::from(block.offset_ticks[0])),
            end: block.start.plus_ticks(end),
            visibilities: block.len() as u32,
            integration_s: ticks as f64 * 1e-6,
            weight: good.map(|(&weight, _)| f64::from(weight)).sum(),
            ..empty
        }
    }
}
