//! Sample fidelity: the output of daughters and correlator agrees with the model, the radiometer equation and
//! the literature on quantisers.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)] // A test fails by panicking.

#[path = "../common/mod.rs"]
mod common;

mod autos;
mod chain;
mod craft;
mod delays;
mod disturbances;
mod integration;
mod late;
mod links;
mod ninth;
mod noise;
mod robust;
mod signal;
mod states;
mod store;
