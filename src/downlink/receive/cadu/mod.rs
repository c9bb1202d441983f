//! Coded transfer frames to packets: the sync marker found at any bit, codewords corrected, packets put together.

mod assembler;
mod counters;
mod receiver;

pub use counters::{ChannelCounts, FrameCounters};
pub use receiver::CaduReceiver;
