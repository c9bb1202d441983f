//! The open data chain of a lunar-orbit radio interferometer, from a sky to a map of it.
//!
//! ```
//! use lunarray::downlink::Contents;
//! use lunarray::pipeline::{ConfigSource, Plan, run};
//! use lunarray::runtime::Cancel;
//! use lunarray::sky::fits::{ReadOptions, read_map};
//!
//! # fn main() -> Result<(), Box<dyn std::error::Error>> {
//! // The pipeline `quicklook`, made small. `pipelines/reference.toml` lists all keys.
//! let keys = ["sky.nside=8", "spacecraft.channels_hz=[3e6]", "spacecraft.every_nth_window=300",
//!     "spacecraft.every_nth_integration=2", "spacecraft.baseline_wavelengths_max=16.0",
//!     "map.nside=4", "map.epsilon=1e-4", "products.pictures=false"];
//! let source = ConfigSource { overrides: keys.map(str::to_owned).to_vec(), ..ConfigSource::default() };
//! let plan = Plan::new(source.load()?)?;
//!
//! // Sky, spacecraft, downlink, ground and products, on a thread a stage.
//! let out = tempfile::tempdir()?;
//! let summary = run(&plan, out.path(), &Cancel::new(), &mut |_watched| {})?;
//! assert_eq!(summary.channels.len(), 1);
//!
//! // What went down, and what was made of it.
//! let contents = Contents::read(&out.path().join("downlink.ccsds"))?;
//! assert!(contents.visibilities.count >= summary.channels[0].visibilities);
//! let map = read_map(&out.path().join("3.000MHz/map.fits"), &ReadOptions::default())?;
//! assert_eq!(map.nside(), 4);
//! # Ok(())
//! # }
//! ```
//!
//! Modules stand in the order in which data passes them: a [`sky`] is seen by an [`mod@array`] of satellites through
//! the beam matrix ([`response`]), sampled by the [`daughters`], correlated and integrated by the [`mother`], sent down
//! ([`downlink`]), calibrated ([`calibration`]), turned into maps ([`imaging`]: normal equations and
//! their solution) by the [`ground`], and written out ([`products`]). The [`runtime`] moves data between stages and knows no physics; the
//! [`pipeline`] turns a configuration into a running graph. A module uses only modules before it in `docs/ARCHITECTURE.md`,
//! which also says where to add what; `tests/tree/` enforces it.
//!
//! Ground modules never import `daughters` or `mother`: the only thing that crosses is bytes.
//!
//! # Entry points
//! | to | use | example |
//! |---|---|---|
//! | run the chain, or one segment of it | [`pipeline::run`], [`pipeline::simulate`], [`pipeline::replay`] | above |
//! | read a downlink | [`downlink::Contents`], [`downlink::DownlinkReader`] | `examples/read_downlink.rs` |
//! | calibrate in a way of one's own | [`calibration::Calibration`] | `examples/calibration_hook.rs` |
//! | make a map of visibilities from elsewhere | [`imaging::PixelEngine`], [`imaging::solve_pixels`] | `examples/map_from_visibilities.rs` |
//! | build a graph of stages | [`runtime::Graph`], [`runtime::Stage`] | `examples/own_stage.rs` |
//! | know where the satellites are | [`array::Array`] | there |
//!
//! Units are SI throughout and stand in names; temperatures are in K, visibilities in K sr.
//! "The paper" is Deng et al., arXiv:2511.18494.

// They panic when nobody reads any more; `cli/output.rs` has what does not.
#![warn(clippy::print_stdout, clippy::print_stderr)]

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

pub mod pipeline;

pub mod figures;

#[cfg(feature = "serve")]
pub mod serve;

pub mod bench;

pub mod cli;
