//! The sky: HEALPix maps and their files, spherical harmonics, spectra, generated skies.
//!
//! Uses [`crate::units`] only.

pub mod generated;
pub mod harmonics;
pub mod healpix;
