//! The page of a running chain, and the same for programs: a small HTTP server that only tells.
//!
//! | route | what |
//! |---|---|
//! | `/` | the page |
//! | `/events` | server-sent events: `status` twice a second at most, and `log` |
//! | `/api/status` | the state of the run, in the terms of `summary.json` |
//! | `/api/config` | the configuration |
//! | `/api/figures/CHANNEL` | quality of a channel's maps, and spectra of the last |
//! | `/api/maps/CHANNEL/N.f32`, `.fits`, `.png` | a map; N is a number, `latest`, `noise` or `input` |
//! | `/api/passes` | packets received and missing over the mission's time |
//! | `/api/geometry` | where the satellites, the Moon and the Earth are |
//! | `/api/uvw/CHANNEL` | how the baselines fill the planes of u, v, w |
//! | `/api/powers/CHANNEL` | powers of the daughters over the mission's time |
//! | `/api/gaps` | missing packets, if there is a state |
//! | `/metrics` | for Prometheus |
//! | `/healthz`, `/readyz` | for a supervisor |
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
