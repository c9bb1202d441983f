//! Reception of a downlink: synchronisation, error correction, decoding, and counts of missing and damaged data.
//!
//! | layer | here |
//! |---|---|
//! | coded frames to packets | [`cadu::CaduReceiver`] |
//! | bytes to packets, gaps and damage | [`PacketReceiver`] |
//! | either format, which is detected | [`DownlinkReceiver`], [`EventReader`] |
//! | packets to ground frames | [`Decoder`] |
//! | packets that have to wait for others | [`HoldBuffer`] |
//! | a file, compressed or not, to bytes | [`DownlinkFile`] |
//! | a file to a summary of its contents | [`inspect`] |
//!
//! Uses `wire` and `frames`. Receivers accept any bytes in chunks of any size, in bounded memory and linear time, and
//! never fail on bad data. Every byte of a stream belongs to exactly one [`Event`], and every packet is counted once.

pub mod cadu;
mod counters;
mod decoder;
mod downlink_file;
mod downlink_receiver;
mod event_reader;
mod format_detection;
mod hold_buffer;
pub mod inspect;
mod listing;
mod packet_receiver;
mod received_set;
mod sequence;

pub use counters::{FaultCounts, FaultKind, KindCounts, PacketOutcome, PayloadOutcome, ReceptionCounters};
pub use decoder::{Decoder, DecoderState};
pub use downlink_file::DownlinkFile;
pub use downlink_receiver::DownlinkReceiver;
pub use event_reader::{ByteFeed, EventReader};
pub(crate) use hold_buffer::SendingKey;
pub use hold_buffer::{HeldPacket, HoldBuffer, IsDue};
pub use listing::{LISTED_MAX, Listing};
pub use packet_receiver::{Event, Packet, PacketReceiver};
pub use received_set::{Era, PacketInsertion, ReceivedSet};
