//! `lunarray cutout`: pieces of maps on a plane.

use std::fmt::Write;
use std::path::PathBuf;

use clap::{Args, ValueEnum};
use serde::Serialize;

use super::arguments::picture_path;
use super::output::{CommandResult, Completion, cannot_write, print_json_line, print_text};
use crate::files::{ProtectedInputs, write_atomically};
use crate::products::pictures::{ColourScale, Palette, Patch, Scaling, draw_patches};
use crate::sky::fits::{ReadOptions, read_whole_map};
use crate::sky::{Cutout, Frame, PlaneProjection};

/// Cut the same square piece out of one or more maps, and draw them side by side.
///
/// North is up and east to the left, with a graticule. --subtract-fwhm removes large scales: it subtracts from each
/// map the same map smoothed to that FWHM. All pieces share one colour scale, that of the first map. Leaves a picture, and a table (CSV) of the
/// values beside it.
///
/// Example: lunarray cutout input-smooth.fits map-smooth.fits --centre 0,0 --subtract-fwhm 10 --out patch.png
#[derive(Debug, Args)]
pub(super) struct CutoutArgs {
    /// Maps (FITS).
    #[arg(value_name = "MAP.fits", num_args = 1.., required = true)]
    maps: Vec<PathBuf>,
    /// Longitude and latitude of the centre, degrees.
    #[arg(long, value_name = "LON,LAT", allow_hyphen_values = true, value_parser = centre)]
    centre: [f64; 2],
    /// Frame of the centre; its north is up.
    #[arg(long, value_enum, default_value_t = FrameName::Galactic)]
    frame: FrameName,
    /// Side, degrees.
    #[arg(long, value_name = "DEG", default_value_t = 20.0)]
    size: f64,
    /// Pixels along a side of the table; the picture shows the same.
    #[arg(long, default_value_t = 300, value_parser = clap::value_parser!(u16).range(2..=4000))]
    pixels: u16,
    /// Projection.
    #[arg(long, value_enum, default_value_t = ProjectionName::Gnomonic)]
    projection: ProjectionName,
    /// Subtract the map smoothed to this FWHM, degrees.
    #[arg(long, value_name = "DEG")]
    subtract_fwhm: Option<f64>,
    /// Picture (PNG, or SVG if its name ends so); the table goes beside it with the extension .csv.
    #[arg(short, long, value_name = "FILE.png", value_parser = picture_path())]
    out: PathBuf,
    /// Print one JSON object: mean and rms of each piece, and their correlation with the first.
    #[arg(long)]
    json: bool,
}

/// Frames as command-line values.
#[derive(Clone, Copy, Debug, ValueEnum)]
enum FrameName {
    Galactic,
    Ecliptic,
    Equatorial,
}

#[derive(Clone, Copy, Debug, ValueEnum)]
enum ProjectionName {
    Gnomonic,
    Cartesian,
}

#[derive(Serialize)]
struct CutoutReport {
    pieces: Vec<PieceReport>,
}

#[derive(Serialize)]
struct PieceReport {
    map: String,
    mean_k: f64,
    /// Standard deviation about the mean, K.
    rms_k: f64,
    /// Correlation with the first piece, about the means.
    correlation: f64,
}

fn centre(text: &str) -> Result<[f64; 2], String> {
    let numbers: Vec<f64> = text.split(',').filter_map(|part| part.trim().parse().ok()).collect();
    match numbers[..] {
        [l, b] if text.split(',').count() == 2 && l.abs() <= 360.0 && b.abs() <= 90.0 => Ok([l, b]),
        _ => Err("expected longitude and latitude in degrees, such as 120,-30".into()),
    }
}

