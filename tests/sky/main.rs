//! Sky maps: files and spherical harmonics, alone and against healpy.
#![allow(clippy::unwrap_used, clippy::panic)] // A test fails by panicking; helpers are tests too.

#[path = "../common/mod.rs"]
mod common;

mod cutouts;
mod files;
mod foreign;
mod harmonics;
mod python_files;
mod python_harmonics;
mod verified;
