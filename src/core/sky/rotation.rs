//! Rotation of maps to another frame by interpolation between pixels.

use std::f64::consts::TAU;

use rayon::prelude::*;

use super::error::MapError;
use super::frame::{Frame, rotate};
use super::healpix::{Ring, pixel_count, pixel_directions, ring};
use super::map::{SkyMap, is_unseen};
use crate::units::constants::HEALPIX_UNSEEN;
use crate::units::vector::Vec3;

/// Pixels of one task; fixed, so that results do not depend on the number of threads.
const PIXELS_PER_TASK: usize = 4096;

/// A ring and its colatitude, rad.
type PlacedRing = (Ring, f64);

/// Bilinear interpolation on a HEALPix map, as in healpy's `get_interp_val`.
///
/// Weights are linear in longitude along the two rings that enclose a direction, and linear in colatitude between them. Beyond the
/// last ring, the value at the pole is the mean of that ring's four pixels.
#[derive(Clone, Debug)]
pub struct Bilinear {
    nside: usize,
    /// Rings 1 .. 4 nside - 1.
    rings: Vec<PlacedRing>,
}

impl Bilinear {
    /// Prepares interpolation on maps of `nside`.
    ///
    /// # Errors
    /// [`MapError::Nside`].
    pub fn new(nside: usize) -> Result<Self, MapError> {
        crate::sky::map::check_nside(nside)?;
        let with_colatitude = |k| {
            let ring = ring(nside, k);
            (ring, ring.sin_theta.atan2(ring.z))
        };
        Ok(Self { nside, rings: (1..4 * nside).map(with_colatitude).collect() })
    }

    /// Returns four RING pixels and their weights, which add up to 1, for a vector of any length.
    #[must_use]
    pub fn weights(&self, [x, y, z]: Vec3) -> [(usize, f64); 4] {
        let colatitude = x.hypot(y).atan2(z);
        let longitude = y.atan2(x).rem_euclid(TAU);
        let [above, below] = self.rings_around(colatitude);
        match (above, below) {
            (Some((north, theta_north)), Some((south, theta_south))) => {
                let down = (colatitude - theta_north) / (theta_south - theta_north);
                let ([a, b], [c, d]) = (along(north, longitude), along(south, longitude));
                [(a.0, a.1 * (1.0 - down)), (b.0, b.1 * (1.0 - down)), (c.0, c.1 * down), (d.0, d.1 * down)]
            }
            (None, Some((south, theta_south))) => cap(south, longitude, 1.0 - colatitude / theta_south),
            (Some((north, theta_north)), None) => {
                let last = std::f64::consts::PI;
                cap(north, longitude, (colatitude - theta_north) / (last - theta_north))
            }
            // There are at least three rings.
            (None, None) => [(0, 0.25); 4],
        }
    }

    /// Value of `map` (RING order) in a direction; UNSEEN if a pixel with non-zero weight is UNSEEN.
    #[must_use]
    pub fn value(&self, map: &[f64], direction: Vec3) -> f64 {
        let mut sum = 0.0;
        for (pixel, weight) in self.weights(direction) {
            if is_unseen(map[pixel]) && weight != 0.0 {
                return HEALPIX_UNSEEN;
            }
            sum += weight * map[pixel];
        }
        sum
    }

    /// The last ring at or above a colatitude, and the first below it.
    fn rings_around(&self, colatitude: f64) -> [Option<&PlacedRing>; 2] {
        let n = self.nside as f64;
        let (sin, cos) = colatitude.sin_cos();
        // The formula for the colatitude of a ring is inverted, and the result corrected for rounding.
        let guess = if cos.abs() <= 2.0 / 3.0 {
            n * (2.0 - 1.5 * cos)
        } else {
            // sqrt(3 (1 - |cos|)) without cancellation.
            let from_pole = n * (3.0 * sin * sin / (1.0 + cos.abs())).sqrt();
            if cos > 0.0 { from_pole } else { 4.0 * n - from_pole }
        };
        let mut above = (guess as usize).min(self.rings.len());
        while above > 0 && self.rings[above - 1].1 > colatitude {
            above -= 1;
        }
        while above < self.rings.len() && self.rings[above].1 <= colatitude {
            above += 1;
        }
        [above.checked_sub(1).map(|k| &self.rings[k]), self.rings.get(above)]
    }
}

/// The two pixels of a ring around a longitude, with weights that add up to 1.
fn along(ring: &Ring, longitude: f64) -> [(usize, f64); 2] {
    let len = ring.len as f64;
    let position = (longitude - ring.phi0_rad) / TAU * len;
    let first = position.floor();
    let east = position - first;
    let first = first.rem_euclid(len) as usize % ring.len;
    let second = (first + 1) % ring.len;
    [(ring.first + first, 1.0 - east), (ring.first + second, east)]
}