pub(super) fn execute(args: &CutoutArgs) -> CommandResult {
    if !(0.1..=100.0).contains(&args.size) {
        return Err(format!("--size {}: expected 0.1 to 100 degrees", args.size).into());
    }
    if let Some(fwhm) = args.subtract_fwhm
        && !(0.01..=90.0).contains(&fwhm)
    {
        return Err(format!("--subtract-fwhm {fwhm}: expected 0.01 to 90 degrees").into());
    }
    let cutout = Cutout {
        projection: match args.projection {
            ProjectionName::Gnomonic => PlaneProjection::Gnomonic,
            ProjectionName::Cartesian => PlaneProjection::Cartesian,
        },
        frame: match args.frame {
            FrameName::Galactic => Frame::Galactic,
            FrameName::Ecliptic => Frame::Ecliptic,
            FrameName::Equatorial => Frame::Equatorial,
        },
        centre_deg: args.centre,
        size_deg: args.size,
        pixels: args.pixels.into(),
    };
    let _inputs = ProtectedInputs::of(&args.maps);
    let mut pieces: Vec<Vec<f64>> = Vec::new();
    for path in &args.maps {
        let mut map = read_whole_map(path, &ReadOptions::default())?;
        if let Some(fwhm) = args.subtract_fwhm {
            let smooth = map.smoothed(fwhm.to_radians())?;
            map.values_mut().iter_mut().zip(smooth.values()).for_each(|(value, smooth)| *value -= smooth);
        }
        pieces.push(cutout.values(&map));
    }
    let scale = match args.subtract_fwhm {
        Some(_) => ColourScale::symmetric(&pieces[0]),
        None => ColourScale::robust(&pieces[0], Scaling::Linear, Palette::default()),
    };
    let name =
        |path: &PathBuf| path.file_name().map_or_else(String::new, |n| n.to_string_lossy().into_owned());
    let patches: Vec<Patch<'_>> = args
        .maps
        .iter()
        .zip(&pieces)
        .map(|(path, values)| Patch {
            caption: name(path),
            cutout,
            values,
            scale,
            unit: "K".to_owned(),
            beam: None,
        })
        .collect();
    let title =
        args.subtract_fwhm.map_or_else(String::new, |fwhm| format!("scales above {fwhm} deg subtracted"));
    draw_patches(&title, &patches, 3)?.write(&args.out)?;
    let csv = args.out.with_extension("csv");
    write_atomically(&csv, table(&cutout, &pieces).as_bytes()).map_err(cannot_write(&csv))?;
    let report = CutoutReport {
        pieces: args
            .maps
            .iter()
            .zip(&pieces)
            .map(|(path, piece)| compare(name(path), piece, &pieces[0]))
            .collect(),
    };
    if args.json {
        print_json_line(&report)?;
        return Ok(Completion::Done);
    }
    for PieceReport { map, mean_k, rms_k, correlation } in &report.pieces {
        print_text(&format!(
            "{map}: mean {mean_k:.4e} K, rms {rms_k:.4e} K, correlation with the first {correlation:.4}"
        ))?;
    }
    print_text(&format!("{}\n{}", args.out.display(), csv.display()))?;
    Ok(Completion::Done)
}

fn compare(map: String, piece: &[f64], first: &[f64]) -> PieceReport {
    let count = piece.len() as f64;
    let mean = |values: &[f64]| values.iter().sum::<f64>() / count;
    let (mean_k, first_k) = (mean(piece), mean(first));
    let product = |a: &[f64], a_k: f64, b: &[f64], b_k: f64| {
        a.iter().zip(b).map(|(a, b)| (a - a_k) * (b - b_k)).sum::<f64>() / count
    };
    let rms_k = product(piece, mean_k, piece, mean_k).sqrt();
    let correlation =
        product(piece, mean_k, first, first_k) / rms_k / product(first, first_k, first, first_k).sqrt();
    PieceReport { map, mean_k, rms_k, correlation }
}

/// A table (CSV) of the values by position on the plane, degrees to the right and up.
fn table(cutout: &Cutout, pieces: &[Vec<f64>]) -> String {
    let mut text = "right_deg,up_deg".to_owned();
    for number in 1..=pieces.len() {
        // Writing to a string cannot fail.
        let _ = write!(text, ",map_{number}_k");
    }
    text.push('\n');
    let step = cutout.size_deg / cutout.pixels as f64;
    let offset_deg = |k: usize| (k as f64 - 0.5 * (cutout.pixels as f64 - 1.0)) * step;
    for k in 0..cutout.pixels * cutout.pixels {
        let _ = write!(text, "{:.5},{:.5}", offset_deg(k % cutout.pixels), offset_deg(k / cutout.pixels));
        for piece in pieces {
            let _ = write!(text, ",{:.8e}", piece[k]);
        }
        text.push('\n');
    }
    text
}
