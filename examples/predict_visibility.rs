//! The fringes of one bright source: |V| and phase of a pair along the orbit, until the Moon hides the source.

use std::error::Error;

use lunarray::prelude::*;
use lunarray::response::pixel::{Directions, PairGeometry, sky_sums};
use lunarray::sky::healpix::{pixel_area_sr, pixel_count};

const NSIDE: usize = 32;
const FREQUENCY_HZ: f64 = 3e6;

fn main() -> Result<(), Box<dyn Error>> {
    let array = Array::new(&ArrayConfig::default())?;
    // A sky that is dark but for one pixel, K.
    let mut sky = vec![0.0; pixel_count(NSIDE)];
    sky[pixel_count(NSIDE) / 2 + 5] = 1e9;
    let map = SkyMap::new(Frame::Ecliptic, sky)?;
    let directions = Directions::from(map.directions_ecliptic().as_slice());
    let values: Vec<f32> = map.values().iter().map(|&kelvin| kelvin as f32).collect();

    let times_s: Vec<f64> = (0..240).map(|k| f64::from(k) * array.orbital_period_s() / 240.0).collect();
    let pair = |&t_s: &f64| PairGeometry {
        r_i_m: array.position_m(0, t_s),
        r_j_m: array.position_m(1, t_s),
        frequency_hz: FREQUENCY_HZ,
        moon_radius_m: array.moon_radius_m(),
        response: AntennaResponse::Isotropic,
    };
    let pairs: Vec<PairGeometry> = times_s.iter().map(pair).collect();
    let area_sr = pixel_area_sr(NSIDE);
    let sums = sky_sums(&pairs, &directions, &values, area_sr)?;
    for (t_s, sum) in times_s.iter().zip(&sums).step_by(24) {
        let value = sum.visibility_k_sr;
        println!("{t_s:7.0} s: {:9.3e} K sr, {:7.1} degrees", value.norm(), value.arg().to_degrees());
    }
    let seen = sums.iter().filter(|sum| sum.visibility_k_sr.norm() > 0.5e9 * area_sr).count();
    let part = seen as f64 / sums.len() as f64;
    println!("the source is seen for {:.0} % of an orbit", 100.0 * part);
    // From 300 km the Moon covers 29 % of the sky.
    if (0.5..1.0).contains(&part) { Ok(()) } else { Err("the Moon hides too much or nothing".into()) }
}
