//! Kepler orbits: an ellipse for each satellite, whose plane and line of apsides may rotate at constant rates.

use std::f64::consts::TAU;

use serde::{Deserialize, Serialize};

use super::state::SatelliteState;
use crate::units::constants::{DAY_S, MOON_GM_M3_S2};
use crate::units::vector::{Vec3, add, cross, scale};
use crate::units::{Checks, InvalidValue};

/// Maximum semi-major axis, m: the Moon's sphere of influence is 66,000 km.
const SEMI_MAJOR_AXIS_M_MAX: f64 = 6.6e7;

/// Maximum number of Newton iterations: five are usual, and a dozen for eccentricities near one.
const STEPS_MAX: usize = 64;

/// Elements of one satellite's orbit about the Moon at the mission epoch, on ecliptic axes.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct KeplerElements {
    /// Semi-major axis, m.
    pub semi_major_axis_m: f64,
    /// Eccentricity, from 0 to less than 1.
    pub eccentricity: f64,
    /// Inclination to the ecliptic, degrees.
    pub inclination_deg: f64,
    /// Longitude of the ascending node, degrees.
    pub node_longitude_deg: f64,
    /// Argument of the periapsis, degrees.
    pub periapsis_deg: f64,
    /// Mean anomaly, degrees.
    pub mean_anomaly_deg: f64,
    /// Rate of the node, degrees per day.
    #[serde(default)]
    pub node_rate_deg_per_day: f64,
    /// Rate of the argument of the periapsis, degrees per day.
    #[serde(default)]
    pub periapsis_rate_deg_per_day: f64,
}

impl KeplerElements {
    /// Invalid elements of satellite `index`, from 0, above a Moon of a radius; empty if there are none.
    pub(super) fn problems(&self, index: usize, moon_radius_m: f64) -> Vec<InvalidValue> {
        let mut checks = Checks::new("array");
        let key = |name: &str| format!("kepler[{index}].{name}");
        let eccentricity = self.eccentricity;
        let bound = (0.0..1.0).contains(&eccentricity);
        let expected = "0 to less than 1: other orbits are not closed (parabolic, hyperbolic)";
        checks.number(key("eccentricity"), eccentricity, bound, expected);
        let axis_m = self.semi_major_axis_m;
        let least_m = axis_m * (1.0 - eccentricity);
        let expected = format!("a periapsis above the surface, {moon_radius_m} m, and an axis up to 6.6e7 m");
        let is_above = !bound || least_m > moon_radius_m && axis_m <= SEMI_MAJOR_AXIS_M_MAX;
        checks.number(key("semi_major_axis_m"), axis_m, is_above, expected);
        let inclination_deg = self.inclination_deg;
        let inside = (0.0..=180.0).contains(&inclination_deg);
        checks.number(key("inclination_deg"), inclination_deg, inside, "0 to 180");
        for (name, value) in [
            ("node_longitude_deg", self.node_longitude_deg),
            ("periapsis_deg", self.periapsis_deg),
            ("mean_anomaly_deg", self.mean_anomaly_deg),
        ] {
            checks.number(key(name), value, true, "a finite number");
        }
        for (name, value) in [
            ("node_rate_deg_per_day", self.node_rate_deg_per_day),
            ("periapsis_rate_deg_per_day", self.periapsis_rate_deg_per_day),
        ] {
            checks.number(key(name), value, value.abs() <= 10.0, "-10 to 10 degrees a day");
        }
        checks.finish()
    }
}

/// Motion on an orbit with given elements.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct KeplerOrbit {
    axes_m: [f64; 2],
    eccentricity: f64,
    inclination_rad: f64,
    /// Mean anomaly, argument of the periapsis and node: values at the epoch, rad, and their rates, rad/s.
    anomaly: [f64; 2],
    periapsis: [f64; 2],
    node: [f64; 2],
}

impl KeplerOrbit {
    pub(super) fn new(elements: &KeplerElements) -> Self {
        Self::about(elements, MOON_GM_M3_S2)
    }

