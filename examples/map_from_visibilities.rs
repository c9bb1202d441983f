//! A map from visibilities made elsewhere: their times, the positions of both antennas and their values are given;
//! orbit, downlink and calibration of this crate are not used.

use std::error::Error;

use lunarray::frames::{AntennaResponse, PlacedVisibilities};
use lunarray::imaging::solve_pixels;
use lunarray::imaging::{NormalEngine, NormalSums, PixelEngine, PixelSetup};
use lunarray::response::pixel::{Directions, PairGeometry, PixelMethod, sky_sums};
use lunarray::sky::generated::{GeneratedSky, generate};
use lunarray::sky::healpix::pixel_area_sr;
use lunarray::sky::{Frame, SkyMap, compare};
use lunarray::units::constants::MOON_RADIUS_M;
use lunarray::units::vector::{Vec3, add, scale, unit};

const FREQUENCY_HZ: f64 = 3e6;
const NSIDE: usize = 8;

/// Positions of two antennas, m, in ecliptic axes with the Moon's centre as origin. Here: spread over a sphere
/// 300 km above the surface, with baselines up to three wavelengths.
fn positions(number: usize) -> [Vec3; 2] {
    // Fractions that follow each other without a pattern (multiples of irrational numbers).
    let fraction = |step: f64| (0.5 + step * number as f64).fract();
    let direction = |a: f64, b: f64| {
        let (z, phi) = (2.0 * a - 1.0, std::f64::consts::TAU * b);
        let r = (1.0 - z * z).sqrt();
        unit([r * phi.cos(), r * phi.sin(), z])
    };
    let first = scale(MOON_RADIUS_M + 3e5, direction(fraction(0.618_034), fraction(0.754_878)));
    let baseline = scale(300.0 * fraction(0.671_044), direction(fraction(0.569_840), fraction(0.819_173)));
    [first, add(first, baseline)]
}

fn main() -> Result<(), Box<dyn Error>> {
    // Elsewhere: somebody's visibilities, K sr. Here they are sums over a sky, so that the map has a truth.
    let sky = SkyMap::new(Frame::Ecliptic, generate(&GeneratedSky::default(), FREQUENCY_HZ, 32, 1)?)?;
    let directions = Directions::from(sky.directions_ecliptic().as_slice());
    let values: Vec<f32> = sky.values().iter().map(|&t| t as f32).collect();
    let pair = |[r_i_m, r_j_m]: [Vec3; 2]| PairGeometry {
        r_i_m,
        r_j_m,
        frequency_hz: FREQUENCY_HZ,
        moon_radius_m: MOON_RADIUS_M,
        response: AntennaResponse::Isotropic,
    };
    let geometry: Vec<_> = (0..6_000).map(|number| pair(positions(number))).collect();
    let sums = sky_sums(&geometry, &directions, &values, pixel_area_sr(sky.nside()))?;

    // One block of them. The weight is the inverse variance of a visibility, (K sr)^-2.
    let weight = 1e-8;
    let block = PlacedVisibilities {
        frequency_hz: FREQUENCY_HZ,
        time_s: (0..geometry.len()).map(|number| number as f64).collect(),
        r_i_m: geometry.iter().map(|pair| pair.r_i_m).collect(),
        r_j_m: geometry.iter().map(|pair| pair.r_j_m).collect(),
        value_k_sr: sums.iter().map(|sum| sum.visibility_k_sr).collect(),
        weight: vec![weight; geometry.len()],
        ..PlacedVisibilities::default()
    };

    // Normal equations, then the map.
    let mut engine = PixelEngine::new(PixelSetup {
        nside: NSIDE,
        frequency_hz: FREQUENCY_HZ,
        method: PixelMethod::Average,
        moon_radius_m: MOON_RADIUS_M,
        response: AntennaResponse::Isotropic,
        companion_seed: 1,
        weight_max: 2.0 * weight,
    })?;
    let added = engine.add(&block)?;
    println!("{} visibilities added, {} kinds refused", added.visibilities, added.refused.len());
    let sums = engine.into_sums();
    println!("{} unknowns", sums.unknowns());
    let epsilon = 1e-4; // Regularisation, in units of the largest eigenvalue.
    let solution = solve_pixels(sums, epsilon, None)?;

    let map = SkyMap::new(Frame::Ecliptic, solution.map_k)?;
    let truth = SkyMap::new(Frame::Ecliptic, sky.resized(NSIDE)?.into_values())?;
    let rho = compare(&map, &truth, None, None)?.rho;
    println!("correlation with the truth at l = 2, 4, 8: {:.3} {:.3} {:.3}", rho[2], rho[4], rho[8]);
    if rho[4] > 0.9 { Ok(()) } else { Err("the sky did not come back".into()) }
}
