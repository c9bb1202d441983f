//! The page of a running chain, and the same for programs: a small HTTP server that only reads.
//!
//! `docs/live.md` describes the routes: the page, `/events`, `/api/...`, `/metrics`, `/healthz` and `/readyz`.
//!
//! It reads what a running graph shows anyway ([`crate::pipeline::Watched`]) and sees maps through one hook of the
//! publisher. Nothing in the chain waits for it: a browser that is late sees the newest state and misses what was between.
//! All memory is bounded: maps held, connections, what one request may hold. No request can name a file.
//!
//! [`Client`] and [`Screen`] show the same in a terminal (`lunarray top`).
//!
//! One thread with an event loop serves all connections, a second one draws pictures. May use every folder before it.

mod address;
mod client;
mod collector;
mod connection;
mod console;
mod error;
mod event_log;
mod geometry;
mod pulse;
mod routes;
mod screen;
mod server;
mod shelf;
mod status;
mod subject;

pub use address::ServeAddress;
pub use client::{Client, ClientError};
pub use error::ServeError;
pub use screen::Screen;
pub use server::Server;
pub use subject::Subject;
