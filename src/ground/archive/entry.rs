//! What a packet of visibilities held: the part of a journal record that is known before it is applied.

use bincode::{Decode, Encode};

use crate::downlink::CucTime;
use crate::frames::VisibilityBlock;
use crate::ground::hold_buffer::Sent;
use crate::units::{ChannelId, MissionTime, Pair};

/// Content of one packet of visibilities, as received.
#[derive(Clone, Copy, Debug, Default, PartialEq, Encode, Decode)]
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
    /// Place in the order of sending.
    pub(super) fn sent(&self) -> Sent {
        (self.made, self.count)
    }

    /// The entry of a packet with a block of visibilities.
    pub(super) fn of(made: CucTime, count: u64, block: &VisibilityBlock) -> Self {
        let nothing = Self { count, made, ..Self::default() };
        let Some(last) = block.len().checked_sub(1) else { return nothing };
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
            ..nothing
        }
    }
}
