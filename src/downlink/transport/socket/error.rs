//! What can go wrong with a socket as a whole; what senders do wrong is counted instead.

use std::io;

use thiserror::Error;

use super::url::TcpUrl;

/// Why there is no listening or sending.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum SocketError {
    /// A place that is none.
    #[error("{text:?}: expected tcp://HOST:PORT, such as tcp://127.0.0.1:4711 or tcp://[::1]:4711")]
    Url {
        /// What was given.
        text: String,
    },
    /// A host without an address.
    #[error("{url}: the host has no address: {source}")]
    Resolve {
        /// The place.
        url: TcpUrl,
        /// What the system said.
        source: io::Error,
    },
    /// An address that other machines can reach.
    #[error(
        "{url}: other machines may reach this address, and whoever connects can add to the maps; expected \
         127.0.0.1, [::1] or localhost, or --allow-remote"
    )]
    Remote {
        /// The place.
        url: TcpUrl,
    },
    /// No listening.
    #[error("cannot listen on {url}: {source}")]
    Listen {
        /// The place.
        url: TcpUrl,
        /// What the system said.
        source: io::Error,
    },
    /// No event loop.
    #[error("cannot start the listener: {source}")]
    Start {
        /// What the system said.
        source: io::Error,
    },
    /// The listener's thread fell.
    #[error("the listener has ended by itself, which is a bug of the program")]
    Fallen,
    /// Nobody listens.
    #[error(
        "{url}: no connection within {waited_s} s: {source}; start `lunarray replay --listen {url}` first, or wait \
         longer (--connect-s)"
    )]
    Connect {
        /// The place.
        url: TcpUrl,
        /// How long it was tried, s.
        waited_s: f64,
        /// What the system said last.
        source: io::Error,
    },
    /// The other side has had enough.
    #[error("{url}: the receiver closed the connection; {bytes} bytes had been sent: {reason}")]
    Closed {
        /// The place.
        url: TcpUrl,
        /// Bytes handed to the system until then.
        bytes: u64,
        /// What it said, or what the system said.
        reason: String,
    },
    /// Faults of a link whose truth has no place.
    #[error(
        "downlink.link has faults, and their truth goes beside the downlink file; name one with --out FILE"
    )]
    TruthNowhere,
}
