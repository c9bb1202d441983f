//! How a downlink travels: files, sockets, and the pace of a replay.

mod file;
mod pace;
pub mod socket;
mod stages;

pub use file::{DownlinkReader, DownlinkWriter};
pub use pace::{Pace, Paced, Steps};
pub use stages::{FileSource, Recorder, Transmitter};
