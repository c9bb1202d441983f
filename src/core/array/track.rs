//! Axes of a satellite's motion.

use crate::units::vector::{Vec3, add, cross, dot, scale, sub, unit};

/// Unit vectors along the track of a satellite, along its orbit's normal, and away from the Moon.
#[must_use]
pub fn track_axes(r_m: Vec3, normal_hat: Vec3) -> [Vec3; 3] {
    let up = unit(r_m);
    [unit(cross(normal_hat, up)), normal_hat, up]
}

/// An offset along [`track_axes`], m.
#[must_use]
pub fn track_offset_m(r_m: Vec3, normal_hat: Vec3, offset_m: [f64; 3]) -> Vec3 {
    let axes = track_axes(r_m, normal_hat);
    let parts: [Vec3; 3] = std::array::from_fn(|k| scale(offset_m[k], axes[k]));
    add(add(parts[0], parts[1]), parts[2])
}

/// Axis of an antenna that leans from the second of a body's axes, as those of [`track_axes`], by an angle (deg) towards the first, and by
/// one towards the third; and the direction across it that is nearest to the first.
#[must_use]
pub fn tilted_axes([along, normal, up]: [Vec3; 3], [along_deg, radial_deg]: [f64; 2]) -> [Vec3; 2] {
    let [a, b] = [along_deg, radial_deg].map(|deg| deg.to_radians().tan());
    let axis = unit(add(normal, add(scale(a, along), scale(b, up))));
    [axis, unit(sub(along, scale(dot(along, axis), axis)))]
}

/// Normal of an orbit from two positions a short time apart; `None` if they are collinear with the Moon's centre.
#[must_use]
pub fn orbit_normal_hat(r_before_m: Vec3, r_after_m: Vec3) -> Option<Vec3> {
    let normal = cross(r_before_m, r_after_m);
    (dot(normal, normal) > 0.0).then(|| unit(normal))
}
