//! The open data chain of a lunar-orbit radio interferometer, from a sky to a map of it.
//!
//! One chain of calls simulates a mission, sends its data down as bytes, receives and maps them:
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
//! | watch a run, or build it from its parts | [`pipeline::Plan`], [`pipeline::run`], [`pipeline::simulate`], [`pipeline::replay`] | in their documentation |
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
//! An [`mod@array`] of satellites sees a [`sky`] through the beam matrix ([`response`]), samples and correlates it on board, and
//! sends visibilities down ([`downlink`]). The ground calibrates them ([`calibration`]), sums them into normal equations, solves
//! these ([`imaging`]), and writes maps ([`products`]). The [`runtime`] moves data between stages and knows no physics; what it
//! moves is in [`frames`]. The [`pipeline`] turns a configuration into a running graph. Spacecraft and ground share no state: only
//! bytes cross.
//!
//! # Conventions
//! Units are SI throughout and stand in names; temperatures are in K, visibilities in K sr. Positions are in Moon-centred ecliptic axes,
//! times in seconds since the mission's epoch. Maps are HEALPix in RING order. "The paper" is Deng et al., arXiv:2511.18494.
//!
//! Public items that are not documented here are for the program, its tests and the Python package, and change without notice.

#[doc(hidden)]
#[cfg(feature = "serve")]
pub use lunarray_app::serve;
#[doc(hidden)]
pub use lunarray_app::{bench, cli, figures};
#[doc(inline)]
pub use lunarray_app::{pipeline, prelude};
#[doc(inline)]
pub use lunarray_core::{
    array, calibration, downlink, frames, ground, imaging, products, response, runtime, sky, units,
};
#[doc(hidden)]
pub use lunarray_core::{daughters, files, mother, numerics, ranks};
