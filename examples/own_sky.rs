//! A sky of one's own, from a FITS file: written, observed by the array, and compared with what comes back.

use std::error::Error;

use lunarray::prelude::*;
use lunarray::sky::fits::{ReadOptions, WriteOptions, read_map, write_map};
use lunarray::sky::healpix::{pixel_count, pixel_directions};

const NSIDE: usize = 8;

fn main() -> Result<(), Box<dyn Error>> {
    let folder = tempfile::tempdir()?;
    // Twice as bright towards one direction as on average: l = 1 and no more.
    let values = pixel_directions(NSIDE).iter().map(|n| 1e6 * (1.0 + n[0])).collect();
    let sky = SkyMap::new(Frame::Galactic, values)?;
    let file = folder.path().join("sky.fits");
    write_map(&file, &sky, &WriteOptions::default())?;

    let out = folder.path().join("out");
    Mission::dsl()
        .channels(&[3e6])
        .nside(NSIDE)
        .set("sky.file", file.display())
        .set("spacecraft.every_nth_window", 41)
        .set("spacecraft.every_nth_integration", 15)
        .set("spacecraft.baseline_wavelengths_max", 16)
        .out(&out)
        .run()?;
    let map = read_map(&out.join("3.000MHz/map.fits"), &ReadOptions::default())?;
    let mean_k = map.values().iter().sum::<f64>() / pixel_count(map.nside()) as f64;
    let rho = compare(&map, &sky, None, None)?.rho;
    println!("mean of the map {mean_k:.4e} K, of the sky 1e6 K; correlation at l = 1: {:.5}", rho[1]);
    if (mean_k / 1e6 - 1.0).abs() < 0.02 && rho[1] > 0.99 {
        Ok(())
    } else {
        Err("another sky came back".into())
    }
}
