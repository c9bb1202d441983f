//! Spherical harmonics, orthonormal with Condon-Shortley phase: coefficients, transforms, rotations.
//!
//! | entry point | provides |
//! |---|---|
//! | [`Transform`] | synthesis of HEALPix maps and its transpose, after libsharp |
//! | [`analysis()`] | coefficients of a map |
//! | [`Alm`] | coefficients of a real field; [`Alm::rotated`] rotates them to another frame |
//! | [`times_direction`] | the product of a field and a component of the direction |
//! | [`WignerTable`] | Wigner's d-functions |
//!
//! Results do not depend on the number of threads.

mod analysis;
mod coefficients;
mod directions;
mod error;
mod kernel;
mod lanes;
mod recurrence;
mod rings;
mod rotated;
mod transform;

#[doc(hidden)]
pub use crate::numerics::wigner::{WignerRows, WignerTable, wigner_d};
#[doc(hidden)]
pub use analysis::Method;
pub use analysis::{Analysis, AnalysisOptions, analysis, synthesis};
pub use coefficients::Alm;
#[doc(hidden)]
pub use directions::{Component, times_direction, times_direction_transposed};
pub use error::HarmonicsError;
#[doc(hidden)]
pub use transform::{L_MAX, Transform};
