//! A map of the sky at 3 MHz in one chain of calls: simulated, sent down, received, solved, drawn.
//!
//! `cargo run --release --example quick_map [FOLDER]` leaves the map, its picture and the downlink in the folder.

use std::error::Error;
use std::path::PathBuf;

use lunarray::prelude::*;

fn main() -> Result<(), Box<dyn Error>> {
    let folder = tempfile::tempdir()?;
    let out = std::env::args().nth(1).map_or_else(|| folder.path().to_owned(), PathBuf::from);
    let summary = Mission::dsl()
        .channels(&[3e6])
        .nside(8)
        .set("spacecraft.every_nth_window", 41)
        .set("spacecraft.every_nth_integration", 15)
        .set("spacecraft.baseline_wavelengths_max", 16)
        .out(&out)
        .run()?;
    let channel = &summary.channels[0];
    let rho = channel.rho.as_ref().ok_or("the generated sky is known")?;
    let picture = out.join("3.000MHz/map.png");
    println!("{} visibilities, mean {:.3e} K", channel.visibilities, channel.mean_k);
    println!("correlation with the sky at l = 2, 4, 8: {:.3} {:.3} {:.3}", rho[2], rho[4], rho[8]);
    println!("picture: {}", picture.display());
    if rho[4] > 0.9 && picture.exists() { Ok(()) } else { Err("the sky did not come back".into()) }
}
