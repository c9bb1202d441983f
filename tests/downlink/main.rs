//! The downlink: packets, coded frames, files and faulty links.
#![allow(clippy::unwrap_used)] // A test fails by panicking; helpers are tests too.

#[path = "../common/mod.rs"]
mod common;

mod cadu;
mod faults;
mod files;
mod fixture;
mod ledger;
mod link;
mod python;
