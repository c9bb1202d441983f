//! `lunarray sky`: write the generated sky.

use std::path::PathBuf;

use clap::Args;

use super::arguments::frequency_hz;
use super::output::{CommandResult, Completion, print_json_line, print_text};
use crate::mother::{BAND_HZ, NINTH_BAND_HZ};
use crate::pipeline::{Config, ConfigSource};
use crate::products::pictures::{ColourScale, MapPanel, Palette, Scaling, View, draw_map};
use crate::sky::fits::{WriteOptions, write_map};
use crate::sky::generated::generate;
use crate::sky::{Frame, GENERATED_NSIDE_MAX, SkyMap};

/// Write the generated sky as a HEALPix FITS map, and a picture of it.
///
/// Diffuse Galactic emission with free-free absorption, small-scale fluctuations and point sources, in K and ecliptic
/// coordinates: the sky that `lunarray run` observes with the same pipeline file, seed and settings. The same seed gives
/// the same sky at every frequency and nside.
///
/// Example: lunarray sky --freq-hz 10e6 --out sky.fits
#[derive(Debug, Args)]
pub(super) struct SkyArgs {
    /// Pipeline file (TOML) with seed and sky.generated; the embedded quicklook if none is given.
    #[arg(value_name = "PIPELINE.toml")]
    pipeline: Option<PathBuf>,
    /// Frequency, Hz, or with a unit, such as 3MHz: 0.1 MHz to 120 MHz.
    #[arg(long, value_parser = frequency_hz)]
    freq_hz: f64,
    /// HEALPix nside: a power of two up to 1024.
    #[arg(long, default_value_t = 64)]
    nside: usize,
    /// Map to write (FITS); its picture goes beside it with the extension .png.
    #[arg(short, long, value_name = "FILE")]
    out: PathBuf,
    /// Seed of fluctuations and sources, in place of the file's.
    #[arg(long)]
    seed: Option<u64>,
    /// Replace one setting, for example --set sky.generated.point_sources=false; may be repeated.
    #[arg(long = "set", value_name = "KEY=VALUE")]
    overrides: Vec<String>,
    /// Draw no picture.
    #[arg(long)]
    no_picture: bool,
    /// Print one JSON object instead of text: file, nside, freq_hz, mean_k, picture.
    #[arg(long)]
    json: bool,
}

pub(super) fn execute(args: &SkyArgs) -> CommandResult {
    let SkyArgs { freq_hz, nside, seed, .. } = *args;
    let band_hz = [BAND_HZ[0], NINTH_BAND_HZ[1]];
    if !(band_hz[0]..=band_hz[1]).contains(&freq_hz) {
        return Err(format!("--freq-hz {freq_hz}: expected {} Hz to {} Hz", band_hz[0], band_hz[1]).into());
    }
    let source = ConfigSource { file: args.pipeline.clone(), overrides: args.overrides.clone(), seed };
    let Config { seed, sky, .. } = source.load()?;
    if !nside.is_power_of_two() || nside > GENERATED_NSIDE_MAX {
        return Err(
            format!("--nside {nside}: expected a power of two from 1 to {GENERATED_NSIDE_MAX}").into()
        );
    }
    let values = generate(&sky.generated, freq_hz, nside, seed)?;
    let mean = values.iter().sum::<f64>() / values.len() as f64;
    let map = SkyMap::new(Frame::Ecliptic, values)?;
    write_map(&args.out, &map, &WriteOptions::default())?;
    let mut said = vec![format!("{}: nside {nside}, {freq_hz} Hz, mean {mean:.4e} K", args.out.display())];
    let picture = (!args.no_picture).then(|| args.out.with_extension("png"));
    if let Some(picture) = &picture {
        let title = format!("Generated sky, {} MHz", freq_hz / 1e6);
        let panel = MapPanel {
            values: map.values(),
            caption: title,
            scale: ColourScale::robust(map.values(), Scaling::Log, Palette::default()),
            unit: "K".to_owned(),
        };
        draw_map(&panel, &format!("seed {seed}, nside {nside}"), &View::default())?.write(picture)?;
        said.push(format!("{}: picture", picture.display()));
    }
    if args.json {
        print_json_line(&serde_json::json!({
            "file": args.out, "nside": nside, "freq_hz": freq_hz, "mean_k": mean, "picture": picture,
        }))?;
    } else {
        print_text(&said.join("\n"))?;
    }
    Ok(Completion::Done)
}
