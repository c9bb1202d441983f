//! Specular reflection of the sky by a spherical Moon.

use num_complex::Complex64;
use rayon::prelude::*;

use super::{DaughterPosition, ModelError, PairPosition, VisibilityModel};
use crate::frames::AntennaResponse;
use crate::response::pixel::{
    Comb, Directions, PairGeometry, ResponseError, SingleGeometry, comb_sums, sky_powers, sky_sums,
};
use crate::sky::healpix::{pixel_area_sr, pixel_of};
use crate::sky::{Frame, Rotation, SkyMap, rotate};
use crate::units::vector::{Vec3, add, dot, norm, scale, sub};

/// Adds the specular reflection of the sky in a spherical Moon with constant power reflectivity to a sky model.
///
/// The image is computed for the pair's mid-point, or for the daughter itself for auto-correlations. A line of sight n that meets the
/// sphere at p (a unit vector) is reflected to `n - 2 (n . p) p`. In direction n the image has the reflectivity times the sky's
/// brightness in the reflected direction, with the fringe and the antenna response of n. It is summed over the directions of the
/// sky's pixels. As in [`WithFlatReflection`](super::WithFlatReflection), image and sky do not interfere.
pub struct WithSphereReflection {
    sky: Box<dyn VisibilityModel>,
    frequency_hz: f64,
    response: AntennaResponse,
    image: SphereImage,
}

/// The reflecting sphere, and the sky that it reflects.
struct SphereImage {
    radius_m: f64,
    reflectivity: f64,
    /// Directions of the image, on ecliptic axes.
    directions: Vec<Vec3>,
    map: SkyMap,
    from_ecliptic: Rotation,
    area_sr: f64,
}

impl WithSphereReflection {
    /// Adds the reflection of `map` (K, any frame) in a Moon of `radius_m` to `sky`, the model of that map.
    #[must_use]
    pub fn new(
        sky: Box<dyn VisibilityModel>,
        map: SkyMap,
        frequency_hz: f64,
        response: AntennaResponse,
        radius_m: f64,
        reflectivity: f64,
    ) -> Self {
        let image = SphereImage {
            radius_m,
            reflectivity,
            directions: map.directions_ecliptic(),
            from_ecliptic: Frame::Ecliptic.to_frame(map.frame()),
            area_sr: pixel_area_sr(map.nside()),
            map,
        };
        Self { sky, frequency_hz, response, image }
    }

    /// Adds `sums` of the image seen from each pair's mid-point; `values_per_pair` values for each pair.
    fn add_images(
        &self,
        positions: &[PairPosition],
        values_per_pair: usize,
        out: &mut [Complex64],
        sums: impl Fn(&PairGeometry, &MirrorImage) -> Result<Vec<Complex64>, ResponseError> + Sync,
    ) {
        if values_per_pair == 0 {
            return;
        }
        out.par_chunks_mut(values_per_pair).zip(positions).for_each(|(out, position)| {
            let seen = self.image.seen_from(scale(0.5, add(position.r_i_m, position.r_j_m)));
            let pair = PairGeometry {
                r_i_m: position.r_i_m,
                r_j_m: position.r_j_m,
                frequency_hz: self.frequency_hz,
                // Nothing hides the image from the daughters.
                moon_radius_m: 0.0,
                response: self.response,
            };
            // Lengths agree by construction, so the sums cannot fail.
            let found = sums(&pair, &seen).unwrap_or_default();
            out.iter_mut().zip(found).for_each(|(out, image)| *out += image);
        });
    }
}

/// Image of the sky: directions, and reflected brightness, K.
struct MirrorImage {
    directions: Directions,
    values_k: Vec<f32>,
}

impl SphereImage {
    fn seen_from(&self, r_m: Vec3) -> MirrorImage {
        let hits = self.directions.iter().filter_map(|&n| Some((n, self.reflected(r_m, n)?)));
        let (seen, values_k) = hits
            .map(|(n, from)| {
                let pixel = pixel_of(self.map.nside(), rotate(&self.from_ecliptic, from));
                (n, (self.reflectivity * self.map.values()[pixel]) as f32)
            })
            .unzip::<Vec3, f32, Vec<Vec3>, Vec<f32>>();
        MirrorImage { directions: Directions::from(seen.as_slice()), values_k }
    }

