//! The downlink over TCP: a ground that listens to several stations at once, and a spacecraft that sends to it.
//!
//! A connection carries the bytes of a downlink file in either format and nothing else, so any tool that sends a file over
//! TCP can be a station. The ground works on three kinds of threads:
//!
//! | task | where | on |
//! |---|---|---|
//! | accepts and reads connections, enforces time limits | `listener`, `connection` | one thread, the only one with an event loop |
//! | finds packets in the bytes of one connection | `stream_receiver` | a pool, so that a busy connection does not delay others |
//! | forwards complete packets to the pipeline | [`SocketSource`] | the source's thread |
//!
//! The backlog between the second and the third is bounded in bytes; connections get space in the order of request. A
//! connection that waits for space does not read, so TCP slows its sender and no other. Segments of a payload stay
//! together, so that segments of two connections never mix.
//!
//! When all slots are in use, a new connection may evict another (`slots`). A ground without an instrument adopts that of
//! the first sender whose visibilities have positions. Until then it keeps each sender's packets back, so that a mere
//! description cannot exclude other senders.
//!
//! A sender that violates the limits of [`ListenConfig`] is disconnected, counted by reason and reported; the others
//! continue. Once a sender has closed its side and all its packets are forwarded, the ground answers with a line of text,
//! `taken N bytes`, and closes the connection.
//!
//! A sender that begins with the line `answer held` also gets the answer `held N bytes`, once a checkpoint on disk contains
//! all its packets ([`HeldAnswers`]). The source requests a checkpoint with an empty piece of the stream. A waiting
//! connection occupies no slot. The last checkpoint of the run, which is written after the listener has ended, is answered
//! too.
//!
//! Datagrams over UDP (`datagrams`), each with packets or a frame, are not answered. Lost ones show as missing packets and
//! in separate counters.
//!
//! Packets have no signature: everyone who can connect can add to the maps. Therefore addresses that other machines can
//! reach require an explicit option. With [`Stations`] a connection must begin with the line `token TOKEN` of a station, and
//! is reported under its name.

#[cfg(not(target_family = "wasm"))]
mod accept;
mod answers;
#[cfg(not(target_family = "wasm"))]
mod connection;
#[cfg(not(target_family = "wasm"))]
mod datagrams;
mod instrument_filter;
#[cfg(not(target_family = "wasm"))]
mod listener;
mod preamble;
mod report;
mod sink;
#[cfg(not(target_family = "wasm"))]
mod slots;
#[cfg(not(target_family = "wasm"))]
mod source;
mod stations;
mod stream_receiver;
mod url;

pub use crate::downlink::config::ListenConfig;
pub use crate::downlink::error::SocketError;
pub use answers::HeldAnswers;
pub use instrument_filter::InstrumentCheck;
#[cfg(not(target_family = "wasm"))]
pub use listener::{ListenLimits, NoteHandler};
pub use report::{
    ConnectionEnd, DatagramReport, ListenNote, ListenReport, ListenStatus, Listening, SenderReport,
    StationCounts,
};

pub use sink::{SendOptions, SocketSink, WaitHandler};
#[cfg(not(target_family = "wasm"))]
pub use source::SocketSource;
pub use stations::Stations;
pub use url::{ListenUrl, TcpUrl};
