//! Rows of the beam matrix B over HEALPix pixels, and visibilities as direct sums over a sky.
//!
//! `V_ij(nu) = Int T(n) A(n) S_i(n) S_j(n) exp(-2 pi i u . n) dn` with `u = (nu/c) (r_i - r_j)`, in K sr
//! (the paper, Sect. 3.2). S is 0 for directions that the Moon hides from a satellite, and 1 otherwise. A row of B is
//! the integrand without T, pixel by pixel, times the pixel's solid angle.
//!
//! | entry point | computes |
//! |---|---|
//! | [`RowMaker`] | rows of B: at pixel centres, or averaged over pixels |
//! | [`RowProducts`] | products with rows that are not stored |
//! | [`sky_sums`], [`sky_powers`] | visibilities and auto-correlation powers of a sky |
//! | [`antenna_sums`], [`antenna_powers`] | visibilities and powers with individual antennas |
//! | [`four_sky_sums`] | visibilities of four skies together |
//! | [`comb_sums`] | visibilities of a sky at equally spaced frequencies |
//! | [`exact`] | rows and visibilities in `f64`, for verification |
//!
//! The fast path reduces phases to a fraction of a turn in `f64` and does the rest in `f32`: fringes are accurate to
//! 1e-6 at any baseline and frequency of the mission. Results do not depend on threads.

mod average;
mod blocks;
mod combs;
mod directions;
#[doc(hidden)]
pub mod exact;
mod geometry;
mod kernel;
mod limb_blocks;
mod order;
mod products;
mod rows;
mod sums;

use serde::{Deserialize, Serialize};
use thiserror::Error;

#[doc(hidden)]
pub use combs::{Comb, comb_sums};
pub use directions::Directions;
pub use geometry::PairGeometry;
#[doc(hidden)]
pub use geometry::{DirectionForm, SatelliteAntenna, SingleGeometry};
#[doc(hidden)]
pub use products::RowProducts;
#[doc(hidden)]
pub use rows::{RowMaker, RowValue};
pub use sums::{SkySum, sky_sums};
#[doc(hidden)]
pub use sums::{antenna_powers, antenna_sums, four_sky_sums, sky_powers};

/// Number of sample points along each side of a pixel in pixel averages, as in the paper, which evaluates at nside 1024 and
/// averages down to nside 64.
#[doc(hidden)]
pub const CHILDREN: usize = 16;

/// Method by which a row of B represents a pixel.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum PixelMethod {
    /// The response at the pixel's centre.
    Centre,
    /// The mean over the centres of the pixel's [`CHILDREN`]^2 children, in closed form.
    #[default]
    Average,
    /// The mean over the children computed child by child in `f64`: for verification, hundreds of times slower.
    AverageExact,
}

/// Why a response cannot be computed.
#[derive(Clone, Debug, Error, PartialEq, Eq)]
#[non_exhaustive]
pub enum ResponseError {
    /// Invalid HEALPix resolution.
    #[error("nside {0}: expected a power of two from 1 to 512 for rows of the beam matrix")]
    Nside(usize),
    /// The sky and its directions differ in length.
    #[error("the sky has {sky} pixels but {directions} directions; expected equal numbers")]
    SkyLength {
        /// Number of sky values.
        sky: usize,
        /// Number of directions.
        directions: usize,
    },
}
