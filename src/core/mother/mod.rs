//! The mother: integration of visibilities while the Moon hides the Earth, and the onboard store that holds them until
//! the Earth is in sight.
//!
//! The space segment has two fidelities with the same output frames. [`Integrator`] simulates integrated
//! visibilities: the prediction of a model plus thermal noise and errors. [`correlator`] computes them from the
//! samples of [`crate::daughters`]. If the models of all channels do not fit into memory, they are simulated in
//! groups: [`SpoolWriter`] writes the visibilities of a group to disk, and a [`Merger`] combines the groups.
//! [`Ninth`] adds the spectra of a ninth daughter. [`Store`] buffers the frames until a pass.
//!
//! Only the frames in [`crate::frames`] leave this folder, and only bytes in [`crate::downlink`] reach the ground.
//! The housekeeping frame counts what the store drops.

mod config;
pub mod correlator;
mod integrator;
mod merger;
mod moving;
mod ninth;
mod noise;
mod observer;
mod pair_errors;
mod powers;
mod receiver;
mod schedule;
mod sizes;
mod spool;
mod store;
mod thinning;

pub use config::{
    Antenna, BAND_HZ, CHANNELS_MAX, Fidelity, IntegrationTooShort, MoonMirror, SpacecraftConfig, StoreDrop,
};
pub use integrator::{ChannelModel, Integrator, MeasurementOptions};
pub use merger::Merger;
pub use moving::{MovingSky, SteadyPoints};
pub use ninth::{NINTH_BAND_HZ, Ninth, NinthConfig, NinthSetup, NinthSky};
pub use noise::NoiseModel;
pub use observer::Observer;
pub use receiver::ReceiverNoise;
pub use schedule::{Integration, Schedule};
pub use sizes::VISIBILITY_BYTES;
pub use spool::{SpoolError, SpoolReader, SpoolWriter};
pub use store::{PacedLink, Store};
pub use thinning::{WindowThinning, largest_gap};
