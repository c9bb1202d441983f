//! Spherical harmonics: orthonormal, Condon-Shortley phase.

mod coefficients;

pub use coefficients::Alm;
