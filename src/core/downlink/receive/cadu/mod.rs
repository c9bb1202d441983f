//! Reception of coded transfer frames: synchronisation at any bit, error correction, packet assembly.

mod assembler;
mod counters;
mod receiver;

pub use counters::{ChannelCounts, FrameCounters};
pub use receiver::CaduReceiver;
