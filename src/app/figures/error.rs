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
    /// A sky hardly finer than the map, which hides what pixels do to visibilities.
    #[error(
        "figure waterfall: the sky has nside {sky}, map.nside is {map}: errors of pixels would seem too small; expected a sky of \
         nside {expected} at least: increase sky.nside, take a finer sky.file, or decrease map.nside"
    )]
    CoarseSky {
        /// nside of the sky.
        sky: usize,
        /// nside of the map.
        map: usize,
        /// Least nside of the sky.
        expected: usize,
    },
    /// A sky without visibilities, to which errors could be relative.
    #[error(
        "figure waterfall: the sky's visibilities of pair {pair} are 0, so that errors relative to them are undefined; expected a \
         sky with pixels above 0 in sight of both satellites: mend sky.file or take another --at"
    )]
    DarkSky {
        /// Pair of the waterfall.
        pair: Pair,
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
