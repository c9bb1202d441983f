//! What the fast kernels share: a pair reduced to the numbers they need, and sines of turns.
//!
//! Kernels are plain loops over short buffers, compiled several times by `multiversion` (AVX-512,
//! AVX2, baseline) and chosen at run time. Fused multiply-adds are used only where the hardware has
//! them, because elsewhere they are calls into the C library.

use super::{PairGeometry, SingleGeometry};
use crate::frames::AntennaResponse;
use crate::units::vector::{Vec3, dot, scale};

/// Directions that a kernel takes at a time; its buffers fit the first-level cache.
pub(super) const CHUNK: usize = 256;

/// A pair as the kernels see it.
#[derive(Clone, Copy, Debug)]
pub(super) struct Prepared {
    /// Baseline in wavelengths.
    pub u: Vec3,
    /// Satellite i: unit vector, and distance of the limb's plane; n is seen when n . r + limb >= 0.
    pub i_hat: Vec3,
    /// See `i_hat`.
    pub limb_i: f64,
    /// Satellite j.
    pub j_hat: Vec3,
    /// See `i_hat`.
    pub limb_j: f64,
    /// Direction of the dipoles, if there are any.
    pub dipole: Option<Vec3>,
}

/// Direction of a position, and the cosine of the limb's distance from the direction of the Moon.
fn limb(r_m: Vec3, moon_radius_m: f64) -> (Vec3, f64) {
    let length_m = dot(r_m, r_m).sqrt();
    let ratio = moon_radius_m / length_m;
    (scale(1.0 / length_m, r_m), (1.0 - ratio * ratio).max(0.0).sqrt())
}

impl Prepared {
    pub fn new(pair: &PairGeometry) -> Self {
        let (i_hat, limb_i) = limb(pair.r_i_m, pair.moon_radius_m);
        let (j_hat, limb_j) = limb(pair.r_j_m, pair.moon_radius_m);
        let dipole = match pair.response {
            AntennaResponse::Isotropic => None,
            // Dipoles without a plane to stand on have no answer.
            AntennaResponse::DipoleNormal => Some(pair.orbit_normal().unwrap_or([f64::NAN; 3])),
        };
        Self { u: pair.baseline_wavelengths(), i_hat, limb_i, j_hat, limb_j, dipole }
    }

    pub fn single(single: &SingleGeometry) -> Self {
        let (i_hat, limb_i) = limb(single.r_m, single.moon_radius_m);
        let dipole = match single.response {
            AntennaResponse::Isotropic => None,
            AntennaResponse::DipoleNormal => Some(single.normal_hat),
        };
        Self { u: [0.0; 3], i_hat, limb_i, j_hat: i_hat, limb_j: limb_i, dipole }
    }
}

/// `a b + c`, fused where `FMA` says that the hardware does it.
#[inline(always)]
pub(crate) fn fused<const FMA: bool>(a: f32, b: f32, c: f32) -> f32 {
    if FMA { a.mul_add(b, c) } else { a * b + c }
}

/// `a b + c`, fused where `FMA` says that the hardware does it.
#[inline(always)]
pub(super) fn fused64<const FMA: bool>(a: f64, b: f64, c: f64) -> f64 {
    if FMA { a.mul_add(b, c) } else { a * b + c }
}

/// Scalar product in `f64`.
#[inline(always)]
pub(super) fn dot64<const FMA: bool>(a: Vec3, x: f64, y: f64, z: f64) -> f64 {
    fused64::<FMA>(a[0], x, fused64::<FMA>(a[1], y, a[2] * z))
}

/// Scalar product in `f32`.
#[inline(always)]
pub(super) fn dot32<const FMA: bool>(a: [f32; 3], x: f32, y: f32, z: f32) -> f32 {
    fused::<FMA>(a[0], x, fused::<FMA>(a[1], y, a[2] * z))
}

/// Sum of values, a multiple of four, in `f64`: four sums side by side, then those.
#[inline(always)]
pub(super) fn total<const LANES: usize>(lanes: &[f32; LANES]) -> f64 {
    let mut four = [0.0_f64; 4];
    for values in lanes.as_chunks::<4>().0 {
        for (sum, value) in four.iter_mut().zip(values) {
            *sum += f64::from(*value);
        }
    }
    (four[0] + four[1]) + (four[2] + four[3])
}

/// `turns` less the nearest whole number.
///
/// Adding 1.5 2^52 leaves no bits for a fraction; exact for |turns| < 2^51, and no call for any target.
#[inline(always)]
pub(super) fn fraction(turns: f64) -> f32 {
    const MAGIC: f64 = 6_755_399_441_055_744.0;
    (turns - ((turns + MAGIC) - MAGIC)) as f32
}

/// A polynomial by Horner's rule, constant term first.
#[inline(always)]
pub(crate) fn polynomial<const FMA: bool, const N: usize>(coefficients: &[f32; N], x: f32) -> f32 {
    let mut sum = coefficients[N - 1];
    for k in (0..N - 1).rev() {
        sum = fused::<FMA>(sum, x, coefficients[k]);
    }
    sum
}

/// cos and sin of 2 pi `turns`, |turns| <= 1/2, to 1e-6.
///
/// From the half angle: sin(pi t)/t and cos(pi t) as polynomials in t^2, interpolated at Chebyshev
/// points of 0 <= t^2 <= 1/4; then the formulas for the double angle.
#[inline(always)]
pub(crate) fn cos_sin_turns<const FMA: bool>(turns: f32) -> (f32, f32) {
    const SIN: [f32; 5] = [std::f32::consts::PI, -5.167_710_3, 2.550_077_4, -0.598_291_3, 0.077_657_66];
    const COS: [f32; 6] = [1.0, -4.934_802, 4.058_709, -1.335_212, 0.234_937_2, -0.024_396_325];
    let square = turns * turns;
    let sin = turns * polynomial::<FMA, 5>(&SIN, square);
    let cos = polynomial::<FMA, 6>(&COS, square);
    let twice = sin + sin;
    (fused::<FMA>(-twice, sin, 1.0), twice * cos)
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::f64::consts::TAU;

    #[test]
    fn sines_of_turns_are_right() {
        for k in -5000..=5000 {
            let turns = k as f32 / 1e4;
            let (cos, sin) = cos_sin_turns::<false>(turns);
            let angle = TAU * f64::from(turns);
            // The documented accuracy of the polynomials in f32.
            assert!((f64::from(cos) - angle.cos()).abs() < 1e-6, "{turns}");
            assert!((f64::from(sin) - angle.sin()).abs() < 1e-6, "{turns}");
        }
    }

    #[test]
    fn fractions_of_many_turns_keep_their_bits() {
        // 100 km at 30 MHz is 1e4 turns.
        for turns in [0.0, 0.25, -0.25, 10_006.922_9, -10_006.499_9, 1e9 + 0.125] {
            let expected = turns - f64::round(turns);
            assert!((f64::from(fraction(turns)) - expected).abs() < 1e-7, "{turns}");
        }
    }
}
