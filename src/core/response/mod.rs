//! The beam matrix B: the response of each pair of daughters to the sky.
//!
//! `V_ij(nu) = Int T(n) A(n) S_i(n) S_j(n) exp(-2 pi i (nu/c) n . r_ij) dn`, in K sr (the paper, Sect. 3.2). A row of B is
//! the integrand without T, over pixels or over spherical harmonics.
//!
//! | module | holds |
//! |---|---|
//! | [`pixel`] | rows of B over HEALPix pixels, and direct sums over a sky |
//! | [`harmonic`] | rows of B over spherical harmonics, for satellites on one circle, by non-uniform FFTs (NUFFT) |
//! | [`general`] | rows of B over spherical harmonics, for satellites at any positions |
//! | [`beacon`] | an artificial plane wave |
//! | [`model`] | visibilities of a given sky, by any of these |
//! | [`PatternsByFrequency`], [`MeasuredAntennas`] | antenna patterns by frequency; attitudes and patterns by files |
//!
//! Uses [`crate::units`], [`crate::frames`], [`crate::sky`] and [`mod@crate::array`]. Simulation and mapping share this
//! code, so that a bug would cancel out unseen: tests compare it with reference values made by other code.

mod antenna_tables;
#[doc(hidden)]
pub mod beacon;
#[doc(hidden)]
pub mod general;
#[doc(hidden)]
pub mod harmonic;
mod measured_antennas;
#[doc(hidden)]
pub mod model;
mod patterns_by_frequency;
pub mod pixel;

#[doc(hidden)]
pub use antenna_tables::{AntennaTables, FittedDipole, TableError};
#[doc(hidden)]
pub use measured_antennas::{AntennaFiles, AntennaQuery, MeasuredAntennas, MeasuredAntennasError};
#[doc(hidden)]
pub use patterns_by_frequency::PatternsByFrequency;
