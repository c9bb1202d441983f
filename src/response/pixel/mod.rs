//! How a pair of daughters answers to the sky: visibilities of a sky, and rows of the beam matrix B.
//!
//! `V_ij(nu) = Int T(n) A(n) S_i(n) S_j(n) exp(-2 pi i u . n) dn` with `u = (nu/c) (r_i - r_j)`, in K sr
//! (the paper, Eq. 7). S is 0 for directions that the Moon hides from a satellite, else 1. A row of B is
//! the integrand without T at one pixel after another, times the pixel's solid angle.
//!
//! There is one path in `f64` for verification and single answers ([`exact`]) and one that is fast
//! ([`RowMaker`], [`sky_sums`]): phases are reduced to a fraction of a turn in `f64`, the rest is `f32`,
//! so that a fringe is right to 1e-6 at any baseline and frequency of the mission.

mod average;
mod blocks;
mod combs;
mod directions;
mod edge;
pub mod exact;
pub(crate) mod kernel;
mod rows;
mod single;
mod sums;

use serde::{Deserialize, Serialize};
use thiserror::Error;

pub use combs::{Comb, comb_sums};
pub use directions::Directions;
pub use rows::{RowMaker, RowValue};
pub use single::{SingleGeometry, sky_powers};
pub use sums::{SkySum, sky_sums};

use crate::frames::AntennaResponse;
use crate::units::constants::SPEED_OF_LIGHT_M_S;
use crate::units::vector::{Vec3, cross, dot, norm, scale, sub};

/// Points along each side of a pixel at which the pixel-averaging method samples the response: the
/// paper evaluates at nside 1024 and averages down to nside 64.
pub const CHILDREN: usize = 16;

/// How a row of B is taken over a pixel.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum PixelMethod {
    /// The response at the pixel's centre.
    Centre,
    /// The mean over the centres of the pixel's [`CHILDREN`]^2 children, by closed forms.
    #[default]
    Average,
    /// The same mean child by child in `f64`; for verification, hundreds of times slower.
    AverageExact,
}

/// Why a response cannot be computed.
#[derive(Clone, Debug, Error, PartialEq, Eq)]
#[non_exhaustive]
pub enum ResponseError {
    /// Not a HEALPix resolution.
    #[error("nside {0}: expected a power of two from 1 to 512 for rows of the beam matrix")]
    Nside(usize),
    /// A sky and its directions differ in length.
    #[error("a sky of {sky} pixels was given with {directions} directions; expected as many of both")]
    SkyLength {
        /// Number of sky values.
        sky: usize,
        /// Number of directions.
        directions: usize,
    },
}

/// Where two satellites stand and at which frequency they listen.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PairGeometry {
    /// Position of satellite i, m, Moon-centred.
    pub r_i_m: Vec3,
    /// Position of satellite j, m, Moon-centred.
    pub r_j_m: Vec3,
    /// Frequency, Hz.
    pub frequency_hz: f64,
    /// Radius of the body that hides the sky, m.
    pub moon_radius_m: f64,
    /// Antenna power response.
    pub response: AntennaResponse,
}

impl PairGeometry {
    /// Baseline r_i - r_j in wavelengths.
    #[must_use]
    pub fn baseline_wavelengths(&self) -> Vec3 {
        scale(self.frequency_hz / SPEED_OF_LIGHT_M_S, sub(self.r_i_m, self.r_j_m))
    }

    /// Normal of the plane that holds both satellites and the Moon's centre: the orbit normal, which
    /// the dipoles of [`AntennaResponse::DipoleNormal`] point along. `None` if the two are in one direction from the
    /// centre, or opposite each other: then there is no such plane. For one satellite there is [`SingleGeometry`].
    #[must_use]
    pub fn orbit_normal(&self) -> Option<Vec3> {
        let normal = cross(self.r_i_m, self.r_j_m);
        let length = norm(normal);
        // Parallel positions leave only rounding errors of the product.
        let least = 1e-12 * norm(self.r_i_m) * norm(self.r_j_m);
        (length > least).then(|| scale(1.0 / length, normal))
    }

    /// Power response A in direction `n_hat`; not a number for dipoles without a plane to stand on.
    #[must_use]
    pub fn antenna(&self, n_hat: Vec3) -> f64 {
        match self.response {
            AntennaResponse::Isotropic => 1.0,
            AntennaResponse::DipoleNormal => {
                let along = self.orbit_normal().map_or(f64::NAN, |normal| dot(n_hat, normal));
                1.0 - along * along
            }
        }
    }
}
