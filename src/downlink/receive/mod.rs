//! Bytes to packets and ground frames: synchronisation, error correction, decoding, and counts of what is missing or
//! damaged.
//!
//! | layer | here |
//! |---|---|
//! | coded frames to packets | [`cadu::CaduReceiver`] |
//! | bytes to packets, gaps and damage | [`PacketReceiver`] |
//! | either format, detected | [`DownlinkReceiver`], [`EventReader`] |
//! | packets to ground frames | [`Decoder`] |
//! | a file, packed or not, to bytes | [`DownlinkFile`] |
//! | a whole file for people | [`inspect`] |
//!
//! Uses `wire` and `frames`. Receivers accept any bytes in chunks of any size, in bounded memory and linear time, and
//! never fail on bad data: every byte of a stream belongs to exactly one [`Event`], and every packet is counted once.

pub mod cadu;
mod counters;
mod decoder;
mod downlink_file;
mod downlink_receiver;
mod event_reader;
mod foreign;
pub mod inspect;
mod listing;
mod received_set;
mod receiver;
mod sequence;

pub use counters::{FaultCounts, FaultKind, KindCounts, PacketOutcome, PayloadOutcome, ReceptionCounters};
pub use decoder::{Decoder, DecoderState};
pub use downlink_file::DownlinkFile;
pub use downlink_receiver::DownlinkReceiver;
pub use event_reader::{ByteFeed, EventReader};
pub use listing::{LISTED_MAX, Listing};
pub use received_set::{Era, PacketInsertion, ReceivedSet};
pub use receiver::{Event, Packet, PacketReceiver};
