//! Directions of the Earth and the Sun from the Moon's centre, and the Moon's orientation.
//!
//! Missions with dates use ephemerides of both. A mission without dates has an idealised Earth on a circle in the
//! ecliptic.

mod jupiter;
mod moon;
mod orientation;
mod sun;

use std::f64::consts::TAU;
use std::fmt;
use std::sync::Arc;

pub(super) use orientation::{MoonAxes, Orientation};

use super::config::ArrayConfig;
use crate::frames::EphemerisSegment;
use crate::sky::Body;
use crate::units::constants::SIDEREAL_MONTH_S;
use crate::units::time_scales::Tai;
use crate::units::vector::{Vec3, dot, norm, sub, unit};

/// Step of the table of directions, s: cubic interpolation of a motion of 13 degrees per day errs by 2e-10 rad.
const STEP_S: f64 = 3600.0;

/// Maximum length of the table, steps: 23 years. Beyond it directions come from the series, which takes 3 us.
const STEPS_MAX: f64 = 2e5;

/// Angle above the limb up to which the Earth counts as hidden, degrees: its radius seen from the Moon.
const LIMB_DEG: f64 = 1.0;

/// Model of the Earth's motion in a mission.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum EarthModel {
    /// Idealised Earth on a circle in the ecliptic: its longitude at the epoch, degrees.
    Circle(f64),
    /// Ephemeris of the Earth by date.
    Dated,
}

impl EarthModel {
    /// Model of the Earth for an array: orbits from files and stations have dates.
    #[must_use]
    pub fn of(config: &ArrayConfig) -> Self {
        match config.is_dated() {
            true => Self::Dated,
            false => Self::Circle(config.earth_longitude_deg),
        }
    }

    /// Direction of the Earth from the Moon's centre, some seconds after the mission's epoch (TAI since 1958-01-01, s).
    #[must_use]
    pub fn hat(self, epoch_tai_s: f64, t_s: f64) -> Vec3 {
        match self {
            Self::Circle(earth_deg) => Earth::Circle(earth_deg.to_radians()).hat(t_s),
            Self::Dated => earth_hat(Tai::from_seconds_since_1958(epoch_tai_s).plus_s(t_s)),
        }
    }
}

impl fmt::Display for EarthModel {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Circle(_) => f.write_str("idealised, on a circle in the ecliptic, whatever the date"),
            Self::Dated => f.write_str("where it is at the dates of the orbits"),
        }
    }
}

/// Whether the Moon hides the Earth, by its ephemeris, from satellite 1 at both ends of an ephemeris segment: to a
/// degree, the Earth's own radius. Segments of observing windows satisfy this, unless the mission's Earth is
/// idealised.
#[must_use]
#[doc(hidden)]
pub fn earth_is_hidden_by_date(segment: &EphemerisSegment, epoch_tai_s: f64, moon_radius_m: f64) -> bool {
    let last = segment.positions_m.len().saturating_sub(usize::from(segment.satellites));
    [(segment.start, 0), (segment.end(), last)].into_iter().all(|(time, place)| {
        segment.positions_m.get(place).is_some_and(|position_m| {
            let distance_m = norm(*position_m);
            let earth_hat = EarthModel::Dated.hat(epoch_tai_s, time.seconds());
            let from_nadir = (-dot(earth_hat, *position_m) / distance_m).clamp(-1.0, 1.0).acos();
            let limb = (moon_radius_m / distance_m).min(1.0).asin();
            from_nadir < limb + LIMB_DEG.to_radians()
        })
    })
}

/// Position of the Earth.
#[derive(Clone, Debug, PartialEq)]
pub(super) enum Earth {
    /// Idealised, on a circle in the ecliptic: its longitude at the epoch, rad.
    Circle(f64),
    /// Ephemeris by date.
    Dated(Arc<DatedEarth>),
}

impl Earth {
    /// Direction of the Earth from the Moon, some seconds after the mission's epoch.
    pub(super) fn hat(&self, t_s: f64) -> Vec3 {
        match self {
            Self::Circle(earth_rad) => {
                let (sin, cos) = (earth_rad + TAU * t_s / SIDEREAL_MONTH_S).sin_cos();
                [cos, sin, 0.0]
            }
            Self::Dated(earth) => earth.hat(t_s),
        }
    }
}

/// Ephemeris of the Earth by date, tabulated over the time of the mission.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct DatedEarth {
    epoch: Tai,
    /// Time of the first direction, s after the epoch.
    first_s: f64,
    earth_hat: Vec<Vec3>,
}

