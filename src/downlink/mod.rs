//! The bytes between the spacecraft and the ground, in four modules:
//!
//! | module | holds | may use |
//! |---|---|---|
//! | [`wire`] | the format: payloads, packets, coded frames, and their encoders | `frames`, `units` |
//! | [`receive`] | bytes back to packets and ground frames, with counts of what is missing or damaged | `wire` |
//! | [`transport`] | files, sockets and the pace of a replay | `wire`, `receive`, `runtime` |
//! | [`link`] | a simulated link with faults, and the truth about them | `wire`, `receive` |
//!
//! Nothing but these bytes passes from the spacecraft to the ground. Bad data is counted; it is never an error.
//!
//! # Layers
//! From the payload down; neighbouring layers exchange only bytes.
//!
//! | layer | standard | here |
//! |---|---|---|
//! | payload: records and arrays | none: our own, versioned | `wire::payload` |
//! | space packet, time code | CCSDS 133.0-B, 301.0-B | [`Packetizer`], [`PacketReceiver`] |
//! | transfer frame, Reed-Solomon, randomizer, sync marker | CCSDS 732.0-B, 131.0-B | [`wire::cadu`], [`receive::cadu`] |
//! | either format | | [`Transmission`], [`DownlinkReceiver`] |
//! | every packet once, across files and sessions | | [`crate::ground::Collector`] |
//! | file | | [`DownlinkWriter`], [`DownlinkReader`], [`Contents`] |
//! | socket | | [`transport::socket`] |
//!
//! The frame layer takes the bytes that [`Packetizer::encode`] appends and passes recovered packets to
//! [`PacketReceiver::push`]. It adds and removes idle packets itself.
//!
//! # A packet
//! | byte | field | |
//! |---|---|---|
//! | 0-5 | primary header | telemetry, secondary header present, APID of the [`PacketKind`]; segmentation flags, low 14 bits of the packet count; length |
//! | 6-13 | secondary header | CUC time, P-field 0x1F: TAI since 1958-01-01, 4 + 3 bytes; the creation time of the packet, which never decreases |
//! | 14 | magic | 0x4C |
//! | 15 | version | [`FORMAT_VERSION`] |
//! | 16-19 | packet count, bits 14-45 | the count of 46 bits never wraps, so a gap is never ambiguous |
//! | 20-21 | header checksum | CRC-16 (0x1021, start 0xFFFF) of bytes 0-19 |
//! | 22.. | payload, or a segment of it | |
//! | last 4 | packet checksum | CRC-32C of everything before it, big-endian |
//!
//! Headers are big-endian as in CCSDS, payloads little-endian. A payload is a bincode-2 record of fixed width,
//! followed by raw arrays:
//!
//! | kind | record | arrays |
//! |---|---|---|
//! | instrument | name (u64 length, UTF-8), epoch_tai_s f64, moon_radius_m f64, satellites u8, response u8 (plus 128 without thermal noise), seed u64, configuration_hash u64, channels u16 | channels x (frequency_hz, width_hz) f64; with a spectrometer also low_hz, width_hz, channels f64 |
//! | ephemeris | start_ticks i64, step_ticks u32, satellites u8, nodes u32 | nodes x satellites x 3 positions f64, m |
//! | visibilities | channel u16, i u8, j u8, start_ticks i64, count u32 | count each: offset_ticks u32, duration_ticks u32, value (re, im) f32 x 2, weight f32, flags u8 |
//! | housekeeping | time_ticks i64, sampled u64, dropped u64 | |
//!
//! A pass begins, after the instrument description, and ends with a report of the spacecraft's counts (housekeeping). Both
//! reports are equal, so a truncated pass still tells how much it held. The reports of the last pass are valid until
//! 2^32 s, the end of the time range: a ledger is complete only with one of them. Files of earlier versions have a report
//! only at the end of each pass, and no final report.
//!
//! Each packet of visibilities can be decoded alone. Other payloads are segmented if they exceed a packet.
//!
//! The header has its own checksum, so a damaged packet can be told from noise, and its kind, time and count are known.

mod config;
pub(crate) mod error;
pub mod link;
#[doc(hidden)]
pub mod receive;
#[doc(hidden)]
pub mod transport;
#[doc(hidden)]
pub mod wire;

pub use config::DownlinkConfig;
pub use error::DownlinkError;
pub use receive::ReceptionCounters;
pub use receive::inspect::Contents;
#[doc(hidden)]
pub use receive::{Decoder, DownlinkReceiver, Era, Event, PacketReceiver, ReceivedSet};
pub use transport::{DownlinkReader, DownlinkWriter, FileSource};
#[doc(hidden)]
pub use transport::{Pace, PacedSource, Recorder, Steps, Transmitter};
#[doc(hidden)]
pub use wire::{
    CucTime, FORMAT_VERSION, Format, HEADER_BYTES, PACKET_BYTES_MAX, PacketHeader, PacketKind, PacketSegment,
    Packetizer, TRAILER_BYTES, Transmission,
};
