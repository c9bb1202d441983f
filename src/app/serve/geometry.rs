//! Positions of the satellites, the Moon and the Earth, for `/api/geometry`.

use std::f64::consts::TAU;

use serde::Serialize;

use crate::array::{EarthModel, SatelliteState, hidden_by_moon};
use crate::ground::ArrayGeometry;
use crate::units::constants::MOON_GM_M3_S2;
use crate::units::vector::{Vec3, add, cross, dot, norm, scale, sub, unit};

const ORBIT_POINTS: u32 = 180;

/// Maximum eccentricity of an orbit that is drawn.
const ECCENTRICITY_MAX: f64 = 0.95;

/// Position of a satellite at the time of the latest data.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub(super) struct SatelliteNow {
    position_m: Vec3,
    /// Whether the Moon occults the Earth; `None` if the Earth's direction is unknown.
    earth_is_hidden: Option<bool>,
}

/// The array at the time of the latest data. Positions and directions are Moon-centred, in ecliptic axes.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub(super) struct Geometry {
    epoch_tai_s: f64,
    time_s: f64,
    moon_radius_m: f64,
    satellites: Vec<SatelliteNow>,
    /// Direction of the Earth according to the configuration; `None` if satellite 1 would have seen the Earth. As data are taken only
    /// while the Earth is occulted, the configuration is then not that of the data.
    earth_hat: Option<Vec3>,
    normal_hat: Vec3,
    /// Osculating Kepler orbit of satellite 1; empty if it is not closed.
    orbit_m: Vec<Vec3>,
    /// First and last time of the ephemeris segment in use, s.
    known_s: [f64; 2],
    /// Positions of satellite 1 in that segment.
    track_m: Vec<Vec3>,
}

impl Geometry {
    /// The geometry of an array, with the Earth according to a model.
    pub(super) fn new(array: &ArrayGeometry, earth: EarthModel) -> Self {
        let ArrayGeometry { epoch_tai_s, time_s, moon_radius_m, positions_m, motion, known_s, track_m } =
            array;
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

/// Points of the Kepler orbit with a given position and velocity, starting at the periapsis.
fn orbit_m(motion: &SatelliteState) -> Vec<Vec3> {
    let SatelliteState { position_m, velocity_m_s } = *motion;
    let momentum = cross(position_m, velocity_m_s);
    // The eccentricity vector, which points to the periapsis.
    let eccentricity_vector =
        sub(scale(MOON_GM_M3_S2.recip(), cross(velocity_m_s, momentum)), unit(position_m));
    let eccentricity = norm(eccentricity_vector);
    if eccentricity.is_nan() || eccentricity >= ECCENTRICITY_MAX {
        return Vec::new();
    }
    let along = unit(if eccentricity > 1e-9 { eccentricity_vector } else { position_m });
    let across = unit(cross(momentum, along));
    let parameter_m = dot(momentum, momentum) / MOON_GM_M3_S2;
    let point = |k: u32| {
        let (sin, cos) = (TAU * f64::from(k) / f64::from(ORBIT_POINTS)).sin_cos();
        let radius_m = parameter_m / (1.0 + eccentricity * cos);
        add(scale(radius_m * cos, along), scale(radius_m * sin, across))
    };
    (0..ORBIT_POINTS).map(point).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::array::{Array, ArrayConfig, KeplerElements};

    #[test]
    fn the_orbit_contains_the_positions_of_a_satellite() {
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
        let points_m = orbit_m(&array.state(0, 1234.5));
        assert_eq!(points_m.len(), 180);
        let period_s = array.orbital_period_s();
        for k in 0..100 {
            let position_m = array.position_m(0, period_s * f64::from(k) / 100.0);
            let nearest_m =
                points_m.iter().map(|point_m| norm(sub(*point_m, position_m))).fold(f64::INFINITY, f64::min);
            // Half the distance between two points at the apoapsis: 3125 km times 2 degrees.
            assert!(nearest_m < 0.5 * 3.2e6 * 0.035, "{k}: {nearest_m}");
        }
        let [periapsis_m, apoapsis_m] = [points_m[0], points_m[90]].map(norm);
        // Within the rounding of the velocity.
        assert!((periapsis_m / 1.875e6 - 1.0).abs() < 1e-9 && (apoapsis_m / 3.125e6 - 1.0).abs() < 1e-9);
        let unbound = SatelliteState { position_m: [2e6, 0.0, 0.0], velocity_m_s: [0.0, 2.3e3, 0.0] };
        assert_eq!(orbit_m(&unbound), Vec::<Vec3>::new());
    }
}
