//! (to come)

mod batch;
mod chebyshev;
mod error;
mod filter;
mod forward;
mod geometry;
mod kernel;
mod legendre;
mod model;
mod pattern;
mod quadrature;
mod real;
mod ring;
mod rotation;
mod runs;
mod sizes;
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
