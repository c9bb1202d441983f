//! Reflection of the sky by a flat Moon.

use num_complex::Complex64;

use super::{DaughterPosition, ModelError, PairPosition, VisibilityModel};
use crate::response::pixel::Comb;

/// Adds the reflection of the sky in a flat Moon with constant power reflectivity to a sky model.
///
/// A reflected wave arrives at least `2 h / c` after the direct one, 2 ms for 300 km: sixteen times the coherence time of a
/// channel of 8 kHz, so that the two do not interfere (the paper, Sect. 3.4). The image therefore adds as a second, weaker sky.
/// The mirror is the horizontal plane at the pair's mid-point. It maps a direction n to `n - 2 (n . z) z`, and as the baseline is
/// horizontal there, the image has the fringe of n itself. Only the sky above the horizontal is reflected: the image is the
/// reflectivity times the visibility that a Moon as large as the orbit would leave.
pub struct WithFlatReflection {
    sky: Box<dyn VisibilityModel>,
    upper_sky: Box<dyn VisibilityModel>,
    reflectivity: f64,
}

impl WithFlatReflection {
    /// Adds the reflection of `upper_sky`, the model of the same sky above the horizontal, to `sky`.
    #[must_use]
    pub fn new(
        sky: Box<dyn VisibilityModel>,
        upper_sky: Box<dyn VisibilityModel>,
        reflectivity: f64,
    ) -> Self {
        Self { sky, upper_sky, reflectivity }
    }
}

impl VisibilityModel for WithFlatReflection {
    fn batch(&self) -> usize {
        self.sky.batch()
    }

    fn has_individual_antennas(&self) -> bool {
        self.sky.has_individual_antennas()
    }

    fn predict(&mut self, positions: &[PairPosition], out: &mut [Complex64]) -> Result<(), ModelError> {
        let mut image = vec![Complex64::ZERO; out.len()];
        self.upper_sky.predict(positions, &mut image)?;
        self.sky.predict(positions, out)?;
        out.iter_mut().zip(image).for_each(|(out, image)| *out += self.reflectivity * image);
        Ok(())
    }

    fn predict_powers(&mut self, daughters: &[DaughterPosition], out: &mut [f64]) -> Result<(), ModelError> {
        let mut image = vec![0.0; out.len()];
        self.upper_sky.predict_powers(daughters, &mut image)?;
        self.sky.predict_powers(daughters, out)?;
        out.iter_mut().zip(image).for_each(|(out, image)| *out += self.reflectivity * image);
        Ok(())
    }

    fn predict_comb(
        &mut self,
        positions: &[PairPosition],
        comb: Comb,
        out: &mut [Complex64],
    ) -> Result<(), ModelError> {
        let mut image = vec![Complex64::ZERO; out.len()];
        self.upper_sky.predict_comb(positions, comb, &mut image)?;
        self.sky.predict_comb(positions, comb, out)?;
        out.iter_mut().zip(image).for_each(|(out, image)| *out += self.reflectivity * image);
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::array::{Array, ArrayConfig};
    use crate::frames::AntennaResponse;
    use crate::response::model::DirectSum;
    use crate::sky::healpix::{pixel_area_sr, pixel_directions};
    use crate::sky::{Frame, SkyMap};
    use crate::units::constants::SPEED_OF_LIGHT_M_S;
    use crate::units::vector::{Vec3, add, dot, norm, scale, sub};

    #[test]
    fn the_image_is_that_of_mirrored_directions() {
        let array = Array::new(&ArrayConfig::default()).unwrap();
        let (nside, frequency_hz, moon_m) = (32, 1e7, array.moon_radius_m());
        let directions = pixel_directions(nside);
        let sky_k: Vec<f64> = directions.iter().map(|n| 3.0 + n[0] + (5.0 * n[1] * n[2]).sin()).collect();
        let sky = SkyMap::new(Frame::Ecliptic, sky_k.clone()).unwrap();
        let model = |radius_m| {
            Box::new(DirectSum::new(&sky, frequency_hz, radius_m, AntennaResponse::Isotropic))
                as Box<dyn VisibilityModel>
        };
        let mut reflected = WithFlatReflection::new(model(moon_m), model(array.orbit_radius_m()), 0.07);
        for (i, j) in [(0, 1), (0, 2), (1, 3)] {
            let (r_i_m, r_j_m) = (array.position_m(i, 9e5), array.position_m(j, 9e5));
            let position = PairPosition { r_i_m, r_j_m, span_rad: 0.0, pair_time: None };
            let (mut found, mut power) = ([Complex64::ZERO], [0.0]);
            reflected.predict(&[position], &mut found).unwrap();
            let daughter = DaughterPosition {
                r_m: r_i_m,
                normal_hat: array.orbit_normal_hat(9e5),
                ..DaughterPosition::default()
            };
            reflected.predict_powers(&[daughter], &mut power).unwrap();
            // Each direction sends a direct wave, and a reflected one with the fringe of the mirrored direction.
            let middle = add(r_i_m, r_j_m);
            let up: Vec3 = scale(1.0 / norm(middle), middle);
            let wave = |n: Vec3| {
                let turns = dot(n, sub(r_i_m, r_j_m)) * frequency_hz / SPEED_OF_LIGHT_M_S;
                Complex64::cis(-std::f64::consts::TAU * turns)
            };
            let (mut expected, mut expected_power) = (Complex64::ZERO, 0.0);
            for (&n, t) in directions.iter().zip(&sky_k) {
                let sees = |r_m: Vec3| -dot(n, r_m) <= (dot(r_m, r_m) - moon_m * moon_m).sqrt();
                if sees(r_i_m) && sees(r_j_m) {
                    expected += *t * wave(n);
                }
                let mirrored = sub(n, scale(2.0 * dot(n, up), up));
                if dot(n, r_i_m) >= 0.0 && dot(n, r_j_m) >= 0.0 {
                    expected += 0.07 * *t * wave(mirrored);
                }
                expected_power += if sees(r_i_m) { *t } else { 0.0 };
                expected_power += if dot(n, r_i_m) >= 0.0 { 0.07 * *t } else { 0.0 };
            }
            let area_sr = pixel_area_sr(nside);
            // Fringes are in f32, and the sky has 40 K sr.
            assert!((found[0] - expected * area_sr).norm() < 1e-4, "{} {}", found[0], expected * area_sr);
            assert!((power[0] - expected_power * area_sr).abs() < 1e-4);
        }
    }
}
