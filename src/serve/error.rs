//! What may go wrong with the server.

use thiserror::Error;

/// The server cannot start.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum ServeError {
    /// An address that cannot be read.
    #[error("address `{text}`; expected PORT or HOST:PORT, such as 8080 or 127.0.0.1:8080")]
    Address {
        /// What was given.
        text: String,
    },
    /// An address that has no numbers.
    #[error("cannot find the address of {address}")]
    Resolve {
        /// The address.
        address: String,
        /// Why.
        source: std::io::Error,
    },
    /// Other machines could reach it.
    #[error(
        "{address} can be reached by other machines; expected an address of this machine, such as 127.0.0.1, or --serve-remote to allow it"
    )]
    Remote {
        /// The address.
        address: String,
    },
    /// The address cannot be had.
    #[error("cannot serve on {address}; is its port in use? Port 0 chooses a free one")]
    Bind {
        /// The address.
        address: String,
        /// What the system says.
        source: std::io::Error,
    },
    /// No thread or event loop.
    #[error("cannot start the server's thread")]
    Start {
        /// What the system says.
        source: std::io::Error,
    },
}
