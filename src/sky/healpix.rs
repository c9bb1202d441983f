//! HEALPix pixels (Gorski et al. 2005): numbers, centres, continuous positions inside a face.
//!
//! Conversions between RING and NESTED are those of `cdshealpix`. The search is written here for speed, and directions
//! because rows of B need them to the last bits and at points other than pixel centres.

use std::f64::consts::{FRAC_PI_2, FRAC_PI_4, PI};

use crate::units::vector::Vec3;

/// Greatest nside of maps.
#[doc(hidden)]
pub const NSIDE_MAX: usize = 8192;

/// Ring of each base face's southern corner, in units of nside (Gorski et al. 2005, `jrll`).
const FACE_RING: [f64; 12] = [2., 2., 2., 2., 3., 3., 3., 3., 4., 4., 4., 4.];
/// Longitude of each base face's centre in units of pi/4 (`jpll`).
const FACE_LONGITUDE: [f64; 12] = [1., 3., 5., 7., 0., 2., 4., 6., 1., 3., 5., 7.];

/// Whether `nside` is a power of two between 1 and [`NSIDE_MAX`].
#[must_use]
#[doc(hidden)]
pub fn is_valid_nside(nside: usize) -> bool {
    nside.is_power_of_two() && nside <= NSIDE_MAX
}

/// Number of pixels.
#[must_use]
pub const fn pixel_count(nside: usize) -> usize {
    12 * nside * nside
}

/// The nside of a map of `pixels` pixels, if it is valid.
#[must_use]
pub fn nside_of(pixels: usize) -> Option<usize> {
    let nside = ((pixels / 12) as f64).sqrt().round() as usize;
    (is_valid_nside(nside) && pixel_count(nside) == pixels).then_some(nside)
}

/// Solid angle of a pixel, sr.
#[must_use]
pub fn pixel_area_sr(nside: usize) -> f64 {
    4.0 * PI / pixel_count(nside) as f64
}

/// A ring of pixels.
#[derive(Clone, Copy, Debug, PartialEq)]
#[doc(hidden)]
pub struct Ring {
    /// RING number of its first pixel.
    pub first: usize,
    /// Number of pixels.
    pub len: usize,
    /// cos(colatitude).
    pub z: f64,
    /// sin(colatitude), accurate near the poles.
    pub sin_theta: f64,
    /// Longitude of the first pixel, rad.
    pub phi0_rad: f64,
}

/// Ring `k` = 1 .. 4 nside - 1, counted from the north.
#[must_use]
#[doc(hidden)]
pub fn ring(nside: usize, k: usize) -> Ring {
    let n = nside as f64;
    let southern = k > 2 * nside;
    let north = if southern { 4 * nside - k } else { k };
    let (len, z, sin_theta, shifted) = if north < nside {
        let from_pole = (north * north) as f64 / (3.0 * n * n);
        (4 * north, 1.0 - from_pole, (from_pole * (2.0 - from_pole)).sqrt(), true)
    } else {
        let z = (2 * nside - north) as f64 * 2.0 / (3.0 * n);
        (4 * nside, z, ((1.0 - z) * (1.0 + z)).sqrt(), (north - nside).is_multiple_of(2))
    };
    let before = if north < nside {
        2 * north * (north - 1)
    } else {
        2 * nside * (nside - 1) + (north - nside) * 4 * nside
    };
    let first = if southern { pixel_count(nside) - before - len } else { before };
    let phi0_rad = if shifted { PI / len as f64 } else { 0.0 };
    Ring { first, len, z: if southern { -z } else { z }, sin_theta, phi0_rad }
}

/// Directions of all pixel centres in RING order.
#[must_use]
pub fn pixel_directions(nside: usize) -> Vec<Vec3> {
    let mut directions = Vec::with_capacity(pixel_count(nside));
    for k in 1..4 * nside {
        let ring = ring(nside, k);
        for p in 0..ring.len {
            let phi = ring.phi0_rad + 2.0 * PI * p as f64 / ring.len as f64;
            let (sin, cos) = phi.sin_cos();
            directions.push([ring.sin_theta * cos, ring.sin_theta * sin, ring.z]);
        }
    }
    directions
}

/// Direction of the point (x, y), 0 <= x, y <= 1, of base face `face` (0 .. 11).
///
/// x runs north-east and y north-west, as in the NESTED scheme: pixel (ix, iy) of a face has its
/// centre at ((ix + 1/2) / nside, (iy + 1/2) / nside). Area is uniform in (x, y).
#[must_use]
#[doc(hidden)]
pub fn face_direction(face: usize, x: f64, y: f64) -> Vec3 {
    let ring = FACE_RING[face] - x - y;
    let (z, sin_theta, scale) = if ring < 1.0 {
        let from_pole = ring * ring / 3.0;
        (1.0 - from_pole, (from_pole * (2.0 - from_pole)).sqrt(), ring)
    } else if ring > 3.0 {
        let scale = 4.0 - ring;
        let from_pole = scale * scale / 3.0;
        (from_pole - 1.0, (from_pole * (2.0 - from_pole)).sqrt(), scale)
    } else {
        let z = (2.0 - ring) * 2.0 / 3.0;
        (z, ((1.0 - z) * (1.0 + z)).sqrt(), 1.0)
    };
    let offset = if scale > 0.0 { (x - y) / scale } else { 0.0 };
    let phi = FRAC_PI_4 * (FACE_LONGITUDE[face] + offset);
    let (sin, cos) = phi.sin_cos();
    [sin_theta * cos, sin_theta * sin, z]
}

