//! The array and the rows of B, against independent values and direct sums.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)] // A test fails by panicking; helpers are tests too.

#[path = "../common/mod.rs"]
mod common;

mod bodies;
mod departures;
mod forward;
mod general;
mod geometry;
mod lunar;
mod oem;
mod patterns;
mod propagated;
mod response;
mod spk;
