//! Configuration of the array.

mod propagate;

use std::path::PathBuf;

use serde::{Deserialize, Serialize};
use thiserror::Error;

use super::kepler::KeplerElements;
use super::stations::Stations;
use crate::units::constants::{DAY_S, MOON_RADIUS_M, YEAR_S};
use crate::units::time_scales::{Tai, TimeScale, utc_text};
use crate::units::{Checks, InvalidValue, MAX_SATELLITES, keys};

pub use propagate::{PropagateConfig, StationKeeping};

/// Sense of the precession of the ascending node.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum NodeMotion {
    /// Westward, as caused by lunar J2 for a prograde orbit.
    #[default]
    Regress,
    /// Eastward.
    Advance,
}

keys! {
    /// Orbit and formation; the defaults are the paper's fiducial array.
    pub struct ArrayConfig {
        /// Number of daughters on the circle, 3 to 64.
        everyday satellites: usize = 8;
        /// Altitude of the circular orbit, or of the semi-major axis.
        #[only_with("no array.kepler and no array.oem and no array.stations")]
        everyday altitude_m: f64 = 300e3;
        /// Radius of the Moon.
        expert moon_radius_m: f64 = MOON_RADIUS_M;
        /// Inclination to the ecliptic.
        #[only_with("no array.kepler and no array.oem and no array.stations")]
        everyday inclination_deg: f64 = 30.0;
        /// Orbital period.
        #[only_with("no array.kepler and no array.oem and no array.stations")]
        expert orbital_period_s: f64 = 8_248.68;
        /// Period of the precession of the node.
        #[only_with("no array.kepler and no array.oem and no array.stations")]
        expert precession_period_s: f64 = 1.3 * YEAR_S;
        /// Sense of the precession: "regress" or "advance".
        #[only_with("no array.kepler and no array.oem and no array.stations")]
        expert node_motion: NodeMotion = NodeMotion::Regress;
        /// Orbital phase of daughter 1 at the epoch.
        #[only_with("no array.kepler and no array.oem and no array.stations")]
        expert orbital_phase_deg: f64 = 0.0;
        /// Longitude of the ascending node at the epoch.
        #[only_with("no array.kepler and no array.oem and no array.stations")]
        expert node_longitude_deg: f64 = 0.0;
        /// Eccentricity of the formation's orbit.
        #[only_with("no array.kepler and no array.oem and no array.stations")]
        everyday eccentricity: f64 = 0.0;
        /// Argument of the periapsis at the epoch.
        #[only_with("no array.kepler and no array.oem and no array.stations")]
        expert periapsis_deg: f64 = 0.0;
        /// Rate of the argument of the periapsis.
        #[only_with("no array.kepler and no array.oem and no array.stations")]
        expert periapsis_rate_deg_per_day: f64 = 0.0;
        /// Maximum distance of each daughter from daughter 1 across the track, over that along it, by which their orbital
        /// planes differ.
        #[only_with("no array.kepler and no array.oem and no array.stations")]
        expert cross_track_ratio: f64 = 0.0;
        /// Ecliptic longitude of the Earth, seen from the Moon, at the epoch; it moves on a circle in the ecliptic, except with
        /// `oem` files and `stations`.
        #[only_with("no array.oem and no array.stations")]
        expert earth_longitude_deg: f64 = 0.0;
        /// Maximum arcs by which daughters 2, 3, ... trail daughter 1, ascending; empty for those of `breathing`.
        #[only_with("no array.kepler and no array.oem and no array.stations")]
        expert arcs_m: Vec<f64> = Vec::new();
        /// Kepler orbits, one per satellite, instead of the formation: `{ semi_major_axis_m = 2037.1e3, eccentricity = 0.01,
        /// inclination_deg = 30.0, node_longitude_deg = 0.0, periapsis_deg = 0.0, mean_anomaly_deg = 0.0 }` at the epoch, on
        /// ecliptic axes; optional `node_rate_deg_per_day` and `periapsis_rate_deg_per_day`.
        everyday kepler: Vec<KeplerElements> = Vec::new();
        /// CCSDS OEM files (KVN or XML, also gzip), one per satellite, or SPK kernels (.bsp), whose objects are satellites in order of
        /// appearance, instead of the formation. Their dates fix the mission's epoch and the Earth's position.
        everyday oem: Vec<PathBuf> = Vec::new();
        /// Epoch of the mission, in UTC if it ends with Z, else in the files' time system, such as 2030-01-31T12:00:00; empty for
        /// the latest of their first usable times.
        #[only_with("array.oem")]
        expert oem_epoch: String = String::new();
        /// Stations on the Moon instead of satellites: `{ longitude_deg = 180.0, latitude_deg = -30.0, height_m = 0.0 }` on its mean
        /// Earth axes (MOON_ME), one for each of `satellites`, or a CSV file with these columns. They turn with the Moon, see the sky
        /// above a flat horizon, and observe while the Earth is below that of the first.
        #[serde(skip_serializing_if = "Stations::is_empty")]
        expert stations: Stations = Stations::default();
        /// Epoch of a mission of stations, UTC, such as 2030-01-31T12:00:00.
        #[only_with("array.stations")]
        #[serde(skip_serializing_if = "String::is_empty")]
        expert stations_epoch: String = String::new();
        /// Numerical integration in the Moon's field (GRGM900C), from the formation at the epoch or from array.kepler. Periods,
        /// precession and rates are then ignored.
        #[serde(skip_serializing_if = "PropagateConfig::is_default")]
        section propagate: PropagateConfig = PropagateConfig::default();
        /// Contraction and expansion of the formation.
        #[only_with("no array.kepler and no array.oem and no array.stations")]
        section breathing: BreathingConfig = BreathingConfig::default();
    }
}

