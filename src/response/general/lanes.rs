//! Pairs are computed several at a time: they are the lanes of vectors.

pub(super) use crate::numerics::bessel::{LANES, Lanes};

/// Type of patterns. Their sums keep 1e-6 of a row's rms, of the 1e-4 that interpolation may cost.
pub(super) type Value = f32;

/// Values of all pairs at one degree and order: real and imaginary part of `f_{l mu}`, then of `(-1)^mu f_{l,-mu}`, by lane.
pub(super) const VALUES: usize = 4 * LANES;
