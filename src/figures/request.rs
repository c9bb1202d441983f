//! Which figure is asked for.

use crate::units::Pair;

/// The figures by name.
pub const FIGURES: [&str; 8] =
    ["spacing", "baselines", "pair-time", "uvw", "coverage", "rows", "waterfall", "sub-pixel"];

/// Which figure to make, and of what.
#[derive(Clone, Debug, PartialEq)]
pub struct FigureRequest {
    /// One of [`FIGURES`].
    pub name: String,
    /// Pair of `rows` and `waterfall`; one that suits the map if `None`.
    pub pair: Option<Pair>,
    /// Time of `rows` and `waterfall`, s; the middle of the first window if `None`.
    pub at_s: Option<f64>,
}
