//! The format on the link and its encoders: payloads, space packets, coded transfer frames.
//!
//! | layer | encoder |
//! |---|---|
//! | payload | `payload` |
//! | space packet | [`Packetizer`] |
//! | coded frame | [`cadu::CaduEncoder`] |
//! | either format | [`Transmission`] |
//!
//! Uses `frames` and `units`. The same ground frames give the same bytes, which a file in `fixtures/` checks. The tables
//! of the format are in [`crate::downlink`] and [`cadu`].

pub mod cadu;
mod cuc;
mod header;
mod kind;
mod packetizer;
pub(crate) mod payload;
mod transmission;

pub use super::config::{Format, PACKET_BYTES_MAX};
pub use super::error::PayloadFault;
pub use cuc::CucTime;
pub use header::{COUNT_MAX, FORMAT_VERSION, HEADER_BYTES, PacketHeader, PacketSegment, TRAILER_BYTES};
pub(crate) use header::{has_valid_checksum, packet_checksum};
pub use kind::{APID_BASE, PacketKind};
pub use packetizer::Packetizer;
pub use payload::{NODES_MIN, VisibilitiesOutline};
pub use transmission::Transmission;