/// Quantity that grows by the same factor from daughter to daughter.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Spacing {
    /// The distance to the preceding daughter (the paper, Sect. 3.1): more daughters lie between the third and the
    /// last.
    #[default]
    Steps,
    /// The arc to daughter 1: more daughters lie close to the first two as well.
    Arcs,
}

keys! {
    /// Contraction and expansion of the formation along the track (the paper, Sect. 3.1).
    pub struct BreathingConfig {
        /// Period of contraction and expansion.
        expert period_s: f64 = 14.0 * DAY_S;
        /// Minimum distance of daughters 1 and 2.
        expert first_spacing_m_min: f64 = 100.0;
        /// Ratio R_2 of maximum to minimum distance of daughters 1 and 2.
        expert first_ratio: f64 = 6.0;
        /// Minimum distance of daughters 2 and 3, for four daughters or more whose steps grow.
        expert second_spacing_m_min: f64 = 500.0;
        /// Ratio R of maximum to minimum arc of daughters 3 and later.
        expert ratio: f64 = 3.0;
        /// Maximum arc from the first to the last daughter.
        everyday span_m_max: f64 = 100e3;
        /// What grows by a constant factor: the "steps" from daughter to daughter, or the "arcs" from daughter 1, which puts more
        /// daughters close to it.
        expert growing: Spacing = Spacing::Steps;
    }
}

/// Error of an array.
#[derive(Clone, Debug, Error, PartialEq)]
#[non_exhaustive]
pub enum ArrayError {
    /// A value of the configuration is not accepted.
    #[error(transparent)]
    Invalid(#[from] InvalidValue),
    /// A file of orbits, attitudes or stations cannot be used.
    #[error("{}: {what}", path.display())]
    File {
        /// The file.
        path: PathBuf,
        /// Problem in the file, and what was expected.
        what: String,
    },
    /// Positions are not known at a time.
    #[error(
        "t = {t_s} s: expected a time at which positions are known, {:.3} s to {:.3} s after the mission's epoch{}", known_s[0],
        known_s[1], epoch_text(*epoch_tai_s)
    )]
    NotKnown {
        /// The time, s after the mission's epoch.
        t_s: f64,
        /// First and last time at which positions are known, s.
        known_s: [f64; 2],
        /// Epoch, if the orbits have dates: TAI seconds since 1958.
        epoch_tai_s: Option<f64>,
    },
    /// A propagated satellite leaves its orbit.
    #[error(
        "array.propagate: satellite {satellite} is {:.1} km from the Moon's centre after {day:.2} days; expected orbits above \
         the surface: a higher one, fewer days, or station keeping of the orbit", radius_m / 1e3
    )]
    Strays {
        /// Number of the satellite, from 1.
        satellite: usize,
        /// Time, days after the epoch.
        day: f64,
        /// Distance from the Moon's centre, m.
        radius_m: f64,
    },
    /// Two satellites have the same position.
    #[error(
        "array: satellites {first} and {second} are at one place at the epoch: expected orbits, anomalies or stations that differ"
    )]
    OnePlace {
        /// The first one, from 1.
        first: usize,
        /// The second one, from 1.
        second: usize,
    },
    /// Two daughters meet.
    #[error(
        "array: daughters {} and {} would meet, or overtake each other, as the formation breathes: their arcs behind daughter 1 go \
         from {} m and {} m to {} m and {} m; expected ascending arcs at all times", first, first + 1, wide_m[0],
        wide_m[1], narrow_m[0], narrow_m[1]
    )]
    Meeting {
        /// The first one, from 1.
        first: usize,
        /// Maximum arcs of both, m.
        wide_m: [f64; 2],
        /// Minimum arcs of both, m.
        narrow_m: [f64; 2],
    },
    /// No geometric progression of spacings fits.
    #[error(
        "array.breathing: no progression of spacings fits {satellites} daughters between {first_m} m \
         and {span_m} m with a second step of {second_m} m; lower second_spacing_m_min or raise span_m_max"
    )]
    Progression {
        /// Number of daughters.
        satellites: usize,
        /// Arc of daughter 2, m.
        first_m: f64,
        /// Arc from daughter 2 to daughter 3, m.
        second_m: f64,
        /// Arc of the last daughter, m.
        span_m: f64,
    },
}

