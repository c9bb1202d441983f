//! General mathematics: quadrature, interpolation, special functions, statistics, small dense matrices. Contains no physics and
//! uses no other module of the crate.

pub(crate) mod bessel;
pub(crate) mod chebyshev;
mod cholesky;
mod fft_length;
mod lagrange;
pub(crate) mod legendre;
pub(crate) mod quadrature;
mod real;
pub(crate) mod scaled;
mod statistics;
pub(crate) mod trigonometry;
pub(crate) mod wigner;

pub(crate) use cholesky::DenseFactor;
pub(crate) use fft_length::fft_length;
pub(crate) use lagrange::lagrange_weights;
pub use real::Real;
pub(crate) use statistics::SIGMA_OF_MEDIAN;
pub use statistics::{median, percentiles};
