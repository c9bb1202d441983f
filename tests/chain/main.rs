//! The whole chain through the command line.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)] // A test fails by panicking; helpers are tests too.

#[path = "../common/mod.rs"]
mod common;

mod bench;
mod bound;
mod bursts;
mod calibrate;
mod coded;
mod command_line;
mod design;
mod ending;
mod ephemerides;
mod figures;
mod first_contact;
mod groups;
mod harmonic;
mod instrument;
mod joint;
mod live_gains;
mod movers;
mod navigation;
mod orbit_files;
mod orbits;
mod outputs;
mod paper;
mod products;
mod ranks;
mod receiver;
mod reflection;
mod run;
mod sample;
mod schema;
mod start_up;
mod stepwise;
mod study;
mod zoom;
