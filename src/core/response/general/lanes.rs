//! SIMD lanes: several pairs are computed at a time, one per lane.

pub(super) use crate::numerics::bessel::{LANES, Lanes};

/// Type of pattern coefficients. Its rounding changes a row by 1e-6 of the rms, of the 1e-4 allowed for interpolation.
pub(super) type Value = f32;

/// Number of values of all lanes at one degree and order: real and imaginary part of `f_{l mu}`, then of `(-1)^mu f_{l,-mu}`.
pub(super) const VALUES: usize = 4 * LANES;
