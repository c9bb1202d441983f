//! Rotations as unit quaternions, and interpolation among them.

use crate::numerics::lagrange_weights;
use crate::units::vector::{Vec3, add, cross, dot, norm, scale};

/// A rotation: vector part and scalar part of a quaternion of length 1.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Rotation {
    pub(super) vector: Vec3,
    pub(super) scalar: f64,
}

impl Rotation {
    /// That of a quaternion of any length but 0.
    pub(super) fn new(vector: Vec3, scalar: f64) -> Self {
        let length = (dot(vector, vector) + scalar * scalar).sqrt();
        Self { vector: scale(1.0 / length, vector), scalar: scalar / length }
    }

    pub(super) fn inverse(self) -> Self {
        Self { vector: scale(-1.0, self.vector), scalar: self.scalar }
    }

    pub(super) fn times(self, other: Self) -> Self {
        let (a, b) = (self.vector, other.vector);
        let vector = add(cross(a, b), add(scale(self.scalar, b), scale(other.scalar, a)));
        Self::new(vector, self.scalar * other.scalar - dot(a, b))
    }

    /// Its axis times its angle, at most half a turn.
    pub(super) fn vector_rad(self) -> Vec3 {
        let sin = norm(self.vector);
        if sin == 0.0 {
            return [0.0; 3];
        }
        let half_rad = sin.atan2(self.scalar.abs());
        scale(2.0 * half_rad.copysign(self.scalar) / sin, self.vector)
    }

    /// The rotation about a vector by its length, rad.
    pub(super) fn about(vector_rad: Vec3) -> Self {
        let angle_rad = norm(vector_rad);
        if angle_rad == 0.0 {
            return Self { vector: [0.0; 3], scalar: 1.0 };
        }
        let (sin, cos) = (0.5 * angle_rad).sin_cos();
        Self::new(scale(sin / angle_rad, vector_rad), cos)
    }

    /// Angle between two attitudes, rad.
    pub(super) fn apart_rad(self, other: Self) -> f64 {
        norm(self.inverse().times(other).vector_rad())
    }

    /// Rows of the matrix that takes components on the axes A to those on the axes B, of the rotation from A to B: the axes B as seen
    /// on A (504.0-B).
    pub(super) fn rows(self) -> [Vec3; 3] {
        let (Self { vector: [x, y, z], scalar: w }, two) = (self, 2.0);
        [
            [x * x - y * y - z * z + w * w, two * (x * y + z * w), two * (x * z - y * w)],
            [two * (x * y - z * w), y * y + w * w - x * x - z * z, two * (y * z + x * w)],
            [two * (x * z + y * w), two * (y * z - x * w), z * z + w * w - x * x - y * y],
        ]
    }
}

/// Interpolates rotations at rising times: the polynomial through their turns from the nearest, as vectors. Through two it is the
/// shortest way on the sphere, at a steady rate.
pub(super) fn interpolated(times_s: &[f64], rotations: &[Rotation], at_s: f64) -> Rotation {
    let apart_s = |k: &usize| (times_s[*k] - at_s).abs();
    let Some(nearest) = (0..times_s.len()).min_by(|a, b| apart_s(a).total_cmp(&apart_s(b))) else {
        return Rotation::about([0.0; 3]);
    };
    let from = rotations[nearest];
    let back = from.inverse();
    let mut turn_rad = [0.0; 3];
    for (rotation, weight) in rotations.iter().zip(lagrange_weights(times_s, at_s)) {
        turn_rad = add(turn_rad, scale(weight, back.times(*rotation).vector_rad()));
    }
    from.times(Rotation::about(turn_rad))
}
