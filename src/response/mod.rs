//! The beam matrix B: what each pair of daughters measures of the sky.
//!
//! `V_ij(nu) = Int T(n) A(n) S_i(n) S_j(n) exp(-2 pi i (nu/c) n . r_ij) dn`, in K sr (the paper, Eq. 7); a row of B is the
//! integrand without T, pixel by pixel or harmonic by harmonic.
//!
//! | module | holds |
//! |---|---|
//! | [`pixel`] | rows of B over HEALPix pixels, and direct sums over a sky |
//! | [`harmonic`] | rows of B over spherical harmonics, for satellites on one circle |
//! | [`model`] | visibilities of a given sky, by either of the two |
//!
//! Uses [`crate::units`], [`crate::frames`], [`crate::sky`] and [`mod@crate::array`]. Simulation and mapping both use it,
//! so it is tested against values of independent code.

pub mod harmonic;
pub mod model;
pub mod pixel;
