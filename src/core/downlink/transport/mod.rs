//! Transport of a downlink: stages, files, sockets, and the pace of a replay.
//!
//! - [`Transmitter`] encodes ground frames as bytes; [`Recorder`] writes a byte stream to a file.
//! - [`FileSource`] reads files as a byte stream; [`PacedSource`] releases one at the pace of its packets.
//! - [`DownlinkWriter`] and [`DownlinkReader`] write and read frames outside a pipeline.
//! - [`packet_archive`] keeps packets on disk before they are acknowledged to their sender.
//! - [`socket`] sends a byte stream over TCP, and listens to several senders.
//!
//! Uses `wire`, `receive` and `runtime`. Bytes are not changed. A file under its final name is complete; until then it has
//! the suffix `.partial`.

mod file_source;
mod pace;
pub mod packet_archive;
mod reader;
mod recorder;
pub mod socket;
mod transmitter;
mod writer;

pub use file_source::FileSource;
pub use pace::{Pace, PacedSource, Steps};
pub use reader::DownlinkReader;
pub use recorder::Recorder;
pub use transmitter::Transmitter;
pub use writer::DownlinkWriter;
