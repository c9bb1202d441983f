//! The open data chain of a lunar-orbit radio interferometer, from a sky to a map of it.
//!
//! A mission is simulated, sent down as bytes, received and mapped in one chain of calls:
//!
//! ```
//! use lunarray::prelude::*;
//! use lunarray::sky::fits::{ReadOptions, read_map};
//!
//! # fn main() -> Result<(), Box<dyn std::error::Error>> {
//! # let out = tempfile::tempdir()?;
//! # let out = out.path();
//! let summary = Mission::dsl()
//!     .channels(&[3e6])
//!     .nside(4)
//!     .set("spacecraft.every_nth_integration", 15) // Seconds instead of minutes: pipelines/reference.toml has all keys.
//!     .set("spacecraft.baseline_wavelengths_max", 16)
//!     .out(out)
//!     .run()?;
//! println!("{} visibilities are in the map", summary.channels[0].visibilities);
//!
//! let contents = Contents::read(&out.join("downlink.ccsds"))?;
//! assert!(contents.visibilities.count >= summary.channels[0].visibilities);
//! let map = read_map(&out.join("3.000MHz/map.fits"), &ReadOptions::default())?;
//! assert_eq!(map.nside(), 4);
//! # Ok(())
//! # }
//! ```
//!
//! # Where to begin
//! | to | use | example |
//! |---|---|---|
//! | simulate and map a mission | [`pipeline::Mission`] | `examples/quick_map.rs` |
//! | map a sky of one's own | [`pipeline::Mission::set`], [`sky::fits`] | `examples/own_sky.rs` |
//! | simulate the spacecraft, map a downlink | [`pipeline::Mission::simulate`], [`pipeline::Mission::replay`] | `examples/damaged_downlink.rs` |
//! | watch a run, or build it from its parts | [`pipeline::Plan`], [`pipeline::run`], [`pipeline::simulate`], [`pipeline::replay`] | there |
//! | read a downlink | [`downlink::Contents`], [`downlink::DownlinkReader`] | `examples/read_downlink.rs` |
//! | calibrate in a way of one's own | [`calibration::Calibration`] | `examples/calibration_hook.rs` |
//! | map visibilities from elsewhere | [`imaging::PixelEngine`], [`imaging::solve_pixels`] | `examples/map_from_visibilities.rs` |
//! | know where the satellites are | [`array::Array`] | `examples/geometry.rs` |
//! | predict what a pair measures | [`response::pixel::sky_sums`] | `examples/predict_visibility.rs` |
//! | make skies and their spectra | [`sky::generated::generate`], [`sky::harmonics`], [`sky::spectra`] | `examples/spectrum_of_the_sky.rs` |
//! | add a stage to the chain | [`runtime::Stage`], [`runtime::Graph`] | `examples/own_stage.rs` |
//!
//! [`prelude`] has what most programs need.
//!
//! # How data pass
//! A [`sky`] is seen by an [`mod@array`] of satellites through the beam matrix ([`response`]), sampled and correlated on board, sent down
//! ([`downlink`]), given positions and calibrated ([`calibration`]), summed into normal equations and solved ([`imaging`]), and written out
//! ([`products`]). The [`runtime`] moves data between stages and knows no physics; what it moves is in [`frames`]. The [`pipeline`] turns a
//! configuration into a running graph. Spacecraft and ground share no state: the only thing that crosses is bytes.
//!
//! # Conventions
//! Units are SI throughout and stand in names; temperatures are in K, visibilities in K sr. Positions are in Moon-centred ecliptic axes,
//! times in seconds since the mission's epoch. Maps are HEALPix in RING order. "The paper" is Deng et al., arXiv:2511.18494.
//!
//! What is not documented here is public for the program, its tests and the Python package alone, and changes without notice.

// They panic when nobody reads any more; `cli/output.rs` has what does not.
#![warn(clippy::print_stdout, clippy::print_stderr)]

pub mod units;

#[doc(hidden)]
pub mod numerics;

#[doc(hidden)]
pub mod files;

#[doc(hidden)]
pub mod ranks;

pub mod frames;

pub mod runtime;

pub mod sky;

pub mod array;

pub mod response;

#[doc(hidden)]
pub mod daughters;

#[doc(hidden)]
pub mod mother;

pub mod downlink;

pub mod calibration;

pub mod imaging;

pub mod ground;

pub mod products;

pub mod pipeline;

pub mod prelude;

#[doc(hidden)]
pub mod figures;

#[doc(hidden)]
#[cfg(feature = "serve")]
pub mod serve;

#[doc(hidden)]
pub mod bench;

#[doc(hidden)]
pub mod cli;
