//! The open data chain of a lunar-orbit radio interferometer.
//!
//! Modules stand in the order in which data passes them: a [`sky`] is seen by an [`mod@array`] of
//! daughter satellites, integrated by the [`mother`], sent down ([`downlink`]), calibrated
//! ([`calibration`]), summed into normal equations ([`accumulation`]), solved ([`solve`]) and written
//! out ([`products`]). The [`runtime`] moves data between stages and knows no physics; the
//! [`pipeline`] turns a configuration into a running graph.
//!
//! Ground modules never import `daughters` or `mother`: the only thing that crosses is bytes.
//!
//! Units are SI throughout and stand in names; temperatures are in K, visibilities in K sr.
//! "The paper" is Deng et al., arXiv:2511.18494.

pub mod units;

pub mod files;

pub mod frames;

pub mod sky;

pub mod array;

pub mod response;

pub mod daughters;

pub mod mother;

pub mod downlink;

pub mod calibration;

pub mod accumulation;

pub mod ground;

pub mod solve;

pub mod products;

pub mod runtime;

pub mod pipeline;

pub mod bench;

pub mod cli;
