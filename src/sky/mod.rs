//! The sky: HEALPix maps and their files, spherical harmonics, spectra, generated skies.
//!
//! Uses [`crate::units`] only.

pub mod harmonics;
pub mod healpix;
