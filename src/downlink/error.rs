//! What can go wrong with a downlink as a whole; bad data in it is counted instead.

use std::io;
use std::path::PathBuf;

use thiserror::Error;

use super::wire::payload::PayloadFault;
use crate::units::InvalidValue;

/// Why a downlink cannot be written or read.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum DownlinkError {
    /// A value of the configuration that is not accepted.
    #[error(transparent)]
    Invalid(#[from] InvalidValue),
    /// A frame was to be sent before the instrument description, which gives the time codes their epoch.
    #[error("a frame was to be sent before the instrument description; send that one first")]
    NoInstrument,
    /// A frame that the ground would refuse.
    #[error("a frame cannot be sent: {0}")]
    Frame(#[from] PayloadFault),
    /// A time that the packets' time code cannot express.
    #[error(
        "{time_s} s after the mission epoch lies outside 1958-2094, which the packets' time code covers; \
             mend the epoch (epoch_tai_s = {epoch_tai_s})"
    )]
    Time {
        /// Mission epoch, TAI seconds since 1958.
        epoch_tai_s: f64,
        /// Mission time, s.
        time_s: f64,
    },
    /// The operating system refused.
    #[error("{}: cannot {action}: {source}", path.display())]
    Io {
        /// The file.
        path: PathBuf,
        /// What was tried.
        action: &'static str,
        /// What the system said.
        source: io::Error,
    },
    /// A file without a single byte.
    #[error("{}: the file is empty; expected CCSDS space packets as `lunarray simulate` writes them", path.display())]
    Empty {
        /// The file.
        path: PathBuf,
    },
    /// Packets of another mission among those of one.
    #[error(
        "at byte {offset} of the packets: the description of another instrument than that of the packets before it; \
         expected one mission a replay, and a state"
    )]
    OtherInstrument {
        /// Place in the stream.
        offset: u64,
    },
    /// States that hold the same visibilities.
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
    /// A socket.
    #[error(transparent)]
    Socket(#[from] crate::downlink::transport::socket::SocketError),
    /// A downlink that was to be damaged and already is.
    #[error(
        "at byte {offset}: no sound frame or packet; expected a whole downlink, as `lunarray simulate` writes it"
    )]
    Unsound {
        /// Place in it.
        offset: u64,
    },
    /// What is wrong with a file.
    #[error("{}: {source}", path.display())]
    At {
        /// The file.
        path: PathBuf,
        /// What is wrong.
        source: Box<DownlinkError>,
    },
    /// Files of both formats together.
    #[error(
        "{} and {} are of different formats (packets, and coded frames of packets); replay them apart",
        other.display(), path.display()
    )]
    Mixed {
        /// The file.
        path: PathBuf,
        /// One before it, of the other format.
        other: PathBuf,
    },
    /// A followed file that is not what it was.
    #[error(
        "{}: after {read} bytes of it were read, the file was removed, cut short or replaced by another; expected it to \
         grow. Replay what is there now beside what was there, with --state",
        path.display()
    )]
    Replaced {
        /// The file.
        path: PathBuf,
        /// Bytes of it that were read.
        read: u64,
    },
    /// A file that would be written over while it is read.
    #[error("{}: this is the file that is read; expected another place for what is written", path.display())]
    SameFile {
        /// The file.
        path: PathBuf,
    },
    /// A file in which nothing of ours was found.
    #[error(
        "{}: not one downlink packet in {bytes} bytes; expected CCSDS space packets with APIDs 0x101 to \
         0x105 and CUC times (P-field 0x1F), plain or in CADUs of AOS frames, as `lunarray simulate` writes them",
        path.display()
    )]
    Foreign {
        /// The file.
        path: PathBuf,
        /// Its length.
        bytes: u64,
    },
}

impl DownlinkError {
    /// The error with the file that it is about.
    pub(crate) fn at(self, path: &std::path::Path) -> Self {
        Self::At { path: path.to_owned(), source: Box::new(self) }
    }
}

/// An error for a file of so many bytes if there was no packet in it.
pub(crate) fn require_packets(path: &std::path::Path, bytes: u64, packets: u64) -> Result<(), DownlinkError> {
    match (bytes, packets) {
        (0, _) => Err(DownlinkError::Empty { path: path.to_owned() }),
        (_, 0) => Err(DownlinkError::Foreign { path: path.to_owned(), bytes }),
        _ => Ok(()),
    }
}

/// An error of the operating system on a file.
pub(crate) fn io_error(
    path: &std::path::Path,
    action: &'static str,
) -> impl FnOnce(io::Error) -> DownlinkError {
    let path = path.to_owned();
    move |source| DownlinkError::Io { path, action, source }
}
