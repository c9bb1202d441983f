//! A small read-only HTTP server for a running chain: a page for browsers, and JSON and metrics for programs.
//!
//! `docs/live.md` describes the routes: the page, `/events`, `/api/...`, `/metrics`, `/healthz` and `/readyz`.
//!
//! The server reads the handles of a running graph ([`crate::pipeline::RunView`]) and receives maps through a hook of the
//! publisher. Nothing in the chain waits for it: a slow browser skips to the newest state. Memory is bounded: maps held, connections,
//! and the size of a request. No request can name a file.
//!
//! [`Client`] and [`Screen`] show the state in a terminal (`lunarray top`).
//!
//! One thread with an event loop serves all connections; a second one draws pictures. May use every folder before it.

mod address;
mod client;
mod connection;
mod console;
mod error;
mod event_log;
mod geometry;
mod map_cache;
mod prometheus;
mod routes;
mod screen;
mod screen_text;
mod server;
mod stage_rates;
mod status;
mod subject;

pub use address::ServeAddress;
pub use client::{Client, ClientError};
pub use error::ServeError;
pub use screen::Screen;
pub use server::Server;
pub use subject::Subject;
