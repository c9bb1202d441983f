//! Places of stations on the Moon.

use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};

use crate::units::constants::MOON_RELIEF_M;
use crate::units::{Checks, InvalidValue, MAX_SATELLITES};

/// Place of a station on the Moon, on the mean Earth and polar axes (MOON_ME).
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Station {
    /// East longitude from the mean direction of the Earth, degrees.
    pub longitude_deg: f64,
    /// Latitude, degrees.
    pub latitude_deg: f64,
    /// Height above the sphere of `array.moon_radius_m`, m.
    #[serde(default)]
    pub height_m: f64,
}

/// Stations, given one by one or in a file.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(
    untagged,
    expecting = "expected a list of { longitude_deg = .., latitude_deg = .., height_m = .. }, or a CSV file"
)]
pub enum Stations {
    /// A CSV file with the columns longitude_deg, latitude_deg, height_m.
    File(PathBuf),
    /// One by one.
    List(Vec<Station>),
}

impl Default for Stations {
    fn default() -> Self {
        Self::List(Vec::new())
    }
}

impl Stations {
    /// Whether there are none.
    #[must_use]
    #[doc(hidden)]
    pub fn is_empty(&self) -> bool {
        matches!(self, Self::List(stations) if stations.is_empty())
    }

    /// The file, if they are in one.
    #[must_use]
    #[doc(hidden)]
    pub fn file(&self) -> Option<&Path> {
        match self {
            Self::File(path) => Some(path),
            Self::List(_) => None,
        }
    }

    /// Invalid values among those that are given one by one.
    pub(super) fn problems(&self, satellites: usize) -> Vec<InvalidValue> {
        let mut checks = Checks::new("array");
        if let Self::List(stations) = self {
            let count = stations.len();
            let fits = count == 0 || count == satellites;
            let expected = format!(
                "as many as array.satellites, at most {MAX_SATELLITES}: the limit of the downlink's format"
            );
            checks.require("stations", format_args!("({count} stations)"), fits, expected);
            for (index, station) in stations.iter().take(MAX_SATELLITES).enumerate() {
                station.check(&format!("stations[{index}]."), &mut checks);
            }
        }
        checks.finish()
    }
}

impl Station {
    /// Checks its values, whose keys begin with `key`.
    pub(super) fn check(&self, key: &str, checks: &mut Checks) {
        let Self { longitude_deg, latitude_deg, height_m } = *self;
        for (name, value, most, expected) in [
            ("longitude_deg", longitude_deg, 360.0, "-360 to 360"),
            ("latitude_deg", latitude_deg, 90.0, "-90 to 90"),
            ("height_m", height_m, MOON_RELIEF_M, "m, within 12 km, the relief of the Moon"),
        ] {
            checks.number(format!("{key}{name}"), value, value.abs() <= most, expected);
        }
    }
}