impl DatedEarth {
    /// Creates the ephemeris for a mission that starts at `epoch`, from one to another time after it, s.
    pub(super) fn new(epoch: Tai, [from_s, until_s]: [f64; 2]) -> Self {
        let steps = ((until_s - from_s) / STEP_S).ceil() + 3.0;
        let first_s = from_s - STEP_S;
        let count = if (0.0..=STEPS_MAX).contains(&steps) { steps as usize + 1 } else { 0 };
        let direction = |k: usize| earth_hat(epoch.plus_s(first_s + k as f64 * STEP_S));
        Self { epoch, first_s, earth_hat: (0..count).map(direction).collect() }
    }

    fn hat(&self, t_s: f64) -> Vec3 {
        let steps = (t_s - self.first_s) / STEP_S;
        let below = steps.floor();
        let places = if below >= 1.0 { self.earth_hat.get(below as usize - 1..) } else { None };
        let Some([a, b, c, d, ..]) = places else { return earth_hat(self.epoch.plus_s(t_s)) };
        // Lagrange polynomial through four nodes.
        let s = steps - below;
        let weights = [
            -s * (s - 1.0) * (s - 2.0) / 6.0,
            (s + 1.0) * (s - 1.0) * (s - 2.0) / 2.0,
            -(s + 1.0) * s * (s - 2.0) / 2.0,
            (s + 1.0) * s * (s - 1.0) / 6.0,
        ];
        let sum =
            |axis: usize| [a, b, c, d].into_iter().zip(weights).map(|(hat, weight)| weight * hat[axis]).sum();
        unit(std::array::from_fn(sum))
    }

    /// Direction of the Sun from the Moon.
    pub(super) fn sun_hat(&self, t_s: f64) -> Vec3 {
        sun_hat(self.epoch.plus_s(t_s))
    }
}

/// Direction of the Earth from the Moon, on ecliptic axes of J2000; to 0.004 degrees from 2020 to 2040.
///
/// Geometric direction: the Earth moves 40 km, 2e-3 degrees seen from the Moon, during the light travel time.
fn earth_hat(time: Tai) -> Vec3 {
    unit(sub([0.0; 3], moon::position_m(time.tt_centuries())))
}

/// Direction of the Sun from the Moon's centre some seconds after a mission's epoch (TAI since 1958-01-01, s), whether or not its
/// orbits have dates.
#[must_use]
#[doc(hidden)]
pub fn sun_hat_by_date(epoch_tai_s: f64, t_s: f64) -> Vec3 {
    sun_hat(Tai::from_seconds_since_1958(epoch_tai_s).plus_s(t_s))
}

/// Direction of Jupiter from the Moon's centre some seconds after a mission's epoch (TAI since 1958-01-01, s), on ecliptic axes of J2000;
/// geometric, to 0.03 degrees from 2020 to 2040.
#[must_use]
#[doc(hidden)]
pub fn jupiter_hat_by_date(epoch_tai_s: f64, t_s: f64) -> Vec3 {
    let centuries = Tai::from_seconds_since_1958(epoch_tai_s).plus_s(t_s).tt_centuries();
    let from_earth_m: Vec3 = {
        let (sun, jupiter) = (sun::position_m(centuries), jupiter::position_m(centuries));
        std::array::from_fn(|k| sun[k] + jupiter[k])
    };
    unit(sub(from_earth_m, moon::position_m(centuries)))
}

/// Direction of a body from the Moon's centre some seconds after a mission's epoch (TAI since 1958-01-01, s).
#[must_use]
#[doc(hidden)]
pub fn body_hat_by_date(body: Body, epoch_tai_s: f64, t_s: f64) -> Vec3 {
    match body {
        Body::Sun => sun_hat_by_date(epoch_tai_s, t_s),
        Body::Jupiter => jupiter_hat_by_date(epoch_tai_s, t_s),
    }
}

