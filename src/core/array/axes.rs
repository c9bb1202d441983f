//! Equatorial and ecliptic axes of J2000.

use crate::units::vector::Vec3;

/// Obliquity of the ecliptic of J2000 (IAU 1976): 84381.448 arc seconds.
const OBLIQUITY_DEG: f64 = 84_381.448 / 3600.0;

/// From equatorial to ecliptic axes, if `turns`.
pub(super) fn turned(turns: bool, v: Vec3) -> Vec3 {
    if !turns {
        return v;
    }
    let (sin, cos) = OBLIQUITY_DEG.to_radians().sin_cos();
    [v[0], cos * v[1] + sin * v[2], cos * v[2] - sin * v[1]]
}

/// From ecliptic to equatorial axes.
pub(super) fn to_equatorial(v: Vec3) -> Vec3 {
    let (sin, cos) = OBLIQUITY_DEG.to_radians().sin_cos();
    [v[0], cos * v[1] - sin * v[2], cos * v[2] + sin * v[1]]
}
