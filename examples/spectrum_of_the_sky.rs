//! The angular spectrum of the generated sky at three frequencies, as numbers and as a picture.
//!
//! `cargo run --release --example spectrum_of_the_sky [FILE.png]`

use std::error::Error;
use std::path::PathBuf;

use lunarray::products::pictures::{Axis, Curve, Plot, draw_plots};
use lunarray::sky::generated::{GeneratedSky, generate};
use lunarray::sky::harmonics::{AnalysisOptions, analysis};
use lunarray::sky::spectra::auto_cl;

fn main() -> Result<(), Box<dyn Error>> {
    let folder = tempfile::tempdir()?;
    let file = std::env::args().nth(1).map_or_else(|| folder.path().join("spectra.png"), PathBuf::from);
    let mut curves = Vec::new();
    for frequency_hz in [1e6, 3e6, 10e6] {
        let sky = generate(&GeneratedSky::default(), frequency_hz, 32, 1)?;
        let cl = auto_cl(&analysis(&sky, 64, &AnalysisOptions::default())?.alm);
        let label = format!("{} MHz", frequency_hz / 1e6);
        println!("{label:>6}: C_2 = {:.2e}, C_20 = {:.2e}, C_60 = {:.2e} K^2 sr", cl[2], cl[20], cl[60]);
        let points = cl.iter().enumerate().skip(1).map(|(l, power)| (l as f64, *power)).collect();
        curves.push(Curve { label, points, ..Curve::default() });
        if cl[2] < cl[60] {
            return Err("large scales are the brighter ones".into());
        }
    }
    let axis = |label: &str| Axis { label: label.to_owned(), log: true, ..Axis::default() };
    let plot = Plot { x: axis("degree l"), y: axis("C_{l} (K^2 sr)"), curves, ..Plot::default() };
    draw_plots("The generated sky", &[plot], 1)?.write(&file)?;
    println!("picture: {}", file.display());
    Ok(())
}
