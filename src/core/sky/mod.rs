//! The sky: HEALPix maps and their files, spherical harmonics, spectra, generated skies.
//!
//! | module | holds |
//! |---|---|
//! | [`healpix`] | pixel numbers and directions |
//! | [`fits`] | reading and writing map files |
//! | [`harmonics`] | coefficients, transforms, rotations |
//! | [`spectra`] | power spectra and Gaussian smoothing |
//! | [`generated`] | a model of the Galactic and extragalactic sky |
//!
//! Maps ([`SkyMap`]) are in RING order and K; all computation is on ecliptic axes ([`Frame::Ecliptic`]).

mod compare;
mod config;
mod correlated;
mod cutout;
mod error;
pub mod fits;
mod frame;
pub mod generated;
pub mod harmonics;
pub mod healpix;
mod map;
mod moving;
mod rotation;
pub mod spectra;

pub use compare::{Comparison, compare};
#[doc(hidden)]
pub use compare::{ErrorSummary, InputSky, compare_with};
#[doc(hidden)]
pub use config::{GENERATED_NSIDE_MAX, MapFrequency, SkyConfig};
#[doc(hidden)]
pub use cutout::{Cutout, PlaneProjection};
pub use error::MapError;
pub use frame::Frame;
#[doc(hidden)]
pub use frame::{Rotation, rotate};
pub use map::SkyMap;
#[doc(hidden)]
pub use map::{TEMPERATURE_K_MAX, is_unseen};
#[doc(hidden)]
pub use moving::{Body, MovingDirection, MovingSource, ecliptic_deg, k_sr_per_jy};
#[doc(hidden)]
pub use rotation::Bilinear;
