//! The sky: HEALPix maps and their files, spherical harmonics, spectra, generated skies.
//!
//! Uses [`crate::units`] only.

mod compare;
mod config;
mod error;
pub mod fits;
mod frame;
pub mod generated;
pub mod harmonics;
pub mod healpix;
mod map;
mod rotation;
pub mod spectra;

pub use compare::{Comparison, ErrorSummary, compare};
pub use config::{GENERATED_NSIDE_MAX, SkyConfig};
pub use error::MapError;
pub use frame::{Frame, Rotation, rotate};
pub use map::{SkyMap, is_unseen};
pub use rotation::Bilinear;
