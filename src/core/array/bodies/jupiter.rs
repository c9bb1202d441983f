//! Position of Jupiter as seen from the Sun.

use super::sun::AU_M;
use crate::units::vector::Vec3;

/// Mean elements by powers of Julian millennia: semi-major axis (au), eccentricity, and in degrees and arc seconds mean longitude, longitude
/// of the perihelion, inclination and longitude of the ascending node.
const AXIS_AU: [f64; 3] = [5.202_603_209_2, 1.9132e-6, -3.9e-9];
const ECCENTRICITY: [f64; 3] = [0.048_497_925_5, 0.001_632_254_2, -4.713_66e-5];
const LONGITUDE: [f64; 3] = [34.351_518_74, 109_256_603.779_91, -30.603_78];
const PERIHELION: [f64; 3] = [14.331_206_87, 7_758.751_63, 259.959_38];
const INCLINATION: [f64; 3] = [1.303_266_98, -71.558_9, 11.952_97];
const NODE: [f64; 3] = [100.464_407_02, 6_362.035_61, 326.521_78];

/// Frequency of the periodic terms in units of [`RATE`], and 1e7 times the factors of cosine and sine, for the axis (au).
const OF_AXIS: [[f64; 3]; 8] = [
    [1760.0, -23437.0, -14614.0],
    [1454.0, -2634.0, -19828.0],
    [1167.0, 6601.0, -5869.0],
    [880.0, 6259.0, 1881.0],
    [287.0, -1507.0, -4372.0],
    [2640.0, -1821.0, -2255.0],
    [19.0, 2620.0, 782.0],
    [2047.0, -2115.0, 930.0],
];
/// The same for the mean longitude, rad.
const OF_LONGITUDE: [[f64; 3]; 8] = [
    [19.0, 7610.0, -56980.0],
    [1760.0, -4997.0, 8016.0],
    [1454.0, -7689.0, 1012.0],
    [287.0, -5841.0, 1448.0],
    [1167.0, -2617.0, -3024.0],
    [880.0, 1115.0, -3710.0],
    [574.0, -748.0, 318.0],
    [2640.0, -607.0, 503.0],
];
/// Terms of the longitude that grow with time.
const GROWING: [[f64; 3]; 2] = [[19.0, 6074.0, 3767.0], [1454.0, 354.0, 577.0]];
/// Rad per Julian millennium.
const RATE: f64 = 0.359_536_20;

/// Position from the Sun's centre, m, on ecliptic axes of J2000, `t` Julian centuries of TDB after J2000.
///
/// Source: Simon et al. 1994, Astron. Astrophys. 282, 663, with the numbers that the library ERFA has (plan94): to 0.02 degrees from 1800 to 2050.
pub(super) fn position_m(t: f64) -> Vec3 {
    let t = 0.1 * t;
    let polynomial = |[a, b, c]: [f64; 3]| a + (b + c * t) * t;
    let angle = |[degrees, b, c]: [f64; 3]| (degrees + (b + c * t) * t / 3600.0).to_radians();
    let sum = |terms: &[[f64; 3]]| -> f64 {
        let of = |[rate, cosine, sine]: &[f64; 3]| {
            let (sin, cos) = (rate * RATE * t).sin_cos();
            1e-7 * (cosine * cos + sine * sin)
        };
        terms.iter().map(of).sum()
    };
    let axis_m = AU_M * (polynomial(AXIS_AU) + sum(&OF_AXIS));
    let e = polynomial(ECCENTRICITY);
    let (perihelion, node, inclination) = (angle(PERIHELION), angle(NODE), angle(INCLINATION));
    let mean = angle(LONGITUDE) + sum(&OF_LONGITUDE) + t * sum(&GROWING) - perihelion;
    // Kepler's equation by Newton's iteration: the error is squared each time, from e.
    let eccentric = (0..5).fold(mean, |x, _| x - (x - e * x.sin() - mean) / (1.0 - e * x.cos()));
    let (sin, cos) = eccentric.sin_cos();
    let (x_m, y_m) = (axis_m * (cos - e), axis_m * (1.0 - e * e).sqrt() * sin);
    let ((sin_w, cos_w), (sin_n, cos_n)) = ((perihelion - node).sin_cos(), node.sin_cos());
    // From the node, in the plane of the orbit.
    let (along, across) = (cos_w * x_m - sin_w * y_m, sin_w * x_m + cos_w * y_m);
    let (sin_i, cos_i) = inclination.sin_cos();
    [cos_n * along - sin_n * cos_i * across, sin_n * along + cos_n * cos_i * across, sin_i * across]
}
