//! Orbit and formation of the daughters, stations on the Moon, occultation by the Moon, observing windows, and the ephemeris.
//!
//! Pure functions of time and position; uses [`crate::units`], [`crate::frames`], and the names of bodies of [`crate::sky`].
//!
//! Coordinates are centred on the Moon, on ecliptic axes: x towards ecliptic longitude 0, z towards the north ecliptic
//! pole.

mod attitudes;
mod axes;
mod baseline;
mod bodies;
mod config;
mod ephemeris;
mod export;
mod formation;
mod integration;
mod interpolation;
mod kepler;
mod oem;
mod orbit;
mod placing;
mod propagate;
mod state;
mod stations;
mod surface;
mod track;
mod windows;

#[doc(hidden)]
pub use attitudes::Attitudes;
#[doc(hidden)]
pub use baseline::scaled_baseline;
#[doc(hidden)]
pub use bodies::{
    EarthModel, body_hat_by_date, earth_is_hidden_by_date, jupiter_hat_by_date, sun_hat_by_date,
};
pub use config::{ArrayConfig, ArrayError};
#[doc(hidden)]
pub use config::{BreathingConfig, NodeMotion, Spacing};
#[doc(hidden)]
pub use config::{PropagateConfig, StationKeeping};
pub use ephemeris::Ephemeris;
#[doc(hidden)]
pub use ephemeris::{Insertion, segments_for};
#[doc(hidden)]
pub use export::OemExport;
#[doc(hidden)]
pub use formation::{Formation, Progression};
pub use integration::{IntegrationRule, integration_time_s};
#[doc(hidden)]
pub use interpolation::interpolation_error_m;
#[doc(hidden)]
pub use kepler::KeplerElements;
#[doc(hidden)]
pub use orbit::is_underground;
pub use orbit::{Array, hidden_by_moon};
#[doc(hidden)]
pub use placing::PlacingCounts;
#[doc(hidden)]
pub use propagate::report_propagation_to;
pub use state::SatelliteState;
#[doc(hidden)]
pub use stations::{Station, Stations};
#[doc(hidden)]
pub use track::{orbit_normal_hat, tilted_axes, track_axes, track_offset_m};
#[doc(hidden)]
pub use windows::{EarthOccultation, ObservingWindows, earth_in_sight_s};
