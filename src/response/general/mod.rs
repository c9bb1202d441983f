//! Rows of B over spherical harmonics for satellites at any positions.
//!
//! Nothing is assumed of orbits: a pair's two positions give its own frame, what the Moon hides from either, and so its
//! pattern (see `cap.rs`); the sky is turned into that frame. On a common circle the rows are those of
//! [`crate::response::harmonic`]. Along a track the rows of a pair change slowly, so that few are computed and the others
//! interpolated (see `plan.rs`): [`GeneralRows::plan`], [`GeneralRows::forward`], [`GeneralRows::adjoint`]. As a reference
//! [`GeneralRows::plan_direct`] computes each row.
//!
//! Antennas of a pair may have any response that is a polynomial in the direction ([`PairResponse`]), and visibilities may be averages over
//! their integrations ([`GeneralRows::plan_of`]).
//!
//! Results do not depend on the number of threads.

mod antennas;
mod border;
mod cap;
mod classes;
mod frames;
mod instants;
mod lanes;
mod operator;
mod phases;
mod plan;
mod skies;
mod turns;
mod view;

pub use antennas::{DEGREE_MAX, PairResponse};
pub use instants::{Instant, Instants};
pub use operator::{GeneralRows, row_tables_bytes};
pub use plan::{Observed, RowPlan};

use thiserror::Error;

use super::harmonic::GeometryRefusal;
use crate::frames::AntennaResponse;
use crate::units::Pair;
use crate::units::vector::Vec3;

/// Setup of rows: everything but positions.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RowsSetup {
    /// Greatest degree of the sky.
    pub l_max: usize,
    /// Wavelength, m.
    pub wavelength_m: f64,
    /// Radius of the Moon, m.
    pub moon_radius_m: f64,
    /// Response of the antennas.
    pub response: AntennaResponse,
    /// Greatest degree of the polynomials that multiply it, pair by pair: even, at most [`DEGREE_MAX`]; 0 if none does.
    pub polynomial_degree: usize,
}

/// Positions of a pair at a time.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PairAt {
    /// Pair.
    pub pair: Pair,
    /// Mission time, s.
    pub time_s: f64,
    /// Position of satellite i, m.
    pub r_i_m: Vec3,
    /// Position of satellite j, m.
    pub r_j_m: Vec3,
}

/// A visibility that has no row.
#[derive(Clone, Copy, Debug, Error, PartialEq)]
#[error("visibility {index}: {refusal}")]
pub struct RowsError {
    /// Its index.
    pub index: usize,
    /// What is wrong with it.
    pub refusal: RowsRefusal,
}

/// Why a visibility has no row.
#[derive(Clone, Copy, Debug, Error, PartialEq)]
pub enum RowsRefusal {
    /// Its positions.
    #[error(transparent)]
    Geometry(#[from] GeometryRefusal),
    /// Its response is of a higher degree than the rows'.
    #[error(
        "its response is a polynomial of degree {degree} in the direction; expected at most the polynomial_degree of the rows' \
         setup, {most}"
    )]
    Degree {
        /// Degree of the response.
        degree: usize,
        /// Degree that the rows hold.
        most: usize,
    },
}

/// Whether a pair at these positions has a row.
///
/// # Errors
/// What is wrong with the positions.
pub fn check_positions(r_i_m: Vec3, r_j_m: Vec3, moon_radius_m: f64) -> Result<(), GeometryRefusal> {
    view::PairView::of(r_i_m, r_j_m, moon_radius_m).map(drop)
}