fn epoch_text(epoch_tai_s: Option<f64>) -> String {
    let utc_suffix = |tai_s| format!(", which is {} UTC", utc_text(tai_s));
    epoch_tai_s.map(utc_suffix).unwrap_or_default()
}

/// Maximum accepted radius or altitude, m: the Moon's sphere of influence has 6.6e7 m.
const ORBIT_M_MAX: f64 = 1e8;

impl ArrayConfig {
    /// Whether each satellite has its own orbit, instead of a formation on one.
    #[must_use]
    #[doc(hidden)]
    pub fn has_own_orbits(&self) -> bool {
        !self.kepler.is_empty() || self.is_dated() || self.propagate.is_on()
    }

    /// Whether the mission has dates, of files or of stations.
    pub(super) fn is_dated(&self) -> bool {
        !self.oem.is_empty() || !self.stations.is_empty()
    }

    /// Whether the array consists of stations on the Moon.
    #[must_use]
    #[doc(hidden)]
    pub fn is_on_surface(&self) -> bool {
        !self.stations.is_empty()
    }

    /// Epoch of a mission of stations.
    pub(super) fn stations_epoch(&self) -> Option<Tai> {
        let epoch = self.stations_epoch.strip_suffix('Z').unwrap_or(&self.stations_epoch);
        Tai::parse(epoch, TimeScale::Utc)
    }

    /// Whether all satellites follow each other on one circle.
    #[must_use]
    #[doc(hidden)]
    pub fn is_circle(&self) -> bool {
        !self.has_own_orbits() && self.eccentricity == 0.0 && self.cross_track_ratio == 0.0
    }

    /// Checks the date of the epoch.
    fn check_dates(&self, checks: &mut Checks) {
        let epoch = &self.oem_epoch;
        // Whether a second 60 exists depends on the files' time system.
        let is_date = |scale| Tai::parse(epoch, scale).is_some();
        let good = epoch.is_empty() || is_date(TimeScale::Tai) || is_date(TimeScale::Utc);
        let expected = "a date of the files' time system such as 2030-01-31T12:00:00, a date on UTC with Z at its end, or nothing";
        checks.require("oem_epoch", format_args!("{epoch:?}"), good, expected);
        let (epoch, good) =
            (&self.stations_epoch, self.stations.is_empty() || self.stations_epoch().is_some());
        let expected = "with array.stations, a date in UTC such as 2030-01-31T12:00:00";
        checks.require("stations_epoch", format_args!("{epoch:?}"), good, expected);
    }

    /// Checks the Moon, the circular orbit and its breathing.
    fn check_orbit(&self, checks: &mut Checks) {
        let breathing = &self.breathing;
        let count = self.satellites as f64;
        checks.number("satellites", count, (3..=MAX_SATELLITES).contains(&self.satellites), "3 to 64");
        // At larger distances the Moon does not hold satellites.
        for (key, value) in [("moon_radius_m", self.moon_radius_m), ("altitude_m", self.altitude_m)] {
            let inside = value > 0.0 && value <= ORBIT_M_MAX;
            checks.number(
                key,
                value,
                inside,
                "above 0 and at most 1e8 m, within the Moon's sphere of influence",
            );
        }
        for (key, value) in [
            ("breathing.first_spacing_m_min", breathing.first_spacing_m_min),
            ("breathing.second_spacing_m_min", breathing.second_spacing_m_min),
        ] {
            checks.number(key, value, value > 0.0, "a positive number");
        }
        for (key, value) in
            [("breathing.first_ratio", breathing.first_ratio), ("breathing.ratio", breathing.ratio)]
        {
            checks.number(key, value, value >= 1.0, "a number of at least 1");
        }
        for (key, period) in
            [("precession_period_s", self.precession_period_s), ("breathing.period_s", breathing.period_s)]
        {
            checks.number(key, period, period >= 100.0, "at least 100 s");
        }
        let period = self.orbital_period_s;
        // The limit bounds the number of windows in the longest mission to a million.
        checks.number("orbital_period_s", period, period >= 1e3, "at least 1000 s");
        let inclination = self.inclination_deg;
        checks.number("inclination_deg", inclination, (0.0..=180.0).contains(&inclination), "0 to 180");
    }

