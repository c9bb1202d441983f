//! Rows of the beam matrix B over spherical harmonics, for satellites on one circular orbit.
//!
//! A visibility is the sky, rotated into the orbital plane, times a pattern that depends on the length of the baseline
//! only: `V = sum_{m mu} exp(-i m alpha) exp(-i mu gamma) sum_l conj(T_lm) d^l_{m mu}(i) f_{l mu}(u)` with
//! `alpha = Omega - pi/2`, `gamma = phi + pi/2`, i the inclination and u the baseline in wavelengths.
//!
//! | entry point | holds or does |
//! |---|---|
//! | [`PairOrientation`], [`NominalOrbit`] | from two positions to Omega, phi and u, and the limits of the basis |
//! | [`PatternTable`] | f at equally spaced u |
//! | [`RotationTable`] | d for real skies |
//! | [`HarmonicModel`] | visibilities of a sky at many states of pairs |
//!
//! [`mod@crate::imaging`] builds its normal equations on the same tables. Uses [`crate::sky::harmonics`]; results
//! do not depend on the number of threads.

mod batch;
mod blocked;
mod error;
pub(crate) mod filter;
mod forward;
mod geometry;
pub(crate) mod kernel;
mod model;
pub(crate) mod pattern;
mod ring;
pub(crate) mod rotation;
mod runs;

pub use error::HarmonicError;
pub use geometry::{GeometryLimits, GeometryRefusal, NominalOrbit, NominalPair, PairOrientation};
pub use model::{HarmonicModel, ModelSettings};
pub use pattern::{NodeGrid, PatternGeometry, PatternTable, degrees};

pub use crate::numerics::Real;
pub use rotation::{RotationTable, orders};

/// Position and baseline length of a pair: all that a visibility depends on besides the sky.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct PairState {
    /// Longitude Omega of the ascending node, rad.
    pub node_rad: f64,
    /// Orbital phase phi half-way between the two satellites, rad from the node.
    pub phase_rad: f64,
    /// Baseline in wavelengths, u = b nu / c >= 0.
    pub baseline_wavelengths: f64,
    /// Phase swept in one integration, rad; 0 for an instant.
    pub span_rad: f64,
}