/// Pixels and weights between the first or last ring and the pole, at a fraction of the way to the pole.
fn cap(ring: &Ring, longitude: f64, fraction: f64) -> [(usize, f64); 4] {
    let [(a, weight_a), (b, weight_b)] = along(ring, longitude);
    let opposite = |pixel: usize| ring.first + (pixel - ring.first + 2) % 4;
    let (ring_part, pole_part) = (1.0 - fraction, 0.25 * fraction);
    [
        (a, weight_a * ring_part + pole_part),
        (b, weight_b * ring_part + pole_part),
        (opposite(a), pole_part),
        (opposite(b), pole_part),
    ]
}

impl SkyMap {
    /// Rotates the map to another frame, by [`Bilinear`] interpolation at the new pixel centres (healpy: `rotate_map_pixel`).
    /// Some power near the pixel scale is lost; [`SkyMap::directions_ecliptic`] avoids the loss.
    #[must_use]
    #[doc(hidden)]
    pub fn rotate_pixels(&self, frame: Frame) -> Self {
        let (Ok(bilinear), true) = (Bilinear::new(self.nside()), frame != self.frame()) else {
            return self.clone();
        };
        let back = frame.to_frame(self.frame());
        let directions = pixel_directions(self.nside());
        let mut values = vec![0.0; pixel_count(self.nside())];
        let tasks = values.par_chunks_mut(PIXELS_PER_TASK).zip(directions.par_chunks(PIXELS_PER_TASK));
        tasks.for_each(|(values, directions)| {
            for (value, &direction) in values.iter_mut().zip(directions) {
                *value = bilinear.value(self.values(), rotate(&back, direction));
            }
        });
        self.with_values(frame, values)
    }

    /// Rotates the map to the ecliptic frame, see [`SkyMap::rotate_pixels`].
    #[must_use]
    pub fn to_ecliptic(&self) -> Self {
        self.rotate_pixels(Frame::Ecliptic)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn centres_have_their_own_values() {
        for nside in [1, 2, 8, 32] {
            let bilinear = Bilinear::new(nside).unwrap();
            for (pixel, &direction) in pixel_directions(nside).iter().enumerate() {
                let weight: f64 =
                    bilinear.weights(direction).iter().filter(|(p, _)| *p == pixel).map(|(_, w)| w).sum();
                // Colatitude and longitude have errors of 1e-16 rad, relative to a pixel of 1 / nside.
                assert!((weight - 1.0).abs() < 1e-13, "{nside} {pixel} {weight}");
            }
        }
    }

    #[test]
    fn weights_are_shares_and_a_smooth_field_is_met() {
        let nside = 64;
        let bilinear = Bilinear::new(nside).unwrap();
        let field = |[x, y, z]: Vec3| 1.0 + x + 2.0 * y * z;
        let map: Vec<f64> = pixel_directions(nside).into_iter().map(field).collect();
        // Points off the pixel centres, including poles and the meridian of longitude 0.
        let mut points = pixel_directions(16);
        points.extend([
            [0.0, 0.0, 1.0],
            [0.0, 0.0, -1.0],
            [1.0, 0.0, 0.0],
            [1.0, -1e-300, 0.0],
            [0.0, 1e-20, 1.0],
        ]);
        for point in points {
            let weights = bilinear.weights(point);
            assert!((weights.iter().map(|(_, w)| w).sum::<f64>() - 1.0).abs() < 1e-14);
            assert!(weights.iter().all(|(pixel, w)| *w >= -1e-14 && *pixel < map.len()));
            // Second differences: a field of curvature 4 over a pixel of 1 / 64 rad, 4 / 8 / 64^2 = 1.2e-4; next
            // to the poles, where pixels are pi / 2 k of longitude at k 0.013 rad, 0.013 pi^2 / 32 / k = 4e-3 / k.
            let tolerance = if point[2].abs() < 0.9 { 5e-4 } else { 5e-3 };
            assert!((bilinear.value(&map, point) - field(point)).abs() < tolerance, "{point:?}");
        }
    }

    #[test]
    fn unseen_pixels_spread_to_where_they_count() {
        let mut map = SkyMap::constant(8, Frame::Galactic, 2.0).unwrap();
        map.values_mut()[300] = HEALPIX_UNSEEN;
        let turned = map.to_ecliptic();
        let unseen = turned.values().iter().filter(|&&value| is_unseen(value)).count();
        assert!((1..=16).contains(&unseen), "{unseen}");
        let seen = turned.values().iter().filter(|&&value| !is_unseen(value));
        assert!(seen.into_iter().all(|value| (value - 2.0).abs() < 1e-14));
    }
}
