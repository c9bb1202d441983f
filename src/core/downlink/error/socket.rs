//! Errors of a socket as a whole. Faults of single senders are counted instead.

use std::io;
use std::path::PathBuf;

use thiserror::Error;

/// Why listening or sending failed.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum SocketError {
    /// The text is not the URL of a socket.
    #[error(
        "{text:?}: expected tcp://HOST:PORT, such as tcp://127.0.0.1:4711 or tcp://[::1]:4711; `replay --listen` also takes udp://HOST:PORT"
    )]
    Url {
        /// The text.
        text: String,
    },
    /// The host has no address.
    #[error("{url}: the host has no address: {source}")]
    Resolve {
        /// The URL.
        url: String,
        /// The system's error.
        source: io::Error,
    },
    /// Other machines can reach the address.
    #[error(
        "{address}: other machines may reach this address, and whoever connects can add to the maps; expected \
         127.0.0.1, [::1] or localhost, or --allow-remote"
    )]
    Remote {
        /// Host and port.
        address: String,
    },
    /// The address cannot be bound.
    #[error("cannot listen on {url}: {source}")]
    Listen {
        /// The URL.
        url: String,
        /// The system's error.
        source: io::Error,
    },
    /// The event loop cannot start.
    #[error("cannot start the listener: {source}")]
    Start {
        /// The system's error.
        source: io::Error,
    },
    /// The listener's thread panicked.
    #[error("the listener stopped unexpectedly, which is a bug in the program")]
    Panicked,
    /// No connection could be made.
    #[error(
        "{url}: no connection within {waited_s} s: {source}; start `lunarray replay --listen {url}` first, or wait \
         longer (--connect-s)"
    )]
    Connect {
        /// The URL.
        url: String,
        /// Time spent trying, s.
        waited_s: f64,
        /// The last error of the system.
        source: io::Error,
    },
    /// The receiver closed the connection.
    #[error("{url}: the receiver closed the connection after {bytes} bytes: {reason}")]
    Closed {
        /// The URL.
        url: String,
        /// Number of bytes sent.
        bytes: u64,
        /// The receiver's answer, or the system's error.
        reason: String,
    },
    /// The file of stations and their tokens is invalid.
    #[error("stations {}: {found}", path.display())]
    Stations {
        /// The file.
        path: PathBuf,
        /// What is wrong, and what was expected.
        found: String,
    },
    /// The link has faults, but there is no downlink file beside which the truth can be written.
    #[error(
        "downlink.link has faults, and their truth is written beside the downlink file; give one with --out FILE"
    )]
    NoTruthFile,
}
