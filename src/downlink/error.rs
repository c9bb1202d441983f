//! Errors of a downlink as a whole. Bad data in a stream is counted instead.

use std::io;
use std::path::PathBuf;

use thiserror::Error;

use super::wire::payload::PayloadFault;
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
    #[error("{}: the file is empty; expected CCSDS space packets as `lunarray simulate` writes them", path.display())]
    Empty {
        /// The file.
        path: PathBuf,
    },
    /// The stream describes a second instrument.
    #[error(
        "at byte {offset} of the packets: the description of another instrument than that of the packets before it; \
        expected one mission per replay and state"
    )]
    OtherInstrument {
        /// Offset in the stream, bytes.
        offset: u64,
    },
    /// Two states hold the same visibilities.
    #[error(
        "the packet of APID {apid:#x} and count {count} is in the sums of both; expected states of different packets: \
         replay the files of one into the other"
    )]
    TakenTwice {
        /// Application process identifier.
        apid: u16,
        /// Packet count.
        count: u64,
    },
    /// An error of a socket.
    #[error(transparent)]
    Socket(#[from] crate::downlink::transport::socket::SocketError),
    /// The input of the link simulator is damaged already.
    #[error(
        "at byte {offset}: no sound frame or packet; expected an undamaged downlink, as `lunarray simulate` writes it"
    )]
    Unsound {
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
    /// The files differ in format.
    #[error(
        "{} and {} are of different formats (packets, and coded frames of packets), and one is no file that can be read twice; expected \
         files, or one format",
        other.display(), path.display()
    )]
    Mixed {
        /// The file.
        path: PathBuf,
        /// An earlier file, of the other format.
        other: PathBuf,
    },
    /// A followed file was removed, truncated or replaced.
    #[error(
        "{}: after {read} bytes of it were read, the file was removed, cut short or replaced by another; expected it to \
         grow. Replay what is there now beside what was there, with --state",
        path.display()
    )]
    Replaced {
        /// The file.
        path: PathBuf,
        /// Bytes that had been read.
        read: u64,
    },
    /// A followed file is packed.
    #[error("{}: a packed file (gzip, zstd) cannot be followed as it grows; expected one that is complete, without --follow", path.display())]
    Packed {
        /// The file.
        path: PathBuf,
    },
    /// Input and output are the same file.
    #[error("{}: input and output are the same file; expected another output file", path.display())]
    SameFile {
        /// The file.
        path: PathBuf,
    },
    /// The file holds no downlink packet.
    #[error(
        "{}: no downlink in {bytes} bytes: {}; expected CCSDS space packets with APIDs 0x101 to \
         0x105 and CUC times (P-field 0x1F), plain or in CADUs of AOS frames, as `lunarray simulate` writes them",
        path.display(), name.as_deref().unwrap_or("no packet that could be one of it")
    )]
    Foreign {
        /// The file.
        path: PathBuf,
        /// Bytes read of it.
        bytes: u64,
        /// What it is, if that is known.
        name: Option<String>,
    },
}

impl DownlinkError {
    /// Adds the file that the error concerns.
    pub(crate) fn at(self, path: &std::path::Path) -> Self {
        Self::At { path: path.to_owned(), source: Box::new(self) }
    }
}

/// Requires that a file of `bytes` bytes held a packet; otherwise `name` gives its kind.
pub(crate) fn require_packets(
    path: &std::path::Path,
    bytes: u64,
    packets: u64,
    name: impl FnOnce() -> Option<String>,
) -> Result<(), DownlinkError> {
    match (bytes, packets) {
        (0, _) => Err(DownlinkError::Empty { path: path.to_owned() }),
        (_, 0) => Err(DownlinkError::Foreign { path: path.to_owned(), bytes, name: name() }),
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
