//! The own frame of a pair of satellites at any positions.
//!
//! y is the direction of the baseline, z the normal of the plane through both satellites and the Moon's centre, and x points up. In this
//! frame the fringe pattern depends only on the baseline's length and on both satellites' radii and angles in the plane, and is
//! mirror-symmetric in the plane.

use crate::array::is_underground;
use crate::response::harmonic::GeometryRefusal;
use crate::units::vector::{Vec3, add, cross, dot, norm, scale, sub};

/// Shortest baseline with a defined direction, m, as in `response/harmonic/geometry.rs`.
const BASELINE_M_MIN: f64 = 1e-3;

/// Geometry of a pair in its own frame.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct PairView {
    pub(super) axes: [Vec3; 3],
    pub(super) baseline_m: f64,
    /// Angles of i and j in the plane from x towards y, rad.
    pub(super) angle_rad: [f64; 2],
    /// Cosines of the angles between nadir and limb, `sqrt(1 - (R_moon / r)^2)`, of i and j.
    pub(super) cos_limb: [f64; 2],
}

impl PairView {
    /// Computes the frame of a pair.
    ///
    /// # Errors
    /// [`GeometryRefusal`] for positions that are not finite, below the Moon's surface, without a plane, or so far apart that the Moon
    /// hides two separate regions.
    pub(super) fn new(r_i_m: Vec3, r_j_m: Vec3, moon_radius_m: f64) -> Result<Self, GeometryRefusal> {
        let (difference, sum) = (sub(r_i_m, r_j_m), add(r_i_m, r_j_m));
        let baseline_m = norm(difference);
        let radii_m = [norm(r_i_m), norm(r_j_m)];
        if !(baseline_m + radii_m[0] + radii_m[1]).is_finite() {
            return Err(GeometryRefusal::NotFinite);
        }
        if [r_i_m, r_j_m].iter().any(|r_m| is_underground(*r_m, moon_radius_m)) {
            return Err(GeometryRefusal::Altitude);
        }
        let y = scale(1.0 / baseline_m, difference);
        let across = sub(sum, scale(dot(sum, y), y));
        let across_m = norm(across);
        if !(baseline_m > BASELINE_M_MIN && across_m > BASELINE_M_MIN) {
            return Err(GeometryRefusal::Degenerate);
        }
        let x = scale(1.0 / across_m, across);
        let view = Self {
            axes: [x, y, cross(x, y)],
            baseline_m,
            angle_rad: [r_i_m, r_j_m].map(|r_m| dot(r_m, y).atan2(dot(r_m, x))),
            cos_limb: radii_m.map(|radius_m| (1.0 - (moon_radius_m / radius_m).powi(2)).max(0.0).sqrt()),
        };
        // Otherwise the Moon would hide two separate regions.
        if view.cos_limb.iter().any(|cos_limb| 1.01 * view.half_separation_rad() > cos_limb.acos()) {
            return Err(GeometryRefusal::Altitude);
        }
        Ok(view)
    }

    /// Half the angle between the satellites, seen from the Moon's centre, rad.
    fn half_separation_rad(&self) -> f64 {
        0.5 * (self.angle_rad[0] - self.angle_rad[1]).abs()
    }

    /// Angle between horizontal and limb, rad: mean of both satellites.
    pub(super) fn limb_rad(&self) -> f64 {
        0.5 * (self.cos_limb[0].asin() + self.cos_limb[1].asin())
    }

    /// Angle between nadir and limb, rad: mean of both satellites.
    pub(super) fn cap_rad(&self) -> f64 {
        0.5 * (self.cos_limb[0].acos() + self.cos_limb[1].acos())
    }

    /// Maximum distance of either satellite's limb from [`Self::cap_rad`], measured from the mean nadir, rad.
    pub(super) fn limb_spread_rad(&self) -> f64 {
        self.half_separation_rad() + 0.5 * (self.cos_limb[0].acos() - self.cos_limb[1].acos()).abs()
    }

    /// Angle of the mean zenith from x towards y, rad, which is the pitch of the baseline out of the horizontal.
    pub(super) fn pitch_rad(&self) -> f64 {
        0.5 * (self.angle_rad[0] + self.angle_rad[1])
    }
}

/// Three axes, the columns of a matrix.
pub(super) type Axes = [Vec3; 3];

/// Applies to the axes `reference` the smallest rotation that takes their z to `z`, which must not be half a turn.
pub(super) fn transported(reference: &Axes, z: Vec3) -> Axes {
    let axis = cross(reference[2], z);
    let factor = 1.0 / (1.0 + dot(reference[2], z));
    // Rodrigues' formula: v cos + axis x v + axis (axis . v) / (1 + cos), with |axis| = sin.
    let cos = dot(reference[2], z);
    let turn = |v: Vec3| add(add(scale(cos, v), cross(axis, v)), scale(factor * dot(axis, v), axis));
    let x = turn(reference[0]);
    let x = sub(x, scale(dot(x, z), z));
    let x = scale(1.0 / norm(x), x);
    [x, cross(z, x), z]
}

/// Returns the angles alpha, beta, gamma of the matrix `Rz(alpha) Ry(beta) Rz(gamma)` with these columns.
pub(super) fn euler_angles(axes: &Axes) -> [f64; 3] {
    let [x, y, z] = axes;
    let sin_beta = z[0].hypot(z[1]);
    let beta = sin_beta.atan2(z[2]);
    // At the poles alpha and gamma rotate about the same axis.
    if sin_beta < 1e-9 {
        let gamma = if z[2] > 0.0 { x[1].atan2(x[0]) } else { x[1].atan2(-x[0]) };
        return [0.0, if z[2] > 0.0 { 0.0 } else { std::f64::consts::PI }, gamma];
    }
    [z[1].atan2(z[0]), beta, y[2].atan2(-x[2])]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn satellites_from_which_the_moon_hides_two_regions_are_refused() {
        const MOON_M: f64 = 1737.1e3;
        let at = |radius_m: f64, angle: f64| [radius_m * angle.cos(), radius_m * angle.sin(), 0.0];
        let pair = |radius_m: f64, away: f64| {
            PairView::new(at(radius_m, away), at(radius_m, -away), MOON_M).map(|view| view.cap_rad())
        };
        // At ten radii the cap has a radius of asin(0.1).
        let found = pair(10.0 * MOON_M, 0.09).unwrap();
        assert!((found - 0.1_f64.asin()).abs() < 1e-12, "{found}");
        assert_eq!(pair(10.0 * MOON_M, 0.11), Err(GeometryRefusal::Altitude));
        assert_eq!(pair(0.99 * MOON_M, 1e-3), Err(GeometryRefusal::Altitude));
    }
}
