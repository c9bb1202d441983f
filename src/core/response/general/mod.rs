//! Rows of B over spherical harmonics for satellites at any positions.
//!
//! No orbit is assumed. The two positions of a pair define its own frame and the part of the sky that the Moon occults, and so
//! its fringe pattern (see `cap.rs`); the sky is rotated into that frame. On a common circle the rows are those of
//! [`crate::response::harmonic`]. Along a track the rows of a pair change slowly, so that
//! few are computed and the others interpolated (see `plan.rs` and `planner.rs`): [`GeneralRows::plan`], [`GeneralRows::forward`],
//! [`GeneralRows::adjoint`]. As the reference, [`GeneralRows::plan_direct`] computes each row.
//!
//! The response of a pair may be any polynomial in the direction ([`PairResponse`]), and visibilities may be averages over
//! their integrations ([`GeneralRows::plan_with`]).
//!
//! Results do not depend on the number of threads.

mod antennas;
mod cap;
mod classes;
mod frames;
mod instants;
mod lanes;
mod limb_zone;
mod operator;
mod order_sums;
mod phases;
mod plan;
mod planner;
mod skies;
mod turns;
mod view;
mod workspace;

pub use antennas::{DEGREE_MAX, PairResponse};
pub use instants::{Instant, Instants};
pub use operator::{GeneralRows, row_tables_bytes};
pub use plan::{ObservationDetails, RowPlan};

use thiserror::Error;

use super::harmonic::GeometryRefusal;
use crate::frames::AntennaResponse;
use crate::units::Pair;
use crate::units::vector::Vec3;

/// Setup of rows, independent of positions.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RowsSetup {
    /// Maximum degree of the sky.
    pub l_max: usize,
    /// Wavelength, m.
    pub wavelength_m: f64,
    /// Radius of the Moon, m.
    pub moon_radius_m: f64,
    /// Response of the antennas.
    pub response: AntennaResponse,
    /// Maximum degree of the polynomials that multiply the response pair by pair: even, at most [`DEGREE_MAX`]; 0 for none.
    pub polynomial_degree: usize,
}

/// Positions of a pair at one time.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct TimedPair {
    /// Pair.
    pub pair: Pair,
    /// Mission time, s.
    pub time_s: f64,
    /// Position of satellite i, m.
    pub r_i_m: Vec3,
    /// Position of satellite j, m.
    pub r_j_m: Vec3,
}

/// Refusal of a visibility, which has no row.
#[derive(Clone, Copy, Debug, Error, PartialEq)]
#[error("visibility {index}: {refusal}")]
pub struct RowsError {
    /// Index of the visibility.
    pub index: usize,
    /// Reason.
    pub refusal: RowsRefusal,
}

/// Why a visibility has no row.
#[derive(Clone, Copy, Debug, Error, PartialEq)]
pub enum RowsRefusal {
    /// Its positions are not covered.
    #[error(transparent)]
    Geometry(#[from] GeometryRefusal),
    /// Its response has a higher degree than the rows.
    #[error(
        "its response is a polynomial of degree {degree} in the direction; expected at most the polynomial_degree of the rows' \
         setup, {degree_max}"
    )]
    Degree {
        /// Degree of the response.
        degree: usize,
        /// Maximum degree of the rows.
        degree_max: usize,
    },
}

/// Checks that a pair at these positions has a row.
///
/// # Errors
/// [`GeometryRefusal`] if it has none.
pub fn check_positions(r_i_m: Vec3, r_j_m: Vec3, moon_radius_m: f64) -> Result<(), GeometryRefusal> {
    view::PairView::new(r_i_m, r_j_m, moon_radius_m).map(drop)
}
