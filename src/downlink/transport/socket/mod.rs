//! The downlink over TCP: a ground that listens to several stations at once, and a spacecraft that sends to it.
//!
//! A connection carries the bytes of a downlink file, in either format, and nothing else; so any tool that sends a
//! file over TCP is a station. What the ground does with it:
//!
//! | | where | on |
//! |---|---|---|
//! | accepts, reads, keeps time | `listener`, `connection` | one thread, the only place with an event loop |
//! | finds packets in the bytes of one connection, with a receiver of its own | `line` | a pool, so that hard work for one does not hold up others |
//! | hands whole packets to the chain | [`SocketSource`] | the source's thread |
//!
//! Between the second and the third there is room for so many bytes, given out in the order of asking. Who waits for
//! room does not read: TCP then slows its sender, and no other. Packets of a payload in segments stay together, so
//! that those of two connections never mix.
//!
//! A sender that does not keep to the limits of [`ListenConfig`] is closed, counted by reason and said; the
//! others go on. When a sender has closed its side and everything is handed over, the ground answers with a line of
//! text, `taken N bytes`, and closes.
//!
//! Packets bear no signature: whoever can connect can add to the maps. That is why other addresses than those of the
//! machine itself must be asked for.

mod config;
mod connection;
mod error;
mod listener;
mod report;
mod sender_intake;
mod sink;
mod source;
mod url;

pub use config::ListenConfig;
pub use error::SocketError;
pub use listener::{Teller, Until};
pub use report::{ConnectionEnd, ListenReport, ListenStatus, Listening, SenderReport};
pub use sink::{SendOptions, SocketSink};
pub use source::SocketSource;
pub use url::TcpUrl;