/// NESTED number of a RING pixel.
#[must_use]
pub fn ring_to_nested(nside: usize, pixel: usize) -> usize {
    let depth = nside.trailing_zeros() as u8;
    cdshealpix::nested::get(depth).from_ring(pixel as u64) as usize
}

/// RING number of a NESTED pixel.
#[must_use]
pub fn nested_to_ring(nside: usize, pixel: usize) -> usize {
    let depth = nside.trailing_zeros() as u8;
    cdshealpix::nested::get(depth).to_ring(pixel as u64) as usize
}

/// RING number of the pixel that contains a direction, given as a vector of any length with a normal square.
///
/// Gorski et al. 2005, Sect. 4: a direction lies between two ascending and two descending edges.
#[must_use]
pub fn pixel_of(nside: usize, direction: Vec3) -> usize {
    let [x, y, height] = direction;
    let across = (x * x + y * y).sqrt();
    let length = (across * across + height * height).sqrt();
    let z = if length > 0.0 { height / length } else { 0.0 };
    let n = nside as f64;
    // Longitude in right angles, 0 <= turn < 4.
    let turn = (y.atan2(x) / FRAC_PI_2).rem_euclid(4.0);
    let turn = if turn < 4.0 { turn } else { 0.0 };
    if z.abs() <= 2.0 / 3.0 {
        // Numbers of the ascending and descending edges west of the direction.
        let (middle, tilt) = (n * (0.5 + turn), n * z * 0.75);
        let (ascending, descending) = ((middle - tilt) as usize, (middle + tilt) as usize);
        // Ring counted from the last one of the northern cap.
        let ring = (nside + 1 + ascending).saturating_sub(descending).clamp(1, 2 * nside + 1);
        let shift = usize::from(ring.is_multiple_of(2));
        let column = (ascending + descending + 1 + shift).saturating_sub(nside) / 2 % (4 * nside);
        2 * nside * (nside - 1) + (ring - 1) * 4 * nside + column
    } else {
        let inside = turn.fract();
        // sqrt(3 (1 - |z|)), exact near the pole.
        let reach = n * (3.0 / (1.0 + z.abs())).sqrt() * (across / length);
        let east = ((inside * reach) as usize).min(nside - 1);
        let west = (((1.0 - inside) * reach) as usize).min(nside - 1);
        let ring = (east + west + 1).min(nside);
        let column = ((turn * ring as f64) as usize) % (4 * ring);
        if z > 0.0 {
            2 * ring * (ring - 1) + column
        } else {
            pixel_count(nside) - 2 * ring * (ring + 1) + column
        }
    }
}

/// Base face and integer position (ix, iy) of a NESTED pixel.
#[must_use]
#[doc(hidden)]
pub fn nested_to_face(nside: usize, pixel: usize) -> (usize, usize, usize) {
    let in_face = pixel % (nside * nside);
    let deinterleave =
        |bits: usize| (0..usize::BITS / 2).fold(0, |acc, k| acc | ((bits >> (2 * k)) & 1) << k);
    (pixel / (nside * nside), deinterleave(in_face), deinterleave(in_face >> 1))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::units::vector::{norm, sub};

    #[test]
    fn centres_agree_with_faces_and_with_the_search() {
        for nside in [1, 2, 4, 16, 64] {
            let directions = pixel_directions(nside);
            assert_eq!(directions.len(), pixel_count(nside));
            for (pixel, &direction) in directions.iter().enumerate() {
                let (face, x, y) = nested_to_face(nside, ring_to_nested(nside, pixel));
                let centre = |k: usize| (k as f64 + 0.5) / nside as f64;
                let inside = face_direction(face, centre(x), centre(y));
                // Two routes of a few roundings each to numbers of order one.
                assert!(norm(sub(direction, inside)) < 1e-14, "{nside} {pixel}");
                assert_eq!(pixel_of(nside, direction), pixel);
                assert_eq!(nested_to_ring(nside, ring_to_nested(nside, pixel)), pixel);
            }
        }
    }

    #[test]
    fn directions_fall_into_the_pixels_of_cdshealpix() {
        let mut stream = crate::units::random_stream(1, crate::units::StreamKind::Probe, [0, 0]);
        let mut uniform = move || 2.0 * rand::RngExt::random::<f64>(&mut stream) - 1.0;
        for nside in [1, 2, 32, 1024, NSIDE_MAX] {
            for k in 0..20_000_u32 {
                // Every fourth direction close to a pole.
                let squeeze = if k % 4 == 0 { 1e-4 } else { 1.0 };
                let direction = [squeeze * uniform(), squeeze * uniform(), uniform()];
                let longitude = direction[1].atan2(direction[0]).rem_euclid(4.0 * FRAC_PI_2);
                let latitude = direction[2].atan2(direction[0].hypot(direction[1]));
                let depth = nside.trailing_zeros() as u8;
                let nested = cdshealpix::nested::hash(depth, longitude, latitude);
                let expected = cdshealpix::nested::get(depth).to_ring(nested) as usize;
                assert_eq!(pixel_of(nside, direction), expected, "{nside} {direction:?}");
            }
        }
    }

    #[test]
    fn any_numbers_fall_into_some_pixel() {
        let hostile = [0.0, -0.0, 1.0, -1.0, 1e-308, 1e308, f64::NAN, f64::INFINITY, f64::NEG_INFINITY];
        for nside in [1, 4, NSIDE_MAX] {
            for x in hostile {
                for y in hostile {
                    for z in hostile {
                        assert!(pixel_of(nside, [x, y, z]) < pixel_count(nside), "{x} {y} {z}");
                    }
                }
            }
        }
    }
}
