//! The mother: integration of visibilities while the Earth is hidden, and the store that holds them
//! until it is in sight.
//!
//! There are two fidelities, which give the same frames: [`Integrator`] is the spacecraft at the level of
//! integrated visibilities, what the correlator would put out for a given sky, with thermal noise;
//! [`correlator`] makes them from the samples of [`crate::daughters`]. [`Ninth`] adds the spectra of one more daughter.
//! Uses [`crate::frames`], [`crate::array`], [`crate::sky`].

mod config;
pub mod correlator;
mod integrator;
mod ninth;
mod observer;
mod powers;
mod schedule;
mod store;

pub use config::{
    Antenna, BAND_HZ, CHANNELS_MAX, Fidelity, IntegrationTooShort, SpacecraftConfig, StoreDrop,
};
pub use integrator::{Integrator, MeasurementOptions, NoiseModel};
pub use ninth::{NINTH_BAND_HZ, Ninth, NinthConfig, NinthSetup, NinthSky};
pub use observer::Observer;
pub use schedule::{Integration, Schedule};
pub use store::{PacedLink, Store, VISIBILITY_BYTES};
