//! Errors of figures.

use thiserror::Error;

use super::request::FIGURES;
use crate::array::ArrayError;
use crate::pipeline::PipelineError;
use crate::products::ProductsError;
use crate::response::pixel::ResponseError;
use crate::sky::MapError;
use crate::units::Pair;

/// Errors of figures.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum FigureError {
    /// An unknown figure.
    #[error("unknown figure `{name}`; expected one of {}", FIGURES.join(", "))]
    Unknown {
        /// Requested name.
        name: String,
    },
    /// A pair that the array does not have.
    #[error("pair {pair}: the array has only {satellites} satellites; expected two of these")]
    NoPair {
        /// Requested pair.
        pair: Pair,
        /// Number of satellites of the array.
        satellites: usize,
    },
    /// A time that the ephemeris does not cover.
    #[error("--at {at_s} s: expected a time covered by the ephemeris, {} s to {} s", known_s[0], known_s[1])]
    NoTime {
        /// Requested time, s.
        at_s: f64,
        /// First and last time of the ephemeris, s.
        known_s: [f64; 2],
    },
    /// A figure that needs a formation with a geometric progression.
    #[error(
        "figure spacing: q0 is defined only for a formation on a circular orbit; expected no array.arcs_m, array.kepler or array.oem"
    )]
    NoProgression,
    /// An array without a baseline within the limit of the map.
    #[error(
        "no baseline is shorter than the limit of {limit_m:.0} m; increase map.baseline_bp_max or decrease map.nside"
    )]
    NoBaseline {
        /// Limit on the baseline, m.
        limit_m: f64,
    },
    /// An error of the array.
    #[error(transparent)]
    Array(#[from] ArrayError),
    /// An error of a map.
    #[error(transparent)]
    Map(#[from] MapError),
    /// An error in the rows of the beam matrix.
    #[error(transparent)]
    Response(#[from] ResponseError),
    /// An error of the generated sky.
    #[error(transparent)]
    Sky(#[from] crate::sky::generated::GeneratedSkyError),
    /// An error in the sky of the plan.
    #[error(transparent)]
    Pipeline(#[from] PipelineError),
    /// A file that cannot be written.
    #[error(transparent)]
    Products(#[from] ProductsError),
    /// A picture that cannot be drawn.
    #[error(transparent)]
    Picture(#[from] crate::products::pictures::PictureError),
}
