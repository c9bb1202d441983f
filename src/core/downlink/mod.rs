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
//! `docs/packets.md` specifies packets and their payloads to the byte. Each packet of visibilities can be decoded alone; other
//! payloads are segmented if they exceed a packet. The packet count has 46 bits and never wraps, so a gap is never ambiguous.
//! The header has its own checksum, so the kind, time and count of a damaged packet are known.
//!
//! A pass begins, after the instrument description, and ends with a report of the spacecraft's counts (housekeeping). Both
//! reports are equal, so a truncated pass still tells how much it held. The reports of the last pass are valid until 2^32 s,
//! the end of the time range: a ledger is complete only with one of them.

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
    COUNT_MAX, CucTime, FORMAT_VERSION, Format, HEADER_BYTES, PACKET_BYTES_MAX, PacketHeader, PacketKind,
    PacketSegment, Packetizer, TRAILER_BYTES, Transmission,
};
