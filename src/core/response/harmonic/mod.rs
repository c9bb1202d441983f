//! Rows of the beam matrix B over spherical harmonics, for satellites on one circular orbit.
//!
//! A visibility is the product of the sky, rotated into the orbital plane, and a fringe pattern that depends only on the
//! length of the baseline:
//! `V = sum_{m mu} exp(-i m alpha) exp(-i mu gamma) sum_l conj(T_lm) d^l_{m mu}(i) f_{l mu}(u)` with
//! `alpha = Omega - pi/2`, `gamma = phi + pi/2`, i the inclination and u the baseline in wavelengths.
//! The sums over m and mu are non-uniform FFTs (NUFFT): uniform grids in alpha, gamma and u, and interpolation with a
//! gridding kernel (`gridding_kernel.rs`).
//!
//! | entry point | purpose |
//! |---|---|
//! | [`PairOrientation`], [`NominalOrbit`] | convert two positions to Omega, phi and u, and refuse those off the orbit |
//! | [`PatternTable`] | f at equally spaced u |
//! | [`RotationTable`] | d for real skies |
//! | [`HarmonicModel`] | visibilities of a sky for many pairs |
//!
//! [`mod@crate::imaging`] builds its normal equations on the same tables. Results do not depend on the number of threads.

mod batch;
mod blocked;
mod error;
pub(crate) mod filter;
mod forward;
mod geometry;
pub(crate) mod gridding_kernel;
mod model;
pub(crate) mod pattern;
mod ring;
pub(crate) mod rotation;
mod runs;

pub use error::HarmonicError;
pub use geometry::{GeometryLimits, GeometryRefusal, NominalOrbit, NominalPair, PairOrientation};
pub use model::{HarmonicModel, ModelSettings};
pub use pattern::{NodeGrid, PatternGeometry, PatternTable, degree_count};

pub use crate::numerics::Real;
pub use rotation::{RotationTable, order_count};

/// Orbital position and baseline length of a pair, which together with the sky determine its visibility.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct PairState {
    /// Longitude Omega of the ascending node, rad.
    pub node_rad: f64,
    /// Orbital phase phi half-way between the two satellites, rad from the node.
    pub phase_rad: f64,
    /// Baseline in wavelengths, u = b nu / c >= 0.
    pub baseline_wavelengths: f64,
    /// Orbital phase swept in one integration, rad; 0 for an instant.
    pub span_rad: f64,
}