    /// Creates the motion about a mass with this GM, m^3/s^2.
    pub(super) fn about(elements: &KeplerElements, gm_m3_s2: f64) -> Self {
        let &KeplerElements { semi_major_axis_m: axis_m, eccentricity, .. } = elements;
        let rate = |deg_per_day: f64| deg_per_day.to_radians() / DAY_S;
        Self {
            axes_m: [axis_m, axis_m * (1.0 - eccentricity * eccentricity).sqrt()],
            eccentricity,
            inclination_rad: elements.inclination_deg.to_radians(),
            anomaly: [elements.mean_anomaly_deg.to_radians(), (gm_m3_s2 / axis_m.powi(3)).sqrt()],
            periapsis: [elements.periapsis_deg.to_radians(), rate(elements.periapsis_rate_deg_per_day)],
            node: [elements.node_longitude_deg.to_radians(), rate(elements.node_rate_deg_per_day)],
        }
    }

    pub(super) fn semi_major_axis_m(&self) -> f64 {
        self.axes_m[0]
    }

    pub(super) fn apoapsis_m(&self) -> f64 {
        self.axes_m[0] * (1.0 + self.eccentricity)
    }

    pub(super) fn inclination_rad(&self) -> f64 {
        self.inclination_rad
    }

    pub(super) fn period_s(&self) -> f64 {
        TAU / self.anomaly[1]
    }

    /// Normal of the orbit's plane.
    pub(super) fn normal_hat(&self, t_s: f64) -> Vec3 {
        let (sin_o, cos_o) = (self.node[0] + self.node[1] * t_s).sin_cos();
        let (sin_i, cos_i) = self.inclination_rad.sin_cos();
        [sin_i * sin_o, -sin_i * cos_o, cos_i]
    }

    /// Position and velocity (Murray & Dermott, Solar System Dynamics, Sect. 2.4 and 2.8).
    pub(super) fn state(&self, t_s: f64) -> SatelliteState {
        let at = |[start, rate]: [f64; 2]| start + rate * t_s;
        let anomaly = eccentric_anomaly(at(self.anomaly), self.eccentricity);
        let (sin, cos) = anomaly.sin_cos();
        let [a_m, b_m] = self.axes_m;
        let anomaly_rate = self.anomaly[1] / (1.0 - self.eccentricity * cos);
        let plane_m = [a_m * (cos - self.eccentricity), b_m * sin];
        let plane_m_s = [-a_m * anomaly_rate * sin, b_m * anomaly_rate * cos];
        let (sin_w, cos_w) = at(self.periapsis).sin_cos();
        let (sin_o, cos_o) = at(self.node).sin_cos();
        let (sin_i, cos_i) = self.inclination_rad.sin_cos();
        let to_periapsis =
            [cos_o * cos_w - sin_o * sin_w * cos_i, sin_o * cos_w + cos_o * sin_w * cos_i, sin_w * sin_i];
        let beside =
            [-cos_o * sin_w - sin_o * cos_w * cos_i, -sin_o * sin_w + cos_o * cos_w * cos_i, cos_w * sin_i];
        let in_space = |[x, y]: [f64; 2]| add(scale(x, to_periapsis), scale(y, beside));
        let position_m = in_space(plane_m);
        // The line of apsides rotates about the orbit's normal, the node about the pole.
        let turning = add(scale(self.periapsis[1], self.normal_hat(t_s)), [0.0, 0.0, self.node[1]]);
        SatelliteState { position_m, velocity_m_s: add(in_space(plane_m_s), cross(turning, position_m)) }
    }
}

