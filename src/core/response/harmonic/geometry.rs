//! Conversion of two positions to the rotation and the lengths that the harmonic basis needs.
//!
//! With `y = (r_i - r_j) / b`, x the direction of the mid-point, `z = x cross y`, the matrix of columns x, y, z is
//!
//! ```text
//! R = Rz(Omega) Rx(i) Rz(phi):   x_z = sin i sin phi,  y_z = sin i cos phi,
//!                                z = (sin i sin Omega, -sin i cos Omega, cos i)
//! ```
//!
//! For two satellites at the same distance from the Moon's centre this is exact, whatever their orbits, because any two
//! directions define a plane. The plane of a pair off the common track has its own node and inclination.
//!
//! The harmonic basis has one inclination i0. Of all rotations with this inclination, the nearest to R has the Omega and phi of R:
//! in unit quaternions the scalar product of two rotations is
//!
//! ```text
//! cos(i/2) cos(i0/2) cos((dOmega + dphi)/2) + sin(i/2) sin(i0/2) cos((dOmega - dphi)/2)
//! ```
//!
//! whose maximum, `cos((i - i0)/2)`, is where both differences vanish. The remaining error is a rotation by `i - i0`
//! about the line of nodes. [`GeometryLimits`] bounds this error and the altitude; pairs beyond the limits are refused.

use thiserror::Error;

use super::PairState;
use crate::units::keys;
use crate::units::vector::{Vec3, add, cross, dot, norm, scale, sub};

/// Orientation of a pair's own frame as Euler angles, and the lengths of the pair.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PairOrientation {
    /// Longitude Omega of the ascending node of the pair's plane, rad.
    pub node_rad: f64,
    /// Inclination of the pair's plane, rad; above pi/2 if satellite j leads on a prograde orbit.
    pub inclination_rad: f64,
    /// Phase phi of the mid-point in the pair's plane, rad from the node.
    pub phase_rad: f64,
    /// Length of the baseline, m.
    pub baseline_m: f64,
    /// Mean distance of the satellites from the Moon's centre, m.
    pub radius_m: f64,
    /// Distance of satellite i minus distance of satellite j, m.
    pub radius_difference_m: f64,
}

keys! {
    /// Maximum departures from the nominal orbit that are accepted.
    ///
    /// Pairs within the limits are approximated. The rms error over the rms visibility is, for a diffuse sky with a monopole
    /// (`tests/physics/departures.rs`):
    ///
    /// | u = b / wavelength | 0.1 deg, l <= 64 | l <= 191 | 5 km, l <= 64 | l <= 191 |
    /// |---|---|---|---|---|
    /// | 3 | 0.4 % | 0.4 % | 9 % | 10 % |
    /// | 10 | 0.8 % | 0.9 % | 13 % | 14 % |
    /// | 30 | 1.1 % | 3.1 % | 34 % | 39 % |
    /// | 120 | 0.9 % | 2.1 % | 57 % | 68 % |
    ///
    /// A tilt of 0.1 deg costs a few per cent. 5 km of altitude cost more: they move the Moon's limb by 0.23 deg, and on long
    /// baselines a sky without small scales is visible only at the limb. The default limit of 150 m keeps errors below 2 % at
    /// all of these u.
    #[derive(Copy)]
    pub struct GeometryLimits {
        /// Angle between a baseline and the orbital plane.
        expert out_of_track_deg_max: f64 = 0.1;
        /// Deviation of the inclination from its nominal value.
        expert inclination_deg_max: f64 = 0.1;
        /// Deviation of the altitude from its nominal value.
        expert altitude_m_max: f64 = 150.0;
        /// Angle between a baseline and the horizontal at its mid-point, from unequal altitudes.
        expert radial_deg_max: f64 = 0.1;
    }
}

impl GeometryLimits {
    /// Returns the keys and values of the limits.
    #[must_use]
    pub fn values(&self) -> [(&'static str, f64); 4] {
        [
            ("limits.out_of_track_deg_max", self.out_of_track_deg_max),
            ("limits.inclination_deg_max", self.inclination_deg_max),
            ("limits.altitude_m_max", self.altitude_m_max),
            ("limits.radial_deg_max", self.radial_deg_max),
        ]
    }
}

/// Circular orbit that the harmonic basis assumes.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct NominalOrbit {
    /// Inclination, rad.
    pub inclination_rad: f64,
    /// Distance from the Moon's centre, m.
    pub radius_m: f64,
    /// Accepted departures.
    pub limits: GeometryLimits,
}

