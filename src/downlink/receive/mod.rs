//! Bytes to packets and frames: synchronisation, decoding, and the count of what is missing or damaged.

pub mod cadu;
pub mod contents;
mod counters;
mod decoder;
mod intake;
mod receiver;
mod sequence;
mod taken;

pub use counters::{FaultCounts, KindCounts, ReceptionCounters};
pub use decoder::{Decoder, DecoderState};
pub use intake::Intake;
pub use receiver::{Event, Packet, Receiver};
pub use taken::{Era, Taken};