    /// Checks the eccentricity and the distances across the track.
    fn check_ellipse(&self, checks: &mut Checks) {
        let eccentricity = self.eccentricity;
        checks.number("eccentricity", eccentricity, (0.0..1.0).contains(&eccentricity), "0 to less than 1");
        let least_m = (self.moon_radius_m + self.altitude_m) * (1.0 - eccentricity);
        let above = !(0.0..1.0).contains(&eccentricity) || least_m > self.moon_radius_m;
        let expected = format!("a periapsis above the surface, not {:.0} m", least_m - self.moon_radius_m);
        checks.number("eccentricity", eccentricity, above, expected);
        let (rate, ratio) = (self.periapsis_rate_deg_per_day, self.cross_track_ratio);
        checks.number("periapsis_rate_deg_per_day", rate, rate.abs() <= 10.0, "-10 to 10 degrees a day");
        checks.number("cross_track_ratio", ratio, ratio.abs() <= 1.0, "-1 to 1");
    }

    /// Checks the arcs between satellites.
    fn check_arcs(&self, checks: &mut Checks) {
        let arcs = self.arcs_m.len();
        let fits = arcs == 0 || arcs + 1 == self.satellites;
        let expected = "an arc for each daughter but the first, or none";
        checks.require("arcs_m", format_args!("({arcs} values)"), fits, expected);
        let half_m = std::f64::consts::PI * (self.moon_radius_m + self.altitude_m);
        let expected = "m, above 0 and up to half of the orbit";
        checks.numbers("arcs_m", &self.arcs_m, |m| m > 0.0 && m <= half_m, expected);
        let (span_m, of_breathing) = (self.breathing.span_m_max, arcs == 0 && !self.has_own_orbits());
        let inside = span_m > 0.0 && (!of_breathing || span_m <= half_m);
        checks.number("breathing.span_m_max", span_m, inside, expected);
    }

    /// Checks orbits given for each satellite, by elements or in files.
    fn check_own_orbits(&self, checks: &mut Checks) {
        let (orbits, files) = (self.kepler.len(), self.oem.len());
        let given = format_args!("({orbits} orbits)");
        let fits = orbits == 0 || orbits == self.satellites;
        checks.require("kepler", given, fits, "one for each satellite, or none");
        let given = format_args!("({files} files)");
        // How many objects a kernel has is in the file.
        let is_kernel = |path: &PathBuf| path.to_string_lossy().to_lowercase().contains(".bsp");
        let has_kernel = self.oem.iter().any(is_kernel);
        let fits = files == 0 || files == self.satellites || (has_kernel && files < self.satellites);
        checks.require(
            "oem",
            given,
            fits,
            "one for each satellite, or none; an SPK kernel (.bsp) may be of several",
        );
        let one = files == 0 || orbits == 0;
        checks.require("oem", given, one, "none where array.kepler is given");
        let one = files == 0 || !self.propagate.is_on();
        checks.require("oem", given, one, "none where array.propagate.days is given");
        let one = self.stations.is_empty() || (files + orbits == 0 && !self.propagate.is_on());
        let expected = "none where array.kepler, array.oem or array.propagate.days is given";
        checks.require("stations", "(stations)", one, expected);
    }

    /// All invalid values; empty if there are none.
    #[must_use]
    #[doc(hidden)]
    pub fn problems(&self) -> Vec<InvalidValue> {
        let mut checks = Checks::new("array");
        self.check_orbit(&mut checks);
        self.check_ellipse(&mut checks);
        self.check_arcs(&mut checks);
        self.check_own_orbits(&mut checks);
        self.check_dates(&mut checks);
        for (key, value) in [
            ("orbital_phase_deg", self.orbital_phase_deg),
            ("node_longitude_deg", self.node_longitude_deg),
            ("periapsis_deg", self.periapsis_deg),
            ("earth_longitude_deg", self.earth_longitude_deg),
        ] {
            checks.number(key, value, true, "a finite number");
        }
        let mut found = checks.finish();
        found.extend(self.propagate.problems(self.satellites, !self.kepler.is_empty()));
        found.extend(self.stations.problems(self.satellites));
        let of_one =
            |(index, elements): (usize, &KeplerElements)| elements.problems(index, self.moon_radius_m);
        found.extend(self.kepler.iter().take(MAX_SATELLITES).enumerate().flat_map(of_one));
        found
    }
}