/// A pair projected onto the nominal orbit.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct NominalPair {
    /// Instantaneous state.
    pub state: PairState,
    /// Whether satellite j leads; V_ij is then the conjugate of the visibility of `state`.
    pub reversed: bool,
}

/// Why the harmonic basis does not cover a pair.
#[derive(Clone, Copy, Debug, Error, PartialEq, Eq, Hash, PartialOrd, Ord)]
#[non_exhaustive]
pub enum GeometryRefusal {
    /// A position is not finite, or is at the Moon's centre.
    #[error("a position is not finite")]
    NotFinite,
    /// Both satellites are at one position, or opposite each other.
    #[error("the baseline has no direction")]
    Degenerate,
    /// The plane of the pair differs from the plane of the orbit.
    #[error("out of the orbit's plane")]
    Inclination,
    /// The pair is too high or too low.
    #[error("off the orbit's altitude")]
    Altitude,
    /// One satellite is much higher than the other.
    #[error("unequal altitudes of a pair")]
    UnequalRadii,
}

impl GeometryRefusal {
    /// All refusals, as tables of counts list them.
    pub const ALL: [Self; 5] =
        [Self::NotFinite, Self::Degenerate, Self::Inclination, Self::Altitude, Self::UnequalRadii];
}

/// Shortest baseline with a defined direction, m: rounding of positions rotates shorter ones by more than 1e-6 rad.
const BASELINE_M_MIN: f64 = 1e-3;

impl PairOrientation {
    /// Inclination of the pair's plane, rad, of a prograde orbit: where satellite j leads, the plane's normal is reversed.
    pub(crate) fn prograde_inclination_rad(&self) -> f64 {
        self.inclination_rad.min(std::f64::consts::PI - self.inclination_rad)
    }

    /// Computes the orientation of a pair at these positions (m, Moon-centred, ecliptic axes).
    ///
    /// # Errors
    /// [`GeometryRefusal::NotFinite`], [`GeometryRefusal::Degenerate`].
    #[inline]
    pub fn of_pair(r_i_m: Vec3, r_j_m: Vec3) -> Result<Self, GeometryRefusal> {
        let (difference, sum) = (sub(r_i_m, r_j_m), add(r_i_m, r_j_m));
        let baseline_m = norm(difference);
        let (radius_i_m, radius_j_m) = (norm(r_i_m), norm(r_j_m));
        let all = baseline_m + radius_i_m + radius_j_m;
        // Lengths are sums of squares, so that any value that is not finite shows here.
        if !(all.is_finite() && radius_i_m > 0.0 && radius_j_m > 0.0) {
            return Err(GeometryRefusal::NotFinite);
        }
        let y = scale(1.0 / baseline_m, difference);
        // Orthogonal to the baseline even if the distances differ.
        let outward = sub(sum, scale(dot(sum, y), y));
        let outward_m = norm(outward);
        if !(baseline_m > BASELINE_M_MIN && outward_m > BASELINE_M_MIN) {
            return Err(GeometryRefusal::Degenerate);
        }
        let x = scale(1.0 / outward_m, outward);
        Ok(Self {
            baseline_m,
            radius_m: 0.5 * (radius_i_m + radius_j_m),
            radius_difference_m: radius_i_m - radius_j_m,
            ..Self::of_axes(x, y)
        })
    }

    /// Computes the orientation of one satellite, a pair of length 0, at a position (m, Moon-centred, ecliptic axes) on an orbit
    /// with this normal.
    ///
    /// # Errors
    /// [`GeometryRefusal::NotFinite`], [`GeometryRefusal::Degenerate`] for a position along the normal.
    pub fn of_satellite(r_m: Vec3, normal_hat: Vec3) -> Result<Self, GeometryRefusal> {
        let radius_m = norm(r_m);
        if !(radius_m.is_finite() && norm(normal_hat).is_finite() && radius_m > 0.0) {
            return Err(GeometryRefusal::NotFinite);
        }
        let (x, along) = (scale(1.0 / radius_m, r_m), cross(normal_hat, r_m));
        let along_m = norm(along);
        if along_m <= BASELINE_M_MIN {
            return Err(GeometryRefusal::Degenerate);
        }
        Ok(Self { radius_m, ..Self::of_axes(x, scale(1.0 / along_m, along)) })
    }

