//! HEALPix pixels (Gorski et al. 2005): numbers, centres, and positions inside a base face.
//!
//! Conversions between RING and NESTED use integers only, and are exact. Rows of B need directions to the last bits, and at points
//! other than pixel centres.

use std::cmp::Ordering;
use std::f64::consts::{FRAC_PI_2, FRAC_PI_4, PI};

use crate::units::vector::Vec3;

/// Maximum nside of maps.
#[doc(hidden)]
pub const NSIDE_MAX: usize = 8192;

/// Ring of each base face's southern corner, in units of nside (Gorski et al. 2005, `jrll`).
const FACE_RING: [u8; 12] = [2, 2, 2, 2, 3, 3, 3, 3, 4, 4, 4, 4];
/// Longitude of each base face's centre in units of pi/4 (`jpll`).
const FACE_LONGITUDE: [u8; 12] = [1, 3, 5, 7, 0, 2, 4, 6, 1, 3, 5, 7];

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

/// Returns the nside of a map of `pixels` pixels, if it is valid.
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
    /// RING number of the first pixel.
    pub first: usize,
    /// Number of pixels.
    pub len: usize,
    /// Cosine of the colatitude.
    pub z: f64,
    /// Sine of the colatitude, accurate near the poles.
    pub sin_theta: f64,
    /// Longitude of the first pixel, rad.
    pub phi0_rad: f64,
}

/// Returns ring `k` = 1 .. 4 nside - 1, counted from the north.
#[must_use]
#[doc(hidden)]
pub fn ring(nside: usize, k: usize) -> Ring {
    let n = nside as f64;
    let southern = k > 2 * nside;
    let north = if southern { 4 * nside - k } else { k };
    let (z, sin_theta) = if north < nside {
        let from_pole = (north * north) as f64 / (3.0 * n * n);
        (1.0 - from_pole, (from_pole * (2.0 - from_pole)).sqrt())
    } else {
        let z = (2 * nside - north) as f64 * 2.0 / (3.0 * n);
        (z, ((1.0 - z) * (1.0 + z)).sqrt())
    };
    let RingPixels { first, len, is_shifted } = ring_pixels(nside, k);
    let phi0_rad = if is_shifted { PI / len as f64 } else { 0.0 };
    Ring { first, len, z: if southern { -z } else { z }, sin_theta, phi0_rad }
}

/// Pixel numbers of a ring.
struct RingPixels {
    first: usize,
    len: usize,
    /// Whether the first pixel is centred half a pixel east of longitude 0 instead of on it.
    is_shifted: bool,
}

fn ring_pixels(nside: usize, k: usize) -> RingPixels {
    let southern = k > 2 * nside;
    let north = if southern { 4 * nside - k } else { k };
    let (before, len, is_shifted) = if north < nside {
        (2 * north * (north - 1), 4 * north, true)
    } else {
        let belt = north - nside;
        (2 * nside * (nside - 1) + belt * 4 * nside, 4 * nside, belt.is_multiple_of(2))
    };
    let first = if southern { pixel_count(nside) - before - len } else { before };
    RingPixels { first, len, is_shifted }
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
    let ring = f64::from(FACE_RING[face]) - x - y;
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
    let phi = FRAC_PI_4 * (f64::from(FACE_LONGITUDE[face]) + offset);
    let (sin, cos) = phi.sin_cos();
    [sin_theta * cos, sin_theta * sin, z]
}

/// NESTED number of a RING pixel.
#[must_use]
pub fn ring_to_nested(nside: usize, pixel: usize) -> usize {
    let (k, column) = ring_and_column(nside, pixel);
    let RingPixels { len, is_shifted, .. } = ring_pixels(nside, k);
    // Longitude of the centre in half pixels of the ring.
    let longitude = 2 * column + usize::from(is_shifted);
    let quarter = len / 4;
    let face = if k < nside {
        column / quarter
    } else if k > 3 * nside {
        8 + column / quarter
    } else {
        // Counts the edges of base faces west of the centre, as in `pixel_of`; no centre lies on an edge.
        let ascending = (longitude + k - nside) / (2 * nside);
        let descending = (longitude + 3 * nside - k) / (2 * nside);
        match ascending.cmp(&descending) {
            Ordering::Less => ascending,
            Ordering::Equal => 4 + ascending % 4,
            Ordering::Greater => 8 + descending,
        }
    };
    // x + y and x - y, in pixels of the face.
    let sum = usize::from(FACE_RING[face]) * nside - 1 - k;
    let centre = usize::from(FACE_LONGITUDE[face]) * quarter;
    // The face about longitude 0 has a part on either side of it.
    let longitude =
        if longitude > centre + len { longitude as isize - 2 * len as isize } else { longitude as isize };
    let difference = longitude - centre as isize;
    let x = (sum as isize + difference) / 2;
    let (x, y) = (x as usize, sum - x as usize);
    face * nside * nside + (spread_bits(x) | spread_bits(y) << 1)
}