/// Direction of the Sun from the Moon, on ecliptic axes of J2000; geometric, to 0.002 degrees from 2020 to 2040.
fn sun_hat(time: Tai) -> Vec3 {
    let centuries = time.tt_centuries();
    unit(sub(sun::position_m(centuries), moon::position_m(centuries)))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::units::time_scales::TimeScale;

    /// Dates (UTC), and ecliptic longitude and latitude of the Earth and of the Sun from the Moon's centre, degrees.
    ///
    /// Made with astropy 8.0.2 and JPL's DE421: differences of `get_body_barycentric(body, Time(date, scale="utc"))`, turned about x
    /// by 84381.448 arc seconds. Another ephemeris than the series here, whose Moon is that of astropy's own.
    const PLACES: [(&str, [f64; 2], [f64; 2]); 17] = [
        ("2020-01-01T00:00:00", [165.8636, 4.8937], [279.5970, 0.0158]),
        ("2021-06-10T11:00:00", [259.5512, -0.8321], [79.5005, -0.0049]),
        ("2022-11-08T06:00:00", [223.0178, 0.0084], [225.4880, 0.0023]),
        ("2024-03-01T00:00:00", [40.1461, 2.1637], [340.6916, 0.0065]),
        ("2025-01-03T13:00:00", [148.2934, 2.6610], [282.9578, 0.0098]),
        ("2026-08-12T18:00:00", [319.8915, -0.8729], [139.6790, -0.0041]),
        ("2027-01-01T00:00:00", [24.2343, 4.6137], [280.0934, 0.0156]),
        ("2027-03-05T06:00:00", [128.7724, 1.0330], [344.1425, 0.0035]),
        ("2028-09-21T03:00:00", [31.6673, 4.9427], [178.1885, 0.0120]),
        ("2029-04-30T09:00:00", [66.9172, 2.4545], [39.9617, 0.0031]),
        ("2030-12-31T00:00:00", [182.2030, -4.7092], [278.7549, -0.0083]),
        ("2032-05-25T15:00:00", [71.1686, -2.7850], [64.5217, -0.0107]),
        ("2034-07-07T07:00:00", [171.8182, -0.3786], [104.9206, -0.0051]),
        ("2035-09-02T02:00:00", [338.9731, -0.3672], [158.9748, -0.0022]),
        ("2037-02-14T20:00:00", [141.9460, 1.3116], [325.9679, 0.0060]),
        ("2038-10-19T05:00:00", [271.0286, 0.1780], [205.5208, 0.0030]),
        ("2040-12-31T00:00:00", [61.2311, 0.7139], [279.4362, 0.0069]),
    ];

    fn towards([longitude_deg, latitude_deg]: [f64; 2]) -> Vec3 {
        let ((sin_l, cos_l), (sin_b, cos_b)) =
            (longitude_deg.to_radians().sin_cos(), latitude_deg.to_radians().sin_cos());
        [cos_b * cos_l, cos_b * sin_l, sin_b]
    }

    #[test]
    fn directions_agree_with_another_ephemeris() {
        for (date, earth, sun) in PLACES {
            let time = Tai::parse(date, TimeScale::Utc).unwrap();
            let off_deg = |found: Vec3, place| norm(sub(found, towards(place))).to_degrees();
            // The tolerance is the stated accuracy of the series, plus 1e-4 of rounding in the table above.
            let [earth_deg, sun_deg] = [off_deg(earth_hat(time), earth), off_deg(sun_hat(time), sun)];
            assert!(earth_deg < 0.004, "{date}: Earth off by {earth_deg} degrees");
            assert!(sun_deg < 0.002, "{date}: Sun off by {sun_deg} degrees");
        }
    }

    /// As above, of Jupiter.
    const JUPITER: [(&str, [f64; 2]); 7] = [
        ("2020-01-01T00:00:00", [276.3806, 0.0932]),
        ("2022-11-08T06:00:00", [358.8812, -1.5279]),
        ("2026-08-12T18:00:00", [129.1836, 0.4923]),
        ("2029-12-01T00:00:00", [224.1396, 0.9812]),
        ("2033-05-05T12:00:00", [332.9011, -0.8242]),
        ("2037-07-01T00:00:00", [97.9886, -0.0524]),
        ("2040-01-01T00:00:00", [180.9296, 1.2808]),
    ];

    #[test]
    fn jupiter_is_where_another_ephemeris_has_it() {
        for (date, place) in JUPITER {
            let epoch_tai_s = Tai::parse(date, TimeScale::Utc).unwrap().seconds_since_1958() - 1e5;
            let off_deg = norm(sub(jupiter_hat_by_date(epoch_tai_s, 1e5), towards(place))).to_degrees();
            // The stated accuracy: 78" seen from the Sun, up to a quarter more from the Earth.
            assert!(off_deg < 0.03, "{date}: {off_deg} degrees");
        }
    }

    #[test]
    fn a_table_of_directions_is_the_series() {
        let epoch = Tai::parse("2027-03-05T06:30:00", TimeScale::Utc).unwrap();
        let earth = DatedEarth::new(epoch, [-7200.0, 2.6e6]);
        for k in 0..3000 {
            // Times extend from before the table to beyond it.
            let t_s = -20e3 + 887.3 * f64::from(k);
            let [read, made] = [earth.hat(t_s), earth_hat(epoch.plus_s(t_s))];
            assert!(norm(sub(read, made)) < 1e-9, "{t_s}: {}", norm(sub(read, made)));
            assert!((dot(read, read) - 1.0).abs() < 1e-12);
        }
    }
}
