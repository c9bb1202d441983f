//! Selects a figure.

use crate::units::Pair;

/// Names of the figures.
pub const FIGURES: [&str; 8] =
    ["spacing", "baselines", "pair-time", "uvw", "coverage", "rows", "waterfall", "sub-pixel"];

/// The figure to make, with its options.
#[derive(Clone, Debug, PartialEq)]
pub struct FigureRequest {
    /// One of [`FIGURES`].
    pub name: String,
    /// Pair of `rows` and `waterfall`; `None` for the one closest to twice the baseline b_p.
    pub pair: Option<Pair>,
    /// Time of `rows` and `waterfall`, s; `None` for the middle of the first window.
    pub at_s: Option<f64>,
}
