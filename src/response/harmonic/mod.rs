//! Spherical harmonics of what a pair on a circular orbit sees.
//!
//! Every visibility is the sky, turned into the orbit's plane, times a pattern that depends on the baseline's length
//! alone: `V = sum_{m mu} exp(-i m alpha) exp(-i mu gamma) sum_l conj(T_lm) d^l_{m mu}(i) f_{l mu}(u)` with
//! `alpha = Omega - pi/2`, `gamma = phi + pi/2`. [`PatternTable`] holds f, [`RotationTable`] d, and
//! [`HarmonicModel`] makes visibilities of them; [`mod@crate::accumulation`] has the normal equations.

mod batch;
mod blocked;
mod chebyshev;
mod error;
pub(crate) mod filter;
mod forward;
mod geometry;
pub(crate) mod kernel;
mod legendre;
mod model;
mod pattern;
pub(crate) mod quadrature;
pub(crate) mod real;
mod ring;
pub(crate) mod rotation;
mod runs;
pub(crate) mod sizes;
mod trigonometry;

pub use error::HarmonicError;
pub use geometry::{GeometryLimits, GeometryRefusal, NominalOrbit, NominalPair, PairOrientation};
pub use model::{HarmonicModel, ModelSettings};
pub use pattern::{NodeGrid, PatternGeometry, PatternTable, degrees};
pub use real::Real;
pub use rotation::{RotationTable, orders};

/// Where a pair is and how long its baseline is: all that a visibility depends on besides the sky.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct PairState {
    /// Longitude Omega of the ascending node, rad.
    pub node_rad: f64,
    /// Orbital phase phi half-way between the two satellites, rad from the node.
    pub phase_rad: f64,
    /// Baseline in wavelengths, u = b nu / c >= 0.
    pub baseline_wavelengths: f64,
    /// Phase that the pair sweeps in one integration, rad; 0 for an instant.
    pub span_rad: f64,
}
