//! The columns of bodies that move, beside the equations of a map.

use crate::sky::Body;
use crate::units::constants::DAY_S;

/// Length of a month, s.
pub const MONTH_S: f64 = 30.0 * DAY_S;

/// The column of a body in a month.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Column {
    pub(super) body: Body,
    pub(super) month: i64,
}

/// All columns of the bodies at a power of 1 K sr, with their products; see [`super::MoverSums`].
#[derive(Clone, Debug)]
pub struct MoverColumns {
    pub(super) columns: Vec<Column>,
    /// `BtN^-1P`, by column.
    pub(super) right: Vec<Vec<f64>>,
    /// `P'N^-1P`, row by row, (K sr)^-2.
    pub(super) products: Vec<f64>,
    /// `P'N^-1V`, (K sr)^-1.
    pub(super) data: Vec<f64>,
    /// The same of the noise of the noise-only map.
    pub(super) noise: Vec<f64>,
    pub(super) frequency_hz: f64,
    /// Visibilities of months without a column.
    pub(super) beyond: u64,
}
