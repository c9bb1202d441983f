//! From visibilities to maps: normal equations, engines, solutions.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)] // A test fails by panicking; helpers are tests too.

#[path = "../common/mod.rs"]
mod common;

mod closed_loop;
mod engines;
mod epsilon;
mod exact_sums;
mod forged;
mod interrupted;
mod lengths;
mod matrix_free;
mod refined;
mod spectrum;
mod tikhonov;
mod traces;
