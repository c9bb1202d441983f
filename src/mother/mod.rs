//! The mother: integration of visibilities while the Earth is hidden, and the store that holds them
//! until it is in sight.
//!
//! There are two fidelities, which give the same frames: [`Integrator`] is the spacecraft at the level of
//! integrated visibilities, what the correlator would put out for a given sky, with thermal noise;
//! [`correlator`] makes them from the samples of [`crate::daughters`]. [`Ninth`] adds the spectra of one more daughter.
//! Uses [`crate::frames`], [`crate::array`], [`crate::sky`].

mod bandwidth;
mod choice;
mod config;
pub mod correlator;
mod direct;
mod harmonic;
mod integrator;
mod model;
mod ninth;
mod observer;
mod powers;
mod schedule;
mod store;

pub use bandwidth::BandAverage;
pub use choice::{Load, ModelChoice, ModelKind, ModelPlan};
pub use config::{Antenna, BAND_HZ, CHANNELS_MAX, Fidelity, SpacecraftConfig, SpacecraftError, StoreDrop};
pub use direct::DirectSum;
pub use harmonic::{HarmonicSetup, HarmonicSum};
pub use integrator::{Integrator, MeasurementOptions, NoiseModel};
pub use model::{DaughterPosition, ModelError, PairPosition, VisibilityModel};
pub use ninth::{NINTH_BAND_HZ, Ninth, NinthConfig, NinthSetup, NinthSky};
pub use observer::Observer;
pub use schedule::{Integration, Schedule};
pub use store::{PacedLink, Store, VISIBILITY_BYTES};
