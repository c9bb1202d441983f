//! The sky: HEALPix maps and their files, spherical harmonics, spectra, generated skies.
//!
//! Uses [`crate::units`] only.

mod error;
pub mod fits;
mod frame;
pub mod generated;
pub mod harmonics;
pub mod healpix;
mod map;

pub use error::MapError;
pub use frame::{Frame, Rotation, rotate};
pub use map::{SkyMap, is_unseen};
