//! The bytes on the link, and how they are made: payloads, space packets, coded transfer frames.

pub mod cadu;
mod cuc;
mod format;
mod header;
mod kind;
mod packetizer;
pub(crate) mod payload;
mod transmission;

pub use cuc::CucTime;
pub use format::Format;
pub(crate) use header::{COUNT_MAX, packet_check, packet_holds};
pub use header::{
    FORMAT_VERSION, HEADER_BYTES, PACKET_BYTES_MAX, PacketHeader, PacketSegment, TRAILER_BYTES,
};
pub use kind::{APID_BASE, Kind};
pub use packetizer::Packetizer;
pub use payload::{NODES_MIN, PayloadFault};
pub use transmission::Transmission;
