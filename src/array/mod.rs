//! Where the daughters are, what the Moon hides from them, and how a pair answers to the sky.
//!
//! Pure functions of time and position; uses [`crate::units`] and [`crate::sky`].
//!
//! Frame: centred on the Moon, ecliptic axes (x to ecliptic longitude 0, z to the north ecliptic pole).

mod config;
mod ephemeris;
mod formation;
mod integration;
mod orbit;
mod placing;
mod stretch;
mod windows;

pub use config::{ArrayConfig, ArrayError, BreathingConfig, NodeMotion};
pub use ephemeris::{Ephemeris, Insertion, segments_for};
pub use formation::Formation;
pub use integration::{IntegrationRule, integration_time_s};
pub use orbit::{Array, SatelliteState, hidden_by_moon};
pub use placing::PlacingCounts;
pub use stretch::stretched;
pub use windows::{ObservingWindows, earth_in_sight_s};
