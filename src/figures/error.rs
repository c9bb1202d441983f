//! Errors of figures.

use thiserror::Error;

use super::request::FIGURES;
use crate::array::ArrayError;
use crate::pipeline::PipelineError;
use crate::products::ProductsError;
use crate::response::pixel::ResponseError;
use crate::sky::MapError;
use crate::units::Pair;

/// Why a figure could not be made.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum FigureError {
    /// No figure of this name.
    #[error("figure `{name}`: expected one of {}", FIGURES.join(", "))]
    Unknown {
        /// Name asked for.
        name: String,
    },
    /// A pair that the array does not have.
    #[error("pair {pair}: the array has {satellites} satellites")]
    NoPair {
        /// Pair asked for.
        pair: Pair,
        /// Satellites of the array.
        satellites: usize,
    },
    /// A time for which no positions are known.
    #[error("--at {at_s} s: positions are known from {} s to {} s", known_s[0], known_s[1])]
    NoTime {
        /// Time asked for, s.
        at_s: f64,
        /// First and last time known, s.
        known_s: [f64; 2],
    },
    /// A figure that needs the formation's progression.
    #[error(
        "figure spacing: q0 is a property of a formation on a circle; expected no array.arcs_m, array.kepler or array.oem"
    )]
    NoProgression,
    /// No baseline within the limit.
    #[error(
        "no baseline is shorter than the limit of {limit_m:.0} m; raise map.baseline_bp_max or lower map.nside"
    )]
    NoBaseline {
        /// The limit, m.
        limit_m: f64,
    },
    /// The array.
    #[error(transparent)]
    Array(#[from] ArrayError),
    /// A map.
    #[error(transparent)]
    Map(#[from] MapError),
    /// Rows of the beam matrix.
    #[error(transparent)]
    Response(#[from] ResponseError),
    /// The sky.
    #[error(transparent)]
    Sky(#[from] crate::sky::generated::GeneratedSkyError),
    /// The simulated sky of the plan.
    #[error(transparent)]
    Pipeline(#[from] PipelineError),
    /// A picture or file.
    #[error(transparent)]
    Products(#[from] ProductsError),
    /// A picture that cannot be drawn.
    #[error(transparent)]
    Picture(#[from] crate::products::pictures::PictureError),
}