    /// Direction of the line of sight `n` from `r_m` after reflection; `None` if it misses the sphere.
    fn reflected(&self, r_m: Vec3, n: Vec3) -> Option<Vec3> {
        let closest_m = -dot(n, r_m);
        let height_m = norm(r_m) - self.radius_m;
        // radius^2 - distance^2 with distance^2 = |r|^2 - closest^2, written to avoid cancellation for large radii.
        let half_chord_m2 = closest_m * closest_m - height_m * (norm(r_m) + self.radius_m);
        if closest_m <= 0.0 || half_chord_m2 < 0.0 {
            return None;
        }
        let p = scale(1.0 / self.radius_m, add(r_m, scale(closest_m - half_chord_m2.sqrt(), n)));
        Some(sub(n, scale(2.0 * dot(n, p), p)))
    }
}

impl VisibilityModel for WithSphereReflection {
    fn batch(&self) -> usize {
        self.sky.batch()
    }

    fn predict(&mut self, positions: &[PairPosition], out: &mut [Complex64]) -> Result<(), ModelError> {
        self.sky.predict(positions, out)?;
        let area_sr = self.image.area_sr;
        self.add_images(positions, 1, out, |pair, seen| {
            let sums = sky_sums(&[*pair], &seen.directions, &seen.values_k, area_sr)?;
            Ok(sums.iter().map(|sum| sum.visibility_k_sr).collect())
        });
        Ok(())
    }

    fn predict_powers(&mut self, daughters: &[DaughterPosition], out: &mut [f64]) -> Result<(), ModelError> {
        self.sky.predict_powers(daughters, out)?;
        let (response, image) = (self.response, &self.image);
        out.par_iter_mut().zip(daughters).for_each(|(out, daughter)| {
            let DaughterPosition { r_m, normal_hat, .. } = *daughter;
            let seen = image.seen_from(r_m);
            let single = SingleGeometry { r_m, normal_hat, moon_radius_m: 0.0, response };
            // Lengths agree by construction, so the sums cannot fail.
            let found = sky_powers(&[single], &seen.directions, &seen.values_k, image.area_sr);
            *out += found.unwrap_or_default().iter().sum::<f64>();
        });
        Ok(())
    }