    /// Computes the angles of two orthogonal axes; lengths are 0.
    #[inline]
    fn of_axes(x: Vec3, y: Vec3) -> Self {
        let z = cross(x, y);
        let sin_inclination = z[0].hypot(z[1]);
        // In the ecliptic the node is undefined: the phase counts from an arbitrary direction.
        let node = if sin_inclination > 0.0 {
            [-z[1] / sin_inclination, z[0] / sin_inclination]
        } else {
            [1.0, 0.0]
        };
        Self {
            node_rad: node[1].atan2(node[0]),
            inclination_rad: sin_inclination.atan2(z[2]),
            phase_rad: (-y[0] * node[0] - y[1] * node[1]).atan2(x[0] * node[0] + x[1] * node[1]),
            baseline_m: 0.0,
            radius_m: 0.0,
            radius_difference_m: 0.0,
        }
    }
}

impl NominalOrbit {
    /// Projects a pair onto this orbit: the result has the node, phase and baseline of the pair, and the inclination and radius
    /// of the orbit.
    ///
    /// # Errors
    /// [`GeometryRefusal`] for a departure from the orbit that exceeds the limits.
    #[inline]
    pub fn pair(
        &self,
        orientation: &PairOrientation,
        wavelength_m: f64,
    ) -> Result<NominalPair, GeometryRefusal> {
        use std::f64::consts::PI;
        let limits = &self.limits;
        let reversed = (orientation.inclination_rad - self.inclination_rad).abs()
            > (PI - orientation.inclination_rad - self.inclination_rad).abs();
        // Exchanging i and j reverses y and z: a rotation by pi about x.
        let (node_rad, inclination_rad, phase_rad) = if reversed {
            (orientation.node_rad + PI, PI - orientation.inclination_rad, PI - orientation.phase_rad)
        } else {
            (orientation.node_rad, orientation.inclination_rad, orientation.phase_rad)
        };
        // Two positions do not distinguish a tilted pair from a tilted orbit.
        let tilt_rad_max = (limits.out_of_track_deg_max + limits.inclination_deg_max).to_radians();
        if (inclination_rad - self.inclination_rad).abs() > tilt_rad_max {
            return Err(GeometryRefusal::Inclination);
        }
        if (orientation.radius_m - self.radius_m).abs() > limits.altitude_m_max {
            return Err(GeometryRefusal::Altitude);
        }
        if orientation.radius_difference_m.abs() > limits.radial_deg_max.to_radians() * orientation.baseline_m
        {
            return Err(GeometryRefusal::UnequalRadii);
        }
        let baseline_wavelengths = orientation.baseline_m / wavelength_m;
        Ok(NominalPair {
            state: PairState { node_rad, phase_rad, baseline_wavelengths, span_rad: 0.0 },
            reversed,
        })
    }
}

#[cfg(test)]
mod tests {
    use std::f64::consts::{PI, TAU};

    use super::*;
    use crate::array::{Array, ArrayConfig};
    use crate::response::harmonic::runs::wrap;
    use crate::units::all_pairs;

    const RADIUS_M: f64 = 2_037_100.0;

    type Matrix = [[f64; 3]; 3];

