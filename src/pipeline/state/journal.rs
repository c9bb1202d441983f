//! A line on every block of visibilities that has been received.

use bincode::{Decode, Encode};

use crate::downlink::{CucTime, PacketHeader};
use crate::frames::VisibilityBlock;
use crate::units::{ChannelId, MissionTime, Pair};

/// What one packet of visibilities held, as it was received.
#[derive(Clone, Copy, Debug, PartialEq, Encode, Decode)]
pub struct JournalEntry {
    /// Count of the packet.
    pub count: u64,
    /// Time at which the packet was made.
    pub made: CucTime,
    /// Channel.
    pub channel: ChannelId,
    /// Pair.
    pub pair: Pair,
    /// Beginning of the first integration.
    pub start: MissionTime,
    /// End of the last integration.
    pub end: MissionTime,
    /// Visibilities.
    pub visibilities: u32,
    /// Their integration time, s.
    pub integration_s: f64,
    /// Sum of the weights of the good ones, (K sr)^-2.
    pub weight: f64,
}

impl JournalEntry {
    /// The line on a block; `None` if it is empty.
    pub(super) fn of(header: PacketHeader, block: &VisibilityBlock) -> Option<Self> {
        let last = block.len().checked_sub(1)?;
        let end = i64::from(block.offset_ticks[last]) + i64::from(block.duration_ticks[last]);
        let ticks: u64 = block.duration_ticks.iter().map(|&ticks| u64::from(ticks)).sum();
        let good = block.weight.iter().zip(&block.flags).filter(|(_, flags)| flags.is_good());
        Some(Self {
            count: header.count,
            made: header.time,
            channel: block.channel,
            pair: block.pair,
            start: block.start.plus_ticks(i64::from(block.offset_ticks[0])),
            end: block.start.plus_ticks(end),
            visibilities: block.len() as u32,
            integration_s: ticks as f64 * 1e-6,
            weight: good.map(|(&weight, _)| f64::from(weight)).sum(),
        })
    }
}