    fn predict_comb(
        &mut self,
        positions: &[PairPosition],
        comb: Comb,
        out: &mut [Complex64],
    ) -> Result<(), ModelError> {
        self.sky.predict_comb(positions, comb, out)?;
        let area_sr = self.image.area_sr;
        self.add_images(positions, comb.count, out, |pair, seen| {
            comb_sums(&[*pair], comb, &seen.directions, &seen.values_k, area_sr)
        });
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::array::{Array, ArrayConfig};
    use crate::response::model::DirectSum;
    use crate::sky::healpix::pixel_directions;
    use crate::units::constants::SPEED_OF_LIGHT_M_S;
    use crate::units::vector::{cross, unit};

    const FREQUENCY_HZ: f64 = 1e6;
    const NSIDE: usize = 128;
    const REFLECTIVITY: f64 = 0.07;

    fn brightness_k(n: Vec3) -> f64 {
        30.0 + 10.0 * n[0] - 5.0 * n[2] + 8.0 * (2.0 * n[1] + n[2]).sin()
    }

    fn map(frame: Frame) -> SkyMap {
        let to_ecliptic = frame.to_ecliptic();
        let values = pixel_directions(NSIDE).into_iter().map(|n| brightness_k(rotate(&to_ecliptic, n)));
        SkyMap::new(frame, values.collect()).unwrap()
    }

    /// The image alone: the sky of the model has 0 K.
    fn image(frame: Frame, radius_m: f64) -> WithSphereReflection {
        let dark = SkyMap::constant(1, Frame::Ecliptic, 0.0).unwrap();
        let response = AntennaResponse::Isotropic;
        let sky = Box::new(DirectSum::new(&dark, FREQUENCY_HZ, radius_m, response));
        WithSphereReflection::new(sky, map(frame), FREQUENCY_HZ, response, radius_m, REFLECTIVITY)
    }

    fn pair(r_i_m: Vec3, r_j_m: Vec3) -> PairPosition {
        PairPosition { r_i_m, r_j_m, span_rad: 0.0, pair_time: None }
    }

    /// Five standard deviations of the error from rounding reflected directions to pixels: an rms offset of 0.3 times 8e-3 rad in
    /// a gradient of some 20 K/rad, independent over the 47,000 pixels of the disc.
    fn pixelisation_error_k_sr() -> f64 {
        5.0 * REFLECTIVITY * pixel_area_sr(NSIDE) * 0.05 * 47_000.0_f64.sqrt()
    }

    /// Error from pixels on the limb (30 K), each counted or not at random.
    fn limb_error_k_sr() -> f64 {
        REFLECTIVITY * pixel_area_sr(NSIDE) * 30.0 * (3.07 * NSIDE as f64).sqrt()
    }

    #[test]
    fn the_image_is_that_of_angles_in_the_plane_of_incidence() {
        let array = Array::new(&ArrayConfig::default()).unwrap();
        let moon_m = array.moon_radius_m();
        let (r_i_m, r_j_m) = (array.position_m(0, 9e5), array.position_m(1, 9e5));
        let middle_m = scale(0.5, add(r_i_m, r_j_m));
        let up = unit(middle_m);
        let (mut expected, mut sphere_sr) = (Complex64::ZERO, 0.0);
        for n in pixel_directions(NSIDE) {
            let theta = (-dot(n, up)).clamp(-1.0, 1.0).acos();
            // The sine of the angle of incidence, by the law of sines in the triangle of centre, daughters and p.
            let sine = norm(middle_m) / moon_m * theta.sin();
            if theta > 1.5 || sine > 1.0 {
                continue;
            }
            let away = unit(cross(up, cross(n, up)));
            let angle = 2.0 * sine.asin() - theta;
            let from = add(scale(angle.cos(), up), scale(angle.sin(), away));
            let turns = dot(n, sub(r_i_m, r_j_m)) * FREQUENCY_HZ / SPEED_OF_LIGHT_M_S;
            expected += REFLECTIVITY * brightness_k(from) * Complex64::cis(-std::f64::consts::TAU * turns);
            sphere_sr += pixel_area_sr(NSIDE);
        }
        expected *= pixel_area_sr(NSIDE);
        assert!((sphere_sr - 3.0).abs() < 0.02);
        for frame in [Frame::Ecliptic, Frame::Galactic] {
            let mut found = [Complex64::ZERO];
            let mut model = image(frame, moon_m);
            model.predict(&[pair(r_i_m, r_j_m)], &mut found).unwrap();
            let off = (found[0] - expected).norm();
            // In another frame the pixel centres differ, also along the limb.
            let same = frame == Frame::Ecliptic;
            let tolerance = pixelisation_error_k_sr() + if same { 0.0 } else { limb_error_k_sr() };
            assert!(
                off < tolerance && expected.norm() > 100.0 * tolerance,
                "{frame:?}: {} {expected}",
                found[0]
            );
            let comb = Comb { first: -0.5, step: 0.5, count: 2 };
            let mut at = [Complex64::ZERO; 2];
            model.predict_comb(&[pair(r_i_m, r_j_m)], comb, &mut at).unwrap();
            assert!((at[1] - found[0]).norm() < 1e-5 && (at[0] - found[0]).norm() > 0.01, "{at:?}");
            // The auto-power equals the visibility at zero baseline.
            let mut power = [0.0];
            let daughter = DaughterPosition {
                r_m: r_i_m,
                normal_hat: array.orbit_normal_hat(9e5),
                ..DaughterPosition::default()
            };
            model.predict_powers(&[daughter], &mut power).unwrap();
            model.predict(&[pair(r_i_m, r_i_m)], &mut found).unwrap();
            assert!((found[0] - power[0]).norm() < 1e-5, "{} {power:?}", found[0]);
        }
    }

    #[test]
    fn a_large_sphere_is_a_flat_mirror() {
        let up = unit([0.3, -0.5, 0.7]);
        let along = unit(cross(up, [0.0, 0.0, 1.0]));
        let mut off = Vec::new();
        for radius_m in [1e8, 1e10, 1e12] {
            let at = |x_m: f64| add(scale(radius_m + 3e5, up), scale(x_m, along));
            let position = pair(at(400.0), at(-500.0));
            let mut found = [Complex64::ZERO];
            image(Frame::Ecliptic, radius_m).predict(&[position], &mut found).unwrap();
            // A flat mirror reflects the sky above the horizontal (`WithFlatReflection`).
            let above = scale(1.0 / (radius_m + 3e5), position.r_i_m);
            let mut flat = Complex64::ZERO;
            for n in pixel_directions(NSIDE) {
                if dot(n, above) > 0.0 {
                    let turns =
                        dot(n, sub(position.r_i_m, position.r_j_m)) * FREQUENCY_HZ / SPEED_OF_LIGHT_M_S;
                    flat += REFLECTIVITY * brightness_k(n) * Complex64::cis(-std::f64::consts::TAU * turns);
                }
            }
            flat *= pixel_area_sr(NSIDE);
            off.push((found[0] - flat).norm());
        }
        // The band between horizontal and limb, sqrt(2 h / R) wide, is 8 % and 0.8 % of a hemisphere.
        assert!(
            off[0] > 10.0 * limb_error_k_sr() && off[1] < 0.3 * off[0] && off[2] < limb_error_k_sr(),
            "{off:?}"
        );
    }
}
