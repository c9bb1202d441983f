//! What surrounds the computation: pipelines, commands, figures of an array, and the page.
//!
//! Use `lunarray`, which shows what is public of it.

// They panic when nobody reads any more; `cli/output.rs` has what does not.
#![warn(clippy::print_stdout, clippy::print_stderr)]
// A browser tab has pipelines, but no commands.
#![cfg_attr(target_family = "wasm", allow(dead_code, unused_imports))]

use lunarray_core::{
    array, calibration, daughters, downlink, files, frames, ground, imaging, mother, numerics, products,
    ranks, response, runtime, sky, units,
};

pub mod pipeline;

pub mod prelude;

pub mod figures;

#[cfg(all(feature = "serve", not(target_family = "wasm")))]
pub mod serve;

#[cfg(not(target_family = "wasm"))]
pub mod bench;

#[cfg(not(target_family = "wasm"))]
pub mod cli;
