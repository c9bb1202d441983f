//! The downlink over TCP: a ground that listens to several stations at once, and a spacecraft that sends to it.
//!
//! A connection carries the bytes of a downlink file, in either format, and needs nothing else. So any tool that sends a
//! file over TCP can be a station. The ground works in three places:
//!
//! | task | where | on |
//! |---|---|---|
//! | accepts, reads, keeps time | `listener`, `connection` | one thread, the only one with an event loop |
//! | finds packets in the bytes of one connection | `sender_intake` | a pool, so that one busy connection does not delay others |
//! | passes whole packets to the pipeline | [`SocketSource`] | the source's thread |
//!
//! The backlog between the second and the third is bounded in bytes; connections get room in the order of request. A
//! connection that waits for room does not read, so TCP slows its sender and no other. Segments of one payload stay
//! together, so that those of two connections never mix.
//!
//! When all places are taken, the least useful connection gives way to a newcomer (`seats`). A ground without an
//! instrument takes that of the first sender whose visibilities have positions; until then it holds each sender's packets
//! back, so that a mere description shuts nobody out.
//!
//! A sender that violates the limits of [`ListenConfig`] is disconnected, counted by reason and reported; the others
//! continue. Once a sender has closed its side and all its packets are passed on, the ground answers with a line of
//! text, `taken N bytes`, and closes.
//!
//! A sender that begins with the line `answer held` is also told `held N bytes`, once a checkpoint on disk has all of it
//! ([`HeldAnswers`]). The source asks the ground for a checkpoint with an empty piece of the stream. The connection's place is
//! free while it waits; the last checkpoint of the run, which comes after the listener has ended, answers too.
//!
//! Datagrams over UDP, each a packet or a frame, come in beside connections (`datagrams`): nothing answers them, so what is lost shows as
//! missing packets, and in counters of their own.
//!
//! Packets carry no signature: whoever can connect can add to the maps. Therefore addresses other than those of this
//! machine require an explicit option. With [`Stations`] a connection has to begin with the line `token TOKEN` of one of them, and
//! is reported by its name.

mod accept;
mod answers;
mod config;
mod connection;
mod datagrams;
mod error;
mod listener;
mod preamble;
mod report;
mod seats;
mod sender_intake;
mod sink;
mod source;
mod stations;
mod url;

pub use answers::HeldAnswers;
pub use config::ListenConfig;
pub use error::SocketError;
pub use listener::{ListenLimits, NoteHandler};
pub use report::{
    ConnectionEnd, DatagramReport, ListenNote, ListenReport, ListenStatus, Listening, SenderReport,
    StationCounts,
};
pub use sender_intake::InstrumentCheck;
pub use sink::{SendOptions, SocketSink};
pub use source::SocketSource;
pub use stations::Stations;
pub use url::{ListenUrl, TcpUrl};
