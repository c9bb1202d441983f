//! Errors of a downlink as a whole. Bad data in a stream is counted instead.

mod payload;
mod socket;

use std::io;
use std::path::PathBuf;

pub use payload::PayloadFault;
pub use socket::SocketError;
use thiserror::Error;

use crate::units::InvalidValue;

/// Why a downlink cannot be written or read.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum DownlinkError {
    /// A configuration value is not accepted.
    #[error(transparent)]
    Invalid(#[from] InvalidValue),
    /// A frame precedes the instrument description, which sets the epoch of the time codes.
    #[error("a frame was to be sent before the instrument description; send the description first")]
    NoInstrument,
    /// The ground would refuse the frame.
    #[error("invalid frame: {0}")]
    Frame(#[from] PayloadFault),
    /// The packets' time code cannot express a time.
    #[error(
        "{time_s} s after the mission epoch lies outside 1958-2094, which the packets' time code covers; \
             correct the epoch (epoch_tai_s = {epoch_tai_s})"
    )]
    Time {
        /// Mission epoch, TAI seconds since 1958.
        epoch_tai_s: f64,
        /// Mission time, s.
        time_s: f64,
    },
    /// The operating system reported an error.
    #[error("{}: cannot {action}: {source}", path.display())]
    Io {
        /// The file.
        path: PathBuf,
        /// The attempted action.
        action: &'static str,
        /// The system's error.
        source: io::Error,
    },
    /// The file is empty.
    #[error("{}: the file is empty; expected CCSDS space packets, as `lunarray simulate` writes them", path.display())]
    EmptyFile {
        /// The file.
        path: PathBuf,
    },
    /// The stream describes a second instrument.
    #[error(
        "at byte {offset} of the packets: the description of another instrument than before; expected packets of one \
        instrument in a replay and in a state"
    )]
    OtherInstrument {
        /// Offset in the stream, bytes.
        offset: u64,
    },
    /// Two states contain the same packet.
    #[error(
        "the packet with APID {apid:#x} and count {count} is in the sums of both; expected states without common packets: \
         replay the files of one into the other instead"
    )]
    DuplicatePacket {
        /// Application process identifier.
        apid: u16,
        /// Packet count.
        count: u64,
    },
    /// An error of a socket.
    #[error(transparent)]
    Socket(#[from] SocketError),
    /// The input of the link simulator is damaged already.
    #[error(
        "at byte {offset}: no valid frame or packet; expected an undamaged downlink, as `lunarray simulate` writes it"
    )]
    DamagedInput {
        /// Offset in the downlink, bytes.
        offset: u64,
    },
    /// An error that concerns a file.
    #[error("{}: {source}", path.display())]
    At {
        /// The file.
        path: PathBuf,
        /// The error.
        source: Box<DownlinkError>,
    },
    /// The inputs differ in format, and one of them cannot be read twice.
    #[error(
        "{} and {} have different formats (packets and coded frames), and one of them, such as a pipe, can be read only once; expected \
         regular files, or a single format",
        other.display(), path.display()
    )]
    MixedFormats {
        /// The file.
        path: PathBuf,
        /// An earlier file, of the other format.
        other: PathBuf,
    },
    /// A followed file was removed, truncated or replaced.
    #[error(
        "{}: the file was removed, truncated or replaced after {read} bytes had been read; expected it to grow. Replay \
         the new content into the same --state",
        path.display()
    )]
    Replaced {
        /// The file.
        path: PathBuf,
        /// Bytes that had been read.
        read: u64,
    },
    /// A followed file is compressed.
    #[error("{}: a compressed file (gzip, zstd) cannot be followed as it grows; expected a complete file without --follow", path.display())]
    Compressed {
        /// The file.
        path: PathBuf,
    },
    /// The file contains no downlink packet.
    #[error(
        "{}: no downlink in {bytes} bytes: {}; expected CCSDS space packets with APIDs 0x101 to \
         0x105 and CUC times (P-field 0x1F), plain or in CADUs of AOS frames, as `lunarray simulate` writes them",
        path.display(), format.as_deref().unwrap_or("no packet was found")
    )]
    NotADownlink {
        /// The file.
        path: PathBuf,
        /// Bytes read.
        bytes: u64,
        /// The detected format, if it is known.
        format: Option<String>,
    },
}

impl DownlinkError {
    pub(crate) fn at(self, path: &std::path::Path) -> Self {
        Self::At { path: path.to_owned(), source: Box::new(self) }
    }
}

/// Requires a packet in a file of `bytes` bytes; `detect_format` gives the format for the error.
pub(crate) fn require_packets(
    path: &std::path::Path,
    bytes: u64,
    packets: u64,
    detect_format: impl FnOnce() -> Option<String>,
) -> Result<(), DownlinkError> {
    match (bytes, packets) {
        (0, _) => Err(DownlinkError::EmptyFile { path: path.to_owned() }),
        (_, 0) => Err(DownlinkError::NotADownlink { path: path.to_owned(), bytes, format: detect_format() }),
        _ => Ok(()),
    }
}

/// Converts an error of the operating system on a file.
pub(crate) fn io_error(
    path: &std::path::Path,
    action: &'static str,
) -> impl FnOnce(io::Error) -> DownlinkError {
    let path = path.to_owned();
    move |source| DownlinkError::Io { path, action, source }
}
