//! Scaling of baselines, which is equivalent to a change of frequency.

use crate::units::vector::{Vec3, add, norm, scale, sub};

/// Moves two positions (m) along their circle about the Moon until their distance is `factor` times as long. They
/// then have the fringes of the original pair at `factor` times the frequency.
///
/// The Moon's limb moves by half the added length: 2e-5 rad for 100 km and a factor of 1.0008, 8 kHz at 10 MHz.
#[must_use]
pub fn scaled_baseline(r_i_m: Vec3, r_j_m: Vec3, factor: f64) -> (Vec3, Vec3) {
    let (middle, half) = (scale(0.5, add(r_i_m, r_j_m)), scale(0.5, sub(r_i_m, r_j_m)));
    let half_m = norm(half);
    // As the chord grows, its distance from the centre shrinks.
    let depth_m = norm(middle);
    let squared = depth_m * depth_m + half_m * half_m * (1.0 - factor * factor);
    let centre = scale(squared.max(0.0).sqrt() / depth_m, middle);
    let half = scale(factor, half);
    (add(centre, half), sub(centre, half))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::array::{Array, ArrayConfig};

    #[test]
    fn the_baseline_is_longer_and_the_circle_is_the_same() {
        let array = Array::new(&ArrayConfig::default()).unwrap();
        let (r_i_m, r_j_m) = (array.position_m(0, 4e3), array.position_m(7, 4e3));
        for factor in [0.9, 1.0, 1.0004, 1.5] {
            let (i_m, j_m) = scaled_baseline(r_i_m, r_j_m, factor);
            let (was_m, is_m) = (sub(r_i_m, r_j_m), sub(i_m, j_m));
            // Rounding of 2000 km is some nanometres.
            assert!(norm(sub(is_m, scale(factor, was_m))) < 1e-8);
            assert!((norm(i_m) - norm(r_i_m)).abs() < 1e-8 && (norm(j_m) - norm(r_j_m)).abs() < 1e-8);
        }
    }
}
