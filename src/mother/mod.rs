//! The mother: integration of visibilities while the Moon hides the Earth, and the onboard store that holds them until
//! the Earth is in sight.
//!
//! The space segment has two fidelities with the same output frames. [`Integrator`] simulates integrated visibilities:
//! the prediction of a model plus thermal noise. [`correlator`] computes them from the samples of [`crate::daughters`].
//! Where memory has no room for the models of all channels, integrators of groups of them leave their visibilities on disk
//! ([`SpoolWriter`]), and a [`Merger`] makes the frames. [`Ninth`] adds the spectra of a ninth daughter, [`Store`] buffers the frames until a pass.
//!
//! May use [`crate::frames`], [`crate::array`], [`crate::response`], [`crate::daughters`] and [`crate::runtime`].
//! Only the frames in [`crate::frames`] leave this folder, and only bytes in [`crate::downlink`] reach the ground. The
//! store drops nothing silently: what it drops is counted in the housekeeping frame.

mod config;
pub mod correlator;
mod integrator;
mod merger;
mod ninth;
mod observer;
mod powers;
mod receiver;
mod schedule;
mod sizes;
mod spool;
mod store;
mod thinning;
mod troubles;

pub use config::{
    Antenna, BAND_HZ, CHANNELS_MAX, Fidelity, IntegrationTooShort, MoonMirror, SpacecraftConfig, StoreDrop,
};
pub use integrator::{ChannelModel, Integrator, MeasurementOptions, NoiseModel};
pub use merger::Merger;
pub use ninth::{NINTH_BAND_HZ, Ninth, NinthConfig, NinthSetup, NinthSky};
pub use observer::Observer;
pub use receiver::ReceiverNoise;
pub use schedule::{Integration, Schedule};
pub use sizes::VISIBILITY_BYTES;
pub use spool::{SpoolError, SpoolReader, SpoolWriter};
pub use store::{PacedLink, Store};
pub use thinning::{WindowThinning, largest_gap};
