//! Spherical harmonics: orthonormal, Condon-Shortley phase.

mod analysis;
mod coefficients;
mod error;
mod kernel;
mod lanes;
mod recurrence;
mod rings;
mod rotated;
pub(crate) mod scaled;
mod transform;
mod wigner;

pub use analysis::{Analysis, AnalysisOptions, Method, analysis, synthesis};
pub use coefficients::Alm;
pub use error::HarmonicsError;
pub use transform::{L_MAX, Transform};
pub use wigner::{WignerRows, WignerTable, wigner_d};
