//! The mother: integration of visibilities while the Moon hides the Earth, and the onboard store that holds them until
//! the Earth is in sight.
//!
//! The space segment has two fidelities with the same output frames. [`Integrator`] simulates integrated visibilities:
//! the prediction of a model plus thermal noise. [`correlator`] computes them from the samples of [`crate::daughters`].
//! [`Ninth`] adds the spectra of a ninth daughter, [`Store`] buffers the frames until a pass.
//!
//! May use [`crate::frames`], [`crate::array`], [`crate::response`], [`crate::daughters`] and [`crate::runtime`].
//! Only the frames in [`crate::frames`] leave this folder, and only bytes in [`crate::downlink`] reach the ground. The
//! store drops nothing silently: what it drops is counted in the housekeeping frame.

mod config;
pub mod correlator;
mod integrator;
mod ninth;
mod observer;
mod powers;
mod schedule;
mod store;
mod troubles;

pub use config::{
    Antenna, BAND_HZ, CHANNELS_MAX, Fidelity, IntegrationTooShort, SpacecraftConfig, StoreDrop,
    VISIBILITY_BYTES,
};
pub use integrator::{Integrator, MeasurementOptions, NoiseModel};
pub use ninth::{NINTH_BAND_HZ, Ninth, NinthConfig, NinthSetup, NinthSky};
pub use observer::Observer;
pub use schedule::{Integration, Schedule};
pub use store::{PacedLink, Store};
