//! Where the satellites, the Moon and the Earth are, as `/api/geometry` tells it.

use std::f64::consts::TAU;

use serde::Serialize;

use crate::array::{EarthModel, SatelliteState, hidden_by_moon};
use crate::ground::ArrayGeometry;
use crate::units::constants::MOON_GM_M3_S2;
use crate::units::vector::{Vec3, add, cross, dot, norm, scale, sub, unit};

/// Places of an orbit.
const ORBIT_PLACES: u32 = 180;

/// Greatest eccentricity of an orbit that is drawn.
const ECCENTRICITY_MAX: f64 = 0.95;

/// A satellite.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub(super) struct SatelliteNow {
    position_m: Vec3,
    /// `None` if it is not known where the Earth is.
    earth_is_hidden: Option<bool>,
}

/// The array at the time of the latest data. Positions and directions are Moon-centred, on ecliptic axes.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub(super) struct Geometry {
    epoch_tai_s: f64,
    time_s: f64,
    moon_radius_m: f64,
    satellites: Vec<SatelliteNow>,
    /// Direction of the Earth by the configuration; `None` if it would have been in sight of satellite 1, which observes
    /// when it is hidden: the configuration is not that of the data.
    earth_hat: Option<Vec3>,
    normal_hat: Vec3,
    /// The orbit about the Moon alone that satellite 1 is on at that time; empty if it is not closed.
    orbit_m: Vec<Vec3>,
    /// First and last time of the positions that came together, s.
    known_s: [f64; 2],
    /// Where satellite 1 was between those.
    track_m: Vec<Vec3>,
}

impl Geometry {
    /// The geometry of an array, with the Earth of a model.
    pub(super) fn of(now: &ArrayGeometry, earth: EarthModel) -> Self {
        let ArrayGeometry { epoch_tai_s, time_s, moon_radius_m, positions_m, motion, known_s, track_m } = now;
        let is_hidden =
            |position_m: Vec3, earth_hat: Vec3| hidden_by_moon(position_m, earth_hat, *moon_radius_m);
        let earth_hat = earth.hat(*epoch_tai_s, *time_s);
        let is_plausible =
            |earth_hat: &Vec3| positions_m.first().is_some_and(|first| is_hidden(*first, *earth_hat));
        let earth_hat = Some(earth_hat).filter(is_plausible);
        let satellite = |&position_m: &Vec3| SatelliteNow {
            position_m,
            earth_is_hidden: earth_hat.map(|earth_hat| is_hidden(position_m, earth_hat)),
        };
        Self {
            epoch_tai_s: *epoch_tai_s,
            time_s: *time_s,
            moon_radius_m: *moon_radius_m,
            satellites: positions_m.iter().map(satellite).collect(),
            earth_hat,
            normal_hat: unit(cross(motion.position_m, motion.velocity_m_s)),
            orbit_m: orbit_m(motion),
            known_s: *known_s,
            track_m: track_m.clone(),
        }
    }
}

/// Places of the Kepler orbit through a position with a velocity, from the periapsis on.
fn orbit_m(motion: &SatelliteState) -> Vec<Vec3> {
    let SatelliteState { position_m, velocity_m_s } = *motion;
    let momentum = cross(position_m, velocity_m_s);
    // Towards the periapsis, as long as the eccentricity.
    let towards = sub(scale(MOON_GM_M3_S2.recip(), cross(velocity_m_s, momentum)), unit(position_m));
    let eccentricity = norm(towards);
    if eccentricity.is_nan() || eccentricity >= ECCENTRICITY_MAX {
        return Vec::new();
    }
    let along = unit(if eccentricity > 1e-9 { towards } else { position_m });
    let across = unit(cross(momentum, along));
    let parameter_m = dot(momentum, momentum) / MOON_GM_M3_S2;
    let place = |k: u32| {
        let (sin, cos) = (TAU * f64::from(k) / f64::from(ORBIT_PLACES)).sin_cos();
        let radius_m = parameter_m / (1.0 + eccentricity * cos);
        add(scale(radius_m * cos, along), scale(radius_m * sin, across))
    };
    (0..ORBIT_PLACES).map(place).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::array::{Array, ArrayConfig, KeplerElements};

    #[test]
    fn the_orbit_is_that_on_which_a_satellite_goes_round() {
        let elements = |mean_anomaly_deg| KeplerElements {
            semi_major_axis_m: 2.5e6,
            eccentricity: 0.25,
            inclination_deg: 50.0,
            node_longitude_deg: 40.0,
            periapsis_deg: 70.0,
            mean_anomaly_deg,
            node_rate_deg_per_day: 0.0,
            periapsis_rate_deg_per_day: 0.0,
        };
        let kepler = vec![elements(-10.0), elements(-20.0), elements(-30.0)];
        let array = Array::new(&ArrayConfig { satellites: 3, kepler, ..ArrayConfig::default() }).unwrap();
        let places_m = orbit_m(&array.state(0, 1234.5));
        assert_eq!(places_m.len(), 180);
        let period_s = array.orbital_period_s();
        for k in 0..100 {
            let there_m = array.position_m(0, period_s * f64::from(k) / 100.0);
            let nearest_m =
                places_m.iter().map(|place_m| norm(sub(*place_m, there_m))).fold(f64::INFINITY, f64::min);
            // Half the way from one place to the next, at the apoapsis: 3125 km by 2 degrees.
            assert!(nearest_m < 0.5 * 3.2e6 * 0.035, "{k}: {nearest_m}");
        }
        let [least_m, most_m] = [places_m[0], places_m[90]].map(norm);
        // To the rounding of a velocity.
        assert!((least_m / 1.875e6 - 1.0).abs() < 1e-9 && (most_m / 3.125e6 - 1.0).abs() < 1e-9);
        let lost = SatelliteState { position_m: [2e6, 0.0, 0.0], velocity_m_s: [0.0, 2.3e3, 0.0] };
        assert_eq!(orbit_m(&lost), Vec::<Vec3>::new());
    }
}
