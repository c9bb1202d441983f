//! Errors of the server.

use thiserror::Error;

/// Errors that prevent the server from starting.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum ServeError {
    /// An address that cannot be parsed.
    #[error("address `{text}`; expected PORT or HOST:PORT, such as 8080 or 127.0.0.1:8080")]
    Address {
        /// The given text.
        text: String,
    },
    /// A host name that cannot be resolved.
    #[error("cannot find the address of {address}")]
    Resolve {
        /// The address.
        address: String,
        /// The system's error.
        source: std::io::Error,
    },
    /// Other machines could reach the address.
    #[error(
        "{address} can be reached by other machines; expected an address of this machine, such as 127.0.0.1, or --serve-remote to allow it"
    )]
    Remote {
        /// The address.
        address: String,
    },
    /// The server cannot listen on the address.
    #[error("cannot serve on {address}; is its port in use? Port 0 chooses a free one")]
    Bind {
        /// The address.
        address: String,
        /// The system's error.
        source: std::io::Error,
    },
    /// The thread or the event loop cannot be started.
    #[error("cannot start the server's thread")]
    Start {
        /// The system's error.
        source: std::io::Error,
    },
}
