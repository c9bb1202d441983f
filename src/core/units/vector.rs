//! Three-vectors as plain arrays.

/// A vector in the frame its context names; metres or dimensionless.
pub type Vec3 = [f64; 3];

/// Scalar product.
#[inline]
#[must_use]
pub fn dot(a: Vec3, b: Vec3) -> f64 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

/// The difference `a - b`.
#[inline]
#[must_use]
pub fn sub(a: Vec3, b: Vec3) -> Vec3 {
    [a[0] - b[0], a[1] - b[1], a[2] - b[2]]
}

/// The sum `a + b`.
#[inline]
#[must_use]
pub fn add(a: Vec3, b: Vec3) -> Vec3 {
    [a[0] + b[0], a[1] + b[1], a[2] + b[2]]
}

/// The vector `a` times `s`.
#[inline]
#[must_use]
pub fn scale(s: f64, a: Vec3) -> Vec3 {
    [s * a[0], s * a[1], s * a[2]]
}

/// Vector product.
#[inline]
#[must_use]
pub fn cross(a: Vec3, b: Vec3) -> Vec3 {
    [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
}

/// Euclidean length.
#[inline]
#[must_use]
pub fn norm(a: Vec3) -> f64 {
    dot(a, a).sqrt()
}

/// `a` scaled to length one.
#[inline]
#[must_use]
pub fn unit(a: Vec3) -> Vec3 {
    scale(1.0 / norm(a), a)
}

/// The unit vector at a longitude and latitude, degrees.
#[must_use]
pub fn direction(longitude_deg: f64, latitude_deg: f64) -> Vec3 {
    let ((sin_l, cos_l), (sin_b, cos_b)) =
        (longitude_deg.to_radians().sin_cos(), latitude_deg.to_radians().sin_cos());
    [cos_l * cos_b, sin_l * cos_b, sin_b]
}
