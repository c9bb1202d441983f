//! What lunarray computes, from a sky to a map of it: everything whose speed matters.
//!
//! Use `lunarray`, which shows what is public of it.

// They panic when nobody reads any more.
#![warn(clippy::print_stdout, clippy::print_stderr)]
// A browser has no sockets, and what serves them has no use there.
#![cfg_attr(target_family = "wasm", allow(dead_code))]

pub mod units;

pub mod numerics;

pub mod files;

pub mod ranks;

pub mod frames;

pub mod runtime;

pub mod sky;

pub mod array;

pub mod response;

pub mod daughters;

pub mod mother;

pub mod downlink;

pub mod calibration;

pub mod imaging;

pub mod ground;

pub mod products;
