//! The bytes between the spacecraft and the ground.
//!
//! Layers, from the payload down; every layer takes bytes from its neighbour and knows nothing of it:
//!
//! | layer | standard | here |
//! |---|---|---|
//! | payload: records and arrays | own, versioned | `payload` |
//! | space packet, time code | CCSDS 133.0-B, 301.0-B | [`Packetizer`], [`Receiver`] |
//! | transfer frame, Reed-Solomon, randomizer, sync marker | CCSDS 732.0-B, 131.0-B | [`cadu`] |
//! | either of the two | | [`Intake`] |
//! | every packet once, in order, across files and sessions | | [`crate::ground::Collector`] |
//! | file | | [`DownlinkWriter`], [`DownlinkReader`], [`Contents`] |
//! | socket | | [`socket`] |
//!
//! The frame layer takes the bytes that [`Packetizer::encode`] appends and hands what it recovers to
//! [`Receiver::push`]. Idle packets are its own affair and never reach the receiver.
//!
//! # A packet
//! | byte | field | |
//! |---|---|---|
//! | 0-5 | primary header | telemetry, secondary header present, APID of the [`Kind`]; segmentation flags, low 14 bits of the packet count; length |
//! | 6-13 | secondary header | CUC time, P-field 0x1F: TAI since 1958-01-01, 4 + 3 bytes; the time at which the packet was made: it never goes back |
//! | 14 | magic | 0x4C |
//! | 15 | version | [`FORMAT_VERSION`] |
//! | 16-19 | packet count, bits 14-45 | the count of 46 bits never wraps, so a gap is never ambiguous |
//! | 20-21 | header check | CRC-16 (0x1021, start 0xFFFF) of bytes 0-19 |
//! | 22.. | payload, or a segment of it | |
//! | last 4 | packet check | CRC-32C of everything before it, big-endian |
//!
//! Headers are big-endian as CCSDS has them, payloads little-endian. A payload is a bincode-2 record of fixed
//! width, followed by raw arrays:
//!
//! | kind | record | arrays |
//! |---|---|---|
//! | instrument | name (u64 length, UTF-8), epoch_tai_s f64, moon_radius_m f64, satellites u8, response u8, seed u64, configuration_hash u64, channels u16 | channels x (frequency_hz, width_hz) f64 |
//! | ephemeris | start_ticks i64, step_ticks u32, satellites u8, nodes u32 | nodes x satellites x 3 positions f64, m |
//! | visibilities | channel u16, i u8, j u8, start_ticks i64, count u32 | count each: offset_ticks u32, duration_ticks u32, value (re, im) f32 x 2, weight f32, flags u8 |
//! | housekeeping | time_ticks i64, sampled u64, dropped u64 | |
//!
//! A packet of visibilities stands for itself; other payloads are segmented when they exceed a packet.
//!
//! The header has a check of its own so that a damaged packet can still be told from noise, and its loss
//! given a kind, a time and a count.

mod config;
pub(crate) mod error;
pub mod link;
pub mod receive;
pub mod transport;
pub mod wire;

pub use config::DownlinkConfig;
pub use error::DownlinkError;
pub use link::LinkConfig;
pub use receive::contents::{self, Contents};
pub use receive::{
    Decoder, DecoderState, Era, Event, FaultCounts, Intake, KindCounts, Packet, ReceivedSet, Receiver,
    ReceptionCounters,
};
pub use transport::{
    DownlinkReader, DownlinkWriter, FileSource, Pace, Paced, Recorder, Steps, Transmitter, socket,
};
pub use wire::{
    APID_BASE, CucTime, FORMAT_VERSION, Format, HEADER_BYTES, Kind, NODES_MIN, PACKET_BYTES_MAX,
    PacketHeader, Packetizer, PayloadFault, Segment, TRAILER_BYTES, Transmission, cadu,
};
