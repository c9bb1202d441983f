//! General mathematics that several folders use: quadrature, interpolation, special functions, statistics. Knows no physics and
//! uses nothing of the crate.

pub(crate) mod bessel;
pub(crate) mod chebyshev;
mod fft_length;
mod lagrange;
pub(crate) mod legendre;
pub(crate) mod quadrature;
mod real;
pub(crate) mod scaled;
mod statistics;
pub(crate) mod trigonometry;
pub(crate) mod wigner;

pub(crate) use fft_length::fft_length;
pub(crate) use lagrange::lagrange;
pub use real::Real;
pub(crate) use statistics::{median, percentiles};
