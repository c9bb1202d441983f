//! Bytes to packets and frames: synchronisation, decoding, and the count of what is missing or damaged.

pub mod cadu;
pub mod contents;
mod counters;
mod decoder;
mod intake;
mod received_set;
mod receiver;
mod sequence;

pub use counters::{FaultCounts, FaultKind, KindCounts, PacketReading, PayloadOutcome, ReceptionCounters};
pub use decoder::{Decoder, DecoderState};
pub use intake::Intake;
pub use received_set::{Era, ReceivedSet};
pub use receiver::{Event, Packet, Receiver};