/// Solves `E - e sin E = M` for E by Newton's method.
pub(super) fn eccentric_anomaly(mean_rad: f64, eccentricity: f64) -> f64 {
    // M is reduced to -pi to pi, where the start converges for every ellipse.
    let mean = mean_rad - TAU * (mean_rad / TAU).round();
    let mut anomaly = if eccentricity > 0.8 { std::f64::consts::PI.copysign(mean) } else { mean };
    for _ in 0..STEPS_MAX {
        let (sin, cos) = anomaly.sin_cos();
        let step = (anomaly - eccentricity * sin - mean) / (1.0 - eccentricity * cos);
        anomaly -= step;
        if step.abs() <= f64::EPSILON {
            break;
        }
    }
    anomaly
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::array::{Array, ArrayConfig, ArrayError};
    use crate::units::vector::{dot, norm, sub, unit};

    const ELEMENTS: KeplerElements = KeplerElements {
        semi_major_axis_m: 2.5e6,
        eccentricity: 0.25,
        inclination_deg: 50.0,
        node_longitude_deg: 40.0,
        periapsis_deg: 70.0,
        mean_anomaly_deg: 10.0,
        node_rate_deg_per_day: 0.0,
        periapsis_rate_deg_per_day: 0.0,
    };

    /// The same motion by integration of `r'' = -GM r / r^3` with the fourth-order Runge-Kutta method.
    fn integrated(start: SatelliteState, to_s: f64, steps: usize) -> SatelliteState {
        let h = to_s / steps as f64;
        let pull = |r: Vec3| scale(-MOON_GM_M3_S2 / norm(r).powi(3), r);
        let (mut r, mut v) = (start.position_m, start.velocity_m_s);
        for _ in 0..steps {
            let (r1, v1) = (v, pull(r));
            let (r2, v2) = (add(v, scale(0.5 * h, v1)), pull(add(r, scale(0.5 * h, r1))));
            let (r3, v3) = (add(v, scale(0.5 * h, v2)), pull(add(r, scale(0.5 * h, r2))));
            let (r4, v4) = (add(v, scale(h, v3)), pull(add(r, scale(h, r3))));
            let sum = |a: Vec3, b: Vec3, c: Vec3, d: Vec3| add(add(a, d), scale(2.0, add(b, c)));
            r = add(r, scale(h / 6.0, sum(r1, r2, r3, r4)));
            v = add(v, scale(h / 6.0, sum(v1, v2, v3, v4)));
        }
        SatelliteState { position_m: r, velocity_m_s: v }
    }

    #[test]
    fn motion_is_that_of_a_point_mass() {
        for eccentricity in [0.0, 0.25, 0.6, 0.9] {
            let elements = KeplerElements { eccentricity, semi_major_axis_m: 2e7, ..ELEMENTS };
            let orbit = KeplerOrbit::new(&elements);
            let start = orbit.state(0.0);
            for part in [0.3, 0.77, 1.6] {
                let t_s = part * orbit.period_s();
                let (found, expected) = (orbit.state(t_s), integrated(start, t_s, 200_000));
                // The tolerance is the integration's own error: h^4 of its 1e5 steps per orbit, more at a close
                // periapsis, and rounding.
                assert!(norm(sub(found.position_m, expected.position_m)) < 1e-2, "{eccentricity} {part}");
                assert!(norm(sub(found.velocity_m_s, expected.velocity_m_s)) < 1e-5, "{eccentricity} {part}");
            }
        }
    }

    #[test]
    fn elements_have_their_standard_meaning() {
        let orbit = KeplerOrbit::new(&KeplerElements { mean_anomaly_deg: 0.0, ..ELEMENTS });
        let SatelliteState { position_m, velocity_m_s } = orbit.state(0.0);
        // At periapsis the distance is a (1 - e), and the speed follows from the vis-viva equation.
        assert!((norm(position_m) - 1.875e6).abs() < 1e-6);
        let speed_m_s = (MOON_GM_M3_S2 * (2.0 / 1.875e6 - 1.0 / 2.5e6)).sqrt();
        assert!((norm(velocity_m_s) - speed_m_s).abs() < 1e-9);
        let normal = unit(cross(position_m, velocity_m_s));
        assert!((normal[2] - 50_f64.to_radians().cos()).abs() < 1e-12);
        // The node lies 70 degrees before it, at a longitude of 40 degrees.
        let (sin, cos) = 40_f64.to_radians().sin_cos();
        assert!((dot(unit(position_m), [cos, sin, 0.0]) - 70_f64.to_radians().cos()).abs() < 1e-12);
        // The sine of the latitude is sin i times the sine of the argument.
        let height = 50_f64.to_radians().sin() * 70_f64.to_radians().sin();
        assert!((unit(position_m)[2] - height).abs() < 1e-12);
    }

    #[test]
    fn planes_and_apsides_rotate_at_the_given_rates() {
        let turning =
            KeplerElements { node_rate_deg_per_day: -0.75, periapsis_rate_deg_per_day: 1.25, ..ELEMENTS };
        let orbit = KeplerOrbit::new(&turning);
        let later_s = 20.0 * DAY_S;
        let turned = KeplerElements {
            node_longitude_deg: ELEMENTS.node_longitude_deg - 15.0,
            periapsis_deg: ELEMENTS.periapsis_deg + 25.0,
            ..ELEMENTS
        };
        let (found, expected) = (orbit.state(later_s), KeplerOrbit::new(&turned).state(later_s));
        // Angles of some radians, to rounding.
        assert!(norm(sub(found.position_m, expected.position_m)) < 1e-6);
        // The velocity is the rate of the position: differences over 2 s, whose error is h^2 / 6 of the third derivative,
        // some w^3 r = 1e-3 m/s^3.
        let (before, after) = (orbit.state(later_s - 1.0), orbit.state(later_s + 1.0));
        let rate = scale(0.5, sub(after.position_m, before.position_m));
        assert!(norm(sub(rate, found.velocity_m_s)) < 1e-3);
        assert!(norm(sub(rate, expected.velocity_m_s)) > 1e-1);
    }

    #[test]
    fn an_ellipse_without_eccentricity_is_the_circle() {
        let circle = ArrayConfig::default();
        let axis_m = circle.moon_radius_m + circle.altitude_m;
        let period_s = TAU / (MOON_GM_M3_S2 / axis_m.powi(3)).sqrt();
        let circle = Array::new(&ArrayConfig { orbital_period_s: period_s, ..circle }).unwrap();
        let round = |arc_m: f64| KeplerElements {
            semi_major_axis_m: axis_m,
            eccentricity: 0.0,
            inclination_deg: 30.0,
            node_longitude_deg: 0.0,
            periapsis_deg: 0.0,
            mean_anomaly_deg: -(arc_m / axis_m).to_degrees(),
            // One revolution in 1.3 years, backwards.
            node_rate_deg_per_day: -360.0 / (1.3 * 365.25),
            periapsis_rate_deg_per_day: 0.0,
        };
        let array = Array::new(&config([0.0, 5e3, 9e3].map(round).to_vec())).unwrap();
        for t_s in [0.0, 1e5, 3e7] {
            // Rounding of an angle of 3e4 rad.
            assert!(norm(sub(array.position_m(0, t_s), circle.position_m(0, t_s))) < 1e-4);
            assert!(norm(sub(array.normal_hat(0, t_s), circle.orbit_normal_hat(t_s))) < 1e-12);
        }
        let windows = |array: &Array| -> Vec<f64> {
            let windows = crate::array::ObservingWindows::new(array, 0.0, 1e5);
            windows.flat_map(|window| [window.start.seconds(), window.end.seconds()]).collect()
        };
        let (found, expected) = (windows(&array), windows(&circle));
        assert!(found.len() > 10 && found.len() == expected.len());
        // Both searches are exact to a tick.
        assert!(found.iter().zip(&expected).all(|(found, expected)| (found - expected).abs() < 3e-6));
    }

    #[test]
    fn a_formation_follows_the_ellipses_of_its_elements() {
        let axis_m = 2_037_100.0;
        let still = ArrayConfig {
            satellites: 3,
            arcs_m: vec![5e3, 9e3],
            breathing: crate::array::BreathingConfig {
                first_ratio: 1.0,
                ratio: 1.0,
                ..crate::array::BreathingConfig::default()
            },
            orbital_period_s: TAU / (MOON_GM_M3_S2 / f64::powi(axis_m, 3)).sqrt(),
            orbital_phase_deg: 50.0,
            node_longitude_deg: 20.0,
            eccentricity: 0.1,
            periapsis_deg: 30.0,
            periapsis_rate_deg_per_day: 1.25,
            cross_track_ratio: 0.02,
            ..ArrayConfig::default()
        };
        let array = Array::new(&still).unwrap();
        assert!(array.formation().is_none() && !still.is_circle());
        let elements = |arc_m: f64| KeplerElements {
            semi_major_axis_m: axis_m,
            eccentricity: 0.1,
            inclination_deg: 30.0 + (0.02 * arc_m / axis_m).to_degrees(),
            node_longitude_deg: 20.0,
            periapsis_deg: 30.0,
            mean_anomaly_deg: 20.0 - (arc_m / axis_m).to_degrees(),
            node_rate_deg_per_day: -360.0 / (1.3 * 365.25),
            periapsis_rate_deg_per_day: 1.25,
        };
        for (n, arc_m) in [0.0, 5e3, 9e3].into_iter().enumerate() {
            // The mean anomaly is counted from the periapsis, which moves; an orbit's own elements do not follow it.
            let drift = 1.25_f64.to_radians() / DAY_S;
            for t_s in [0.0, 1e3, 1e5] {
                let mut own = elements(arc_m);
                own.mean_anomaly_deg -= (drift * t_s).to_degrees();
                let expected = KeplerOrbit::new(&own).state(t_s);
                let found = array.state(n, t_s);
                assert!(norm(sub(found.position_m, expected.position_m)) < 1e-5, "{n} {t_s}");
                assert!(dot(array.normal_hat(n, t_s), unit(found.position_m)).abs() < 1e-12);
            }
        }
        // While it breathes, too, the velocity is the rate of the position.
        let breathing = ArrayConfig { arcs_m: Vec::new(), breathing: Default::default(), ..still };
        let array = Array::new(&breathing).unwrap();
        for n in 0..3 {
            let [before, at, after] = [-1.0, 0.0, 1.0].map(|s| array.state(n, 3e5 + s));
            let rate = scale(0.5, sub(after.position_m, before.position_m));
            // The error is h^2 / 6 of the third derivative, as above.
            assert!(norm(sub(rate, at.velocity_m_s)) < 1e-3, "{n}");
        }
    }

    #[test]
    fn impossible_shapes_of_a_formation_are_refused_by_name() {
        let refused = |change: fn(&mut ArrayConfig), expected: &str| {
            let mut config = ArrayConfig::default();
            change(&mut config);
            let told = Array::new(&config).unwrap_err().to_string();
            assert!(told.contains(expected), "{told}");
        };
        refused(|c| c.eccentricity = 1.0, "array.eccentricity = 1: expected 0 to less than 1");
        refused(|c| c.eccentricity = f64::NAN, "array.eccentricity = NaN");
        refused(|c| c.eccentricity = 0.2, "array.eccentricity = 0.2: expected a periapsis above the surface");
        refused(|c| c.cross_track_ratio = 2.0, "array.cross_track_ratio = 2");
    }

    fn config(kepler: Vec<KeplerElements>) -> ArrayConfig {
        ArrayConfig { satellites: kepler.len(), kepler, ..ArrayConfig::default() }
    }

    #[test]
    fn impossible_orbits_are_refused_by_name() {
        let refused = |change: fn(&mut KeplerElements), expected: &str| {
            let others = [20.0, 30.0].map(|mean_anomaly_deg| KeplerElements { mean_anomaly_deg, ..ELEMENTS });
            let mut kepler = vec![ELEMENTS];
            kepler.extend(others);
            change(&mut kepler[1]);
            let told = Array::new(&config(kepler)).unwrap_err().to_string();
            assert!(told.contains(expected), "{told}");
        };
        refused(|e| e.eccentricity = 1.5, "kepler[1].eccentricity = 1.5: expected 0 to less than 1");
        refused(|e| e.eccentricity = f64::NAN, "kepler[1].eccentricity = NaN");
        refused(
            |e| e.eccentricity = 0.5,
            "kepler[1].semi_major_axis_m = 2500000: expected a periapsis above",
        );
        refused(|e| e.semi_major_axis_m = -1e7, "kepler[1].semi_major_axis_m");
        refused(|e| e.inclination_deg = 200.0, "kepler[1].inclination_deg");
        refused(|e| e.mean_anomaly_deg = f64::INFINITY, "kepler[1].mean_anomaly_deg");
        refused(|e| *e = ELEMENTS, "satellites 1 and 2 are at one place");
        let mut short = config(vec![ELEMENTS; 3]);
        short.satellites = 4;
        assert!(Array::new(&short).unwrap_err().to_string().contains("array.kepler = (3 orbits)"));
        assert!(matches!(Array::new(&config(vec![ELEMENTS; 3])), Err(ArrayError::OnePlace { .. })));
    }
}
