//! A link that does what links do: wrong bits, bursts, losses, doubles, disorder, cuts. Seeded.
//!
//! It takes a sound downlink of either format, and tells the truth about what it did: what cannot be recovered any
//! more, by frame and by packet, whatever the receiver is like. The ground can be held to that.

mod bit_writer;
mod config;
mod file;
mod noise;
mod simulator;
mod splitter;
mod truth;

pub use config::LinkConfig;
pub use file::{LinkStage, corrupt, truth_path};
pub use simulator::LinkSimulator;
pub use truth::{FrameFate, LinkTruth, LostFrames, PacketRange};