/// Returns the ring of a RING pixel, counted from 1 at the north, and its index in the ring, from 0.
fn ring_and_column(nside: usize, pixel: usize) -> (usize, usize) {
    let cap = 2 * nside * (nside - 1);
    // Rings 1 to k of a cap have 2 k (k + 1) pixels.
    let ring_of_cap = |pixel: usize| (1 + 2 * pixel).isqrt().div_ceil(2);
    if pixel < cap {
        let ring = ring_of_cap(pixel);
        (ring, pixel - 2 * ring * (ring - 1))
    } else if pixel < pixel_count(nside) - cap {
        (nside + (pixel - cap) / (4 * nside), (pixel - cap) % (4 * nside))
    } else {
        let from_end = pixel_count(nside) - 1 - pixel;
        let ring = ring_of_cap(from_end);
        (4 * nside - ring, 2 * ring * (ring + 1) - 1 - from_end)
    }
}

/// RING number of a NESTED pixel.
#[must_use]
pub fn nested_to_ring(nside: usize, pixel: usize) -> usize {
    let (face, x, y) = nested_to_face(nside, pixel);
    let RingPixels { first, len, is_shifted } =
        ring_pixels(nside, usize::from(FACE_RING[face]) * nside - 1 - x - y);
    // Longitude as in `ring_to_nested`, plus a turn so that it is never negative.
    let longitude = usize::from(FACE_LONGITUDE[face]) * (len / 4) + 2 * len + x - y;
    first + (longitude - usize::from(is_shifted)) / 2 % len
}

/// RING number of the pixel that contains a direction, given as a vector of any length whose square does not overflow.
///
/// A direction lies between two ascending and two descending edges (Gorski et al. 2005, Sect. 4).
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
        // n sqrt(3 (1 - |z|)), without cancellation near the pole.
        let from_pole = n * (3.0 / (1.0 + z.abs())).sqrt() * (across / length);
        let east = ((inside * from_pole) as usize).min(nside - 1);
        let west = (((1.0 - inside) * from_pole) as usize).min(nside - 1);
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
    (pixel / (nside * nside), even_bits(in_face), even_bits(in_face >> 1))
}

/// Compresses bits 0, 2, 4, .. of a number of at most 32 bits.
fn even_bits(number: usize) -> usize {
    let pairs = number & 0x5555_5555;
    let fours = (pairs | pairs >> 1) & 0x3333_3333;
    let bytes = (fours | fours >> 2) & 0x0f0f_0f0f;
    let halves = (bytes | bytes >> 4) & 0x00ff_00ff;
    (halves | halves >> 8) & 0x0000_ffff
}