    fn about_z(angle: f64) -> Matrix {
        let (s, c) = angle.sin_cos();
        [[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]
    }

    fn about_x(angle: f64) -> Matrix {
        let (s, c) = angle.sin_cos();
        [[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]]
    }

    fn product(a: Matrix, b: Matrix) -> Matrix {
        std::array::from_fn(|i| std::array::from_fn(|j| (0..3).map(|k| a[i][k] * b[k][j]).sum()))
    }

    fn rotation(node: f64, inclination: f64, phase: f64) -> Matrix {
        product(product(about_z(node), about_x(inclination)), about_z(phase))
    }

    fn apply(r: Matrix, v: Vec3) -> Vec3 {
        std::array::from_fn(|i| dot(r[i], v))
    }

    #[test]
    fn one_satellite_has_the_frame_of_a_pair_about_it() {
        let array = Array::new(&ArrayConfig::default()).unwrap();
        for t_s in [0.0, 1234.5, 7e6] {
            let (r_m, normal_hat) = (array.position_m(2, t_s), array.orbit_normal_hat(t_s));
            let (behind, ahead) = (array.position_m(2, t_s - 1.0), array.position_m(2, t_s + 1.0));
            let single = PairOrientation::of_satellite(r_m, normal_hat).unwrap();
            let about = PairOrientation::of_pair(ahead, behind).unwrap();
            for (found, expected) in [
                (single.node_rad, about.node_rad),
                (single.inclination_rad, about.inclination_rad),
                (single.phase_rad, about.phase_rad),
            ] {
                // The node moves by 3e-7 rad in these 2 s, 2e-4 of the motion along the orbit.
                assert!(wrap(found - expected).abs() < 3e-4, "{t_s}: {found} {expected}");
            }
            // The daughters are in their plane; rounding of 2e6 m.
            assert!(dot(normal_hat, r_m).abs() < 1e-8 && (norm(normal_hat) - 1.0).abs() < 1e-15);
            assert_eq!((single.baseline_m, single.radius_difference_m), (0.0, 0.0));
        }
        assert_eq!(
            PairOrientation::of_satellite([0.0, 0.0, 1e6], [0.0, 0.0, 1.0]),
            Err(GeometryRefusal::Degenerate)
        );
        assert_eq!(
            PairOrientation::of_satellite([f64::NAN; 3], [0.0, 0.0, 1.0]),
            Err(GeometryRefusal::NotFinite)
        );
    }

    /// A pair at angles +-`half` from the body's x axis.
    fn pair(r: Matrix, half: f64) -> [Vec3; 2] {
        [half, -half].map(|at| apply(r, [RADIUS_M * at.cos(), RADIUS_M * at.sin(), 0.0]))
    }

    fn nominal(inclination_rad: f64) -> NominalOrbit {
        let limits = GeometryLimits { altitude_m_max: 5e3, ..GeometryLimits::default() };
        NominalOrbit { inclination_rad, radius_m: RADIUS_M, limits }
    }

    #[test]
    fn angles_are_those_of_the_rotation() {
        for k in 0..500 {
            let k = f64::from(k);
            let (node, phase) = ((0.731 * k).rem_euclid(TAU), (1.377 * k).rem_euclid(TAU));
            let inclination = 0.01 + (0.0173 * k).rem_euclid(3.1);
            let half = 2.5e-5 * 1.01_f64.powf(k);
            let [r_i, r_j] = pair(rotation(node, inclination, phase), half);
            let found = PairOrientation::of_pair(r_i, r_j).unwrap();
            // Positions of 2e6 m are rounded to 5e-10 m, which turns the shortest baseline, 100 m, by 5e-12.
            // Near the ecliptic the node is poorly determined.
            let bound = 1e-10 / inclination.sin();
            assert!(wrap(found.node_rad - node).abs() < bound, "{k}");
            assert!(wrap(found.phase_rad - phase).abs() < bound, "{k}");
            assert!((found.inclination_rad - inclination).abs() < 1e-10, "{k}");
            assert!((found.baseline_m - 2.0 * RADIUS_M * half.sin()).abs() < 1e-8, "{k}");
            assert!((found.radius_m - RADIUS_M).abs() < 1e-8 && found.radius_difference_m.abs() < 1e-8);
        }
    }

    #[test]
    fn the_array_s_own_pairs_are_on_its_orbit() {
        let array = Array::new(&ArrayConfig::default()).unwrap();
        let orbit = nominal(PI / 6.0);
        for t_s in [0.0, 1e4, 3.3e5, 8.1e6, 4.09e7] {
            for p in all_pairs(8) {
                let [i, j] = [p.i, p.j].map(usize::from);
                let found =
                    PairOrientation::of_pair(array.position_m(i, t_s), array.position_m(j, t_s)).unwrap();
                assert!((found.inclination_rad - PI / 6.0).abs() < 1e-9, "{p} {t_s}");
                let node = -TAU * t_s / (1.3 * 365.25 * 86_400.0);
                assert!(wrap(found.node_rad - node).abs() < 1e-9, "{p} {t_s}");
                let arcs = [i, j].map(|n| array.formation().unwrap().arc_m(n, t_s).0 / RADIUS_M);
                let phase = TAU * (t_s / 8_248.68).fract() - 0.5 * (arcs[0] + arcs[1]);
                assert!(wrap(found.phase_rad - phase).abs() < 1e-9, "{p} {t_s}");
                let placed = orbit.pair(&found, 30.0).unwrap();
                let u = 2.0 * RADIUS_M * (0.5 * (arcs[1] - arcs[0])).sin() / 30.0;
                // The last bit of an orbital phase is 7 um after 1.3 years.
                assert!((placed.state.baseline_wavelengths - u).abs() < 1e-6 && !placed.reversed);
            }
        }
    }

    /// Exchanged satellites have the same rotation, and the flag for conjugation.
    #[test]
    fn a_pair_that_trails_is_turned_round() {
        for (node, inclination, phase) in [(0.4, 0.5, 2.0), (5.0, 2.6, -1.0), (3.0, 0.01, 4.4)] {
            let [r_i, r_j] = pair(rotation(node, inclination, phase), 0.01);
            let orbit = nominal(inclination);
            let forth = orbit.pair(&PairOrientation::of_pair(r_i, r_j).unwrap(), 30.0).unwrap();
            let back = orbit.pair(&PairOrientation::of_pair(r_j, r_i).unwrap(), 30.0).unwrap();
            assert!(!forth.reversed && back.reversed);
            assert!(wrap(forth.state.node_rad - back.state.node_rad).abs() < 1e-9);
            assert!(wrap(forth.state.phase_rad - back.state.phase_rad).abs() < 1e-9);
        }
    }

    /// The chosen rotation is the nearest one with the nominal inclination.
    #[test]
    fn the_nearest_rotation_keeps_node_and_phase() {
        let (node, inclination, phase) = (1.1, 0.55, 2.2);
        let trace = |a: Matrix, b: Matrix| (0..3).map(|k| dot(a[k], b[k])).sum::<f64>();
        let real = rotation(node, inclination, phase);
        let taken = trace(real, rotation(node, 0.5, phase));
        for [a, b] in [[0.01, 0.0], [0.0, 0.01], [0.01, 0.01], [0.01, -0.01], [-0.01, 0.005]] {
            assert!(trace(real, rotation(node + a, 0.5, phase + b)) < taken);
        }
        // trace = 1 + 2 cos(angle)
        assert!((taken - 1.0 - 2.0 * 0.05_f64.cos()).abs() < 1e-12);
    }

    #[test]
    fn in_the_ecliptic_the_phase_counts_from_anywhere() {
        let [r_i, r_j] = pair(rotation(0.0, 0.0, 2.5), 0.01);
        let found = PairOrientation::of_pair(r_i, r_j).unwrap();
        assert!(wrap(found.node_rad + found.phase_rad - 2.5).abs() < 1e-9);
        assert!(nominal(0.0).pair(&found, 30.0).is_ok());
    }

    #[test]
    fn what_is_not_covered_is_refused() {
        let r = rotation(1.0, 0.5, 2.0);
        let [r_i, r_j] = pair(r, 0.001);
        let orbit = nominal(0.5);
        let ask = |r_i, r_j| PairOrientation::of_pair(r_i, r_j).and_then(|found| orbit.pair(&found, 30.0));
        let b = norm(sub(r_i, r_j));
        let up = |metres: f64, r: Vec3| add(r, scale(metres / RADIUS_M, r));
        assert!(ask(r_i, r_j).is_ok());
        assert!(ask(up(4_900.0, r_i), up(4_900.0, r_j)).is_ok());
        assert_eq!(ask(up(5_200.0, r_i), up(5_200.0, r_j)), Err(GeometryRefusal::Altitude));
        assert!(ask(up(1e-3 * b, r_i), r_j).is_ok());
        assert_eq!(ask(up(2e-3 * b, r_i), r_j), Err(GeometryRefusal::UnequalRadii));
        // A rotation about the mid-point, which at the node changes the inclination.
        for (tilt_deg, covered) in [(0.1, true), (-0.19, true), (0.21, false), (-1.0, false)] {
            let tilted = product(rotation(1.0, 0.5, 0.0), about_x(f64::to_radians(tilt_deg)));
            let [r_i, r_j] = pair(tilted, 0.001);
            let expected = if covered { Ok(()) } else { Err(GeometryRefusal::Inclination) };
            assert_eq!(ask(r_i, r_j).map(|_| ()), expected, "{tilt_deg}");
        }
        assert_eq!(ask(r_i, r_i), Err(GeometryRefusal::Degenerate));
        assert_eq!(ask(r_i, scale(-1.0, r_i)), Err(GeometryRefusal::Degenerate));
        assert_eq!(ask([f64::NAN, 0.0, 0.0], r_j), Err(GeometryRefusal::NotFinite));
        assert_eq!(ask(r_i, [1e300, 1e300, 0.0]), Err(GeometryRefusal::NotFinite));
        assert_eq!(ask(r_i, [0.0; 3]), Err(GeometryRefusal::NotFinite));
    }
}
