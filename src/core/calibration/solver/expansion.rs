//! Expansion of a plane wave in spherical harmonics: exp(-i d . n) = 4 pi sum_lm (-i)^l j_l(|d|) Y_lm(d) Y_lm(n),
//! with real harmonics. Moments of a fringe with Y_lm(n) give the fringe at any offset d.

use std::f64::consts::PI;

use crate::units::vector::{Vec3, norm, scale};

/// Orders above the argument from which the downward recurrence of Bessel functions starts.
const RECURRENCE_MARGIN: usize = 24;

/// Number of harmonics of degrees up to `l_max`.
pub(super) fn harmonic_count(l_max: usize) -> usize {
    (l_max + 1) * (l_max + 1)
}

/// Degree beyond which the wave of an offset of `radians` is negligible: j_l falls by more than a hundred within four
/// degrees of l = |d|.
pub(super) fn degree_of_offset(radians: f64) -> usize {
    radians.ceil() as usize + 4
}

/// Index of a degree and order; negative orders are sines.
pub(super) fn harmonic_index(l: usize, m: isize) -> usize {
    (l * l + l).saturating_add_signed(m)
}

/// Real spherical harmonics at a direction, up to degree `l_max`.
pub(super) fn real_harmonics([x, y, z]: Vec3, l_max: usize, out: &mut [f64]) {
    let sin_theta = x.hypot(y);
    let (cos, sin) = if sin_theta > 0.0 { (x / sin_theta, y / sin_theta) } else { (1.0, 0.0) };
    // Associated Legendre functions of order m, normalised so that the squares of the harmonics have integral one.
    let mut sectoral = (0.25 / PI).sqrt();
    let (mut cos_m, mut sin_m) = (1.0, 0.0);
    for m in 0..=l_max {
        let (mut previous, mut current) = (0.0, sectoral);
        let root = if m == 0 { 1.0 } else { 2.0_f64.sqrt() };
        for l in m..=l_max {
            out[harmonic_index(l, m as isize)] = root * current * cos_m;
            if m > 0 {
                out[harmonic_index(l, -(m as isize))] = root * current * sin_m;
            }
            let (next, m) = ((l + 1) as f64, m as f64);
            let rise = ((4.0 * next * next - 1.0) / (next * next - m * m)).sqrt();
            let l = l as f64;
            let fall = ((l * l - m * m) / (4.0 * l * l - 1.0).max(1.0)).max(0.0).sqrt();
            (previous, current) = (current, rise * (z * current - fall * previous));
        }
        let order = (m + 1) as f64;
        sectoral *= ((2.0 * order + 1.0) / (2.0 * order)).sqrt() * sin_theta;
        (cos_m, sin_m) = (cos_m * cos - sin_m * sin, sin_m * cos + cos_m * sin);
    }
}

/// Spherical Bessel functions j_0 .. j_l_max, by downward recurrence.
fn spherical_bessel(x: f64, l_max: usize) -> Vec<f64> {
    let mut out = vec![0.0; l_max + 1];
    if x < 1e-3 {
        // Neglected terms are below 1e-7 of these.
        let first = [1.0, x / 3.0, x * x / 15.0];
        out.iter_mut().zip(first).for_each(|(value, first)| *value = first);
        return out;
    }
    let top = l_max.max(x.ceil() as usize) + RECURRENCE_MARGIN;
    // The sum of (2 l + 1) j_l^2 is one; the sign follows from j_0 or j_1, whichever is larger.
    let (mut above, mut current, mut square) = (0.0, 1e-100, 0.0);
    let mut low = [0.0; 2];
    for l in (0..=top).rev() {
        square += (2 * l + 1) as f64 * current * current;
        if l <= l_max {
            out[l] = current;
        }
        if l < 2 {
            low[l] = current;
        }
        let below = (2 * l + 1) as f64 / x * current - above;
        (above, current) = (current, below);
    }
    let (sin, cos) = x.sin_cos();
    let exact = [sin / x, (sin / x - cos) / x];
    let larger = usize::from(exact[1].abs() > exact[0].abs());
    let sign = (low[larger] * exact[larger]).signum();
    out.iter_mut().for_each(|value| *value *= sign / square.sqrt());
    out
}

/// Factors 4 pi j_l Y_lm of an offset (phase, rad, along each axis), without (-i)^l.
pub(super) fn offset_factors(radians: Vec3, l_max: usize) -> Vec<f64> {
    let length = norm(radians);
    let direction = if length > 0.0 { scale(1.0 / length, radians) } else { [0.0, 0.0, 1.0] };
    let mut out = vec![0.0; harmonic_count(l_max)];
    real_harmonics(direction, l_max, &mut out);
    for (l, bessel) in spherical_bessel(length, l_max).into_iter().enumerate() {
        out[l * l..(l + 1) * (l + 1)].iter_mut().for_each(|value| *value *= 4.0 * PI * bessel);
    }
    out
}

#[cfg(test)]
mod tests {
    use num_complex::Complex64;

    use super::*;
    use crate::units::vector::{dot, unit};

    #[test]
    fn the_expansion_is_the_plane_wave() {
        for offset in
            [[0.0, 0.0, 0.0], [0.3, -0.2, 0.5], [4.0, -7.0, 5.0], [0.0, 0.0, -11.0], [12.0, 3.0, -2.0]]
        {
            let l_max = norm(offset).ceil() as usize + 18;
            let factors = offset_factors(offset, l_max);
            for direction in
                [[1.0, 0.2, -0.4], [0.0, 0.0, 1.0], [-0.5, 0.9, 0.1], [-1.0, -1.0, -1.0]].map(unit)
            {
                let mut of_direction = vec![0.0; harmonic_count(l_max)];
                real_harmonics(direction, l_max, &mut of_direction);
                let mut sum = Complex64::ZERO;
                for l in 0..=l_max {
                    let degree = l * l..(l + 1) * (l + 1);
                    let part: f64 =
                        factors[degree.clone()].iter().zip(&of_direction[degree]).map(|(a, b)| a * b).sum();
                    sum += Complex64::new(0.0, -1.0).powu(l as u32) * part;
                }
                let wave = Complex64::cis(-dot(offset, direction));
                // Remainder beyond eighteen degrees above the argument.
                assert!((sum - wave).norm() < 1e-8, "{offset:?} {direction:?}: {sum} {wave}");
            }
        }
    }
}