/// Spreads a number of at most 16 bits to bits 0, 2, 4, ..: the inverse of [`even_bits`].
fn spread_bits(number: usize) -> usize {
    let halves = (number | number << 8) & 0x00ff_00ff;
    let bytes = (halves | halves << 4) & 0x0f0f_0f0f;
    let fours = (bytes | bytes << 2) & 0x3333_3333;
    (fours | fours << 1) & 0x5555_5555
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
                // Both computations have a few roundings of numbers of order one.
                assert!(norm(sub(direction, inside)) < 1e-14, "{nside} {pixel}");
                assert_eq!(pixel_of(nside, direction), pixel);
                assert_eq!(nested_to_ring(nside, ring_to_nested(nside, pixel)), pixel);
            }
        }
    }

    /// `healpy.ring2nest` of pixels near the boundaries of caps, belt and base faces, and of some between (healpy 1.20.1:
    /// `[(p, hp.ring2nest(n, p)) for p in ...]`). `tests/sky` compares all pixels with healpy itself.
    const HEALPY: &[(usize, &[(usize, usize)])] = &[
        (
            1,
            &[
                (0, 0),
                (1, 1),
                (2, 2),
                (3, 3),
                (4, 4),
                (5, 5),
                (6, 6),
                (7, 7),
                (8, 8),
                (9, 9),
                (10, 10),
                (11, 11),
            ],
        ),
        (
            2,
            &[
                (0, 3),
                (1, 7),
                (2, 11),
                (3, 15),
                (4, 2),
                (5, 1),
                (6, 6),
                (7, 5),
                (8, 10),
                (9, 9),
                (10, 14),
                (11, 13),
                (12, 19),
                (13, 0),
                (14, 23),
                (15, 4),
                (16, 27),
                (17, 8),
                (18, 31),
                (19, 12),
                (20, 17),
                (21, 22),
                (22, 21),
                (23, 26),
                (24, 25),
                (25, 30),
                (26, 29),
                (27, 18),
                (28, 16),
                (29, 35),
                (30, 20),
                (31, 39),
                (32, 24),
                (33, 43),
                (34, 28),
                (35, 47),
                (36, 34),
                (37, 33),
                (38, 38),
                (39, 37),
                (40, 42),
                (41, 41),
                (42, 46),
                (43, 45),
                (44, 32),
                (45, 36),
                (46, 40),
                (47, 44),
            ],
        ),
        (
            4,
            &[
                (0, 15),
                (3, 63),
                (4, 14),
                (23, 55),
                (24, 10),
                (39, 53),
                (40, 79),
                (54, 51),
                (88, 70),
                (90, 90),
                (95, 105),
                (96, 102),
                (98, 122),
                (121, 142),
                (128, 97),
                (152, 138),
                (154, 134),
                (155, 133),
                (167, 181),
                (168, 136),
                (188, 128),
                (191, 176),
            ],
        ),
        (
            64,
            &[
                (0, 4095),
                (3, 16383),
                (4, 4094),
                (49, 8159),
                (2225, 15955),
                (2396, 3323),
                (2650, 15750),
                (6441, 6847),
                (8063, 13655),
                (8064, 2730),
                (8319, 13653),
                (8320, 20479),
                (13660, 13187),
                (18843, 190),
                (20077, 19358),
                (24448, 18090),
                (24575, 26965),
                (24576, 26282),
                (28074, 22701),
                (40832, 35498),
                (41087, 46421),
                (41088, 35496),
                (49148, 32768),
                (49151, 45056),
            ],
        ),
        (
            512,
            &[
                (0, 262143),
                (3, 1048575),
                (4, 262142),
                (468130, 443014),
                (523263, 873815),
                (523264, 174762),
                (525311, 873813),
                (525312, 1310719),
                (600778, 937247),
                (737705, 597273),
                (828074, 922762),
                (887842, 1298529),
                (1368226, 1692090),
                (1571840, 1157802),
                (1572863, 1725781),
                (1572864, 1682090),
                (2052175, 1596366),
                (2360110, 3085910),
                (2620416, 2271914),
                (2622463, 2970965),
                (2622464, 2271912),
                (3143136, 2623498),
                (3145724, 2097152),
                (3145727, 2883584),
            ],
        ),
        (
            8192,
            &[
                (0, 67108863),
                (3, 268435455),
                (4, 67108862),
                (93198290, 253806526),
                (134201343, 223696215),
                (134201344, 44739242),
                (134234111, 223696213),
                (134234112, 335544319),
                (143120268, 20949146),
                (397034576, 296764467),
                (402636800, 296397482),
                (402653183, 441800021),
                (402653184, 430615210),
                (505756767, 280375246),
                (536226503, 799437065),
                (544942244, 799583297),
                (642383896, 402903798),
                (671072256, 581610154),
                (671105023, 760567125),
                (671105024, 581610152),
                (679864630, 777558166),
                (722905494, 692100296),
                (805306364, 536870912),
                (805306367, 738197504),
            ],
        ),
    ];

    #[test]
    fn numbers_are_those_of_healpy() {
        for &(nside, pixels) in HEALPY {
            for &(ring, nested) in pixels {
                assert_eq!(ring_to_nested(nside, ring), nested, "nside {nside}, RING {ring}");
                assert_eq!(nested_to_ring(nside, nested), ring, "nside {nside}, NESTED {nested}");
            }
        }
    }

    /// `healpy.vec2pix(nside, x, y, z)` of healpy 1.20.1, one direction near each pole, others anywhere.
    const HEALPY_DIRECTIONS: &[(usize, [f64; 3], usize)] = &[
        (1, [-8.78395e-05, 1.11192e-05, 0.457097], 1),
        (1, [7.59302e-05, -8.71571e-05, -0.358363], 11),
        (1, [0.740177, -0.545363, 0.790896], 3),
        (1, [0.744391, -0.962966, 0.414991], 3),
        (1, [-0.997601, 0.00672793, -0.126666], 6),
        (1, [-0.593494, -0.350115, 0.612431], 2),
        (1, [-0.367096, -0.701923, 0.397024], 2),
        (32, [-1.02912e-05, 5.97879e-05, 0.528967], 1),
        (32, [-3.60431e-05, 5.99759e-05, -0.0141363], 12285),
        (32, [0.01277, -0.527612, -0.970927], 11508),
        (32, [0.866448, -0.828348, 0.689854], 3120),
        (32, [-0.264239, 0.902046, -0.201149], 7397),
        (32, [0.872884, 0.11232, -0.519729], 9154),
        (32, [0.482843, 0.348779, 0.36841], 2893),
        (1024, [-7.23513e-06, -5.56223e-05, 0.28188], 2),
        (1024, [-7.85821e-05, 3.84445e-05, -0.270774], 12582909),
        (1024, [-0.246975, 0.597047, -0.611949], 10618006),
        (1024, [-0.219082, 0.595868, -0.239049], 8506598),
        (1024, [0.426516, 0.225036, 0.882002], 770231),
        (1024, [0.983353, 0.447353, 0.617688], 3168534),
        (1024, [-0.69427, 0.425781, 0.695249], 2203289),
        (8192, [-1.97549e-05, 1.065e-05, 0.0410245], 48),
        (8192, [9.17046e-05, -3.65444e-05, -0.195831], 805306326),
        (8192, [-0.99816, -0.159631, 0.262872], 301302587),
        (8192, [0.869922, 0.847353, -0.3453], 512741307),
        (8192, [0.977722, -0.62465, 0.646504], 206681195),
        (8192, [-0.685481, -0.189803, -0.853053], 711900431),
        (8192, [0.716078, 0.657596, -0.720421], 642371362),
    ];

    #[test]
    fn directions_fall_into_the_pixels_of_healpy() {
        for &(nside, direction, pixel) in HEALPY_DIRECTIONS {
            assert_eq!(pixel_of(nside, direction), pixel, "nside {nside}, {direction:?}");
        }
    }

    #[test]
    fn any_direction_lies_near_the_centre_of_its_pixel() {
        let mut stream = crate::units::random_stream(1, crate::units::StreamKind::Probe, [0, 0]);
        let mut uniform = move || 2.0 * rand::RngExt::random::<f64>(&mut stream) - 1.0;
        for nside in [1, 2, 32, 1024, NSIDE_MAX] {
            for k in 0..20_000_u32 {
                // Every fourth direction is close to a pole.
                let squeeze = if k % 4 == 0 { 1e-4 } else { 1.0 };
                let [x, y, z] = [squeeze * uniform(), squeeze * uniform(), uniform()];
                let length = norm([x, y, z]);
                let (face, at_x, at_y) =
                    nested_to_face(nside, ring_to_nested(nside, pixel_of(nside, [x, y, z])));
                let corner = |k: usize| k as f64 / nside as f64;
                let centre = face_direction(
                    face,
                    corner(at_x) + 0.5 / nside as f64,
                    corner(at_y) + 0.5 / nside as f64,
                );
                // The corners are the farthest points: `healpy.max_pixrad(nside)` is at most 1.0690 / nside, at 8192.
                let distance = norm(sub(centre, [x / length, y / length, z / length]));
                assert!(distance < 1.0690 / nside as f64, "{nside} {x} {y} {z}: {distance}");
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
