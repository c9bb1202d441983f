//! `lunarray sky`: the generated sky.

use std::path::PathBuf;

use clap::Args;

use super::{CommandResult, Outcome, print_text};
use crate::mother::BAND_HZ;
use crate::products::pictures::{MapPanel, Palette, Scale, Stretch, View, draw_map};
use crate::sky::fits::{WriteOptions, write_map};
use crate::sky::generated::{GeneratedSky, generate};
use crate::sky::{Frame, GENERATED_NSIDE_MAX, SkyMap};

/// Write the generated sky as a HEALPix FITS map, and a picture of it.
///
/// Diffuse Galactic emission with free-free absorption, small-scale fluctuations and point sources,
/// in K and ecliptic coordinates. The same seed gives the same sky at every frequency and nside.
#[derive(Debug, Args)]
pub(super) struct SkyArgs {
    /// Frequency, Hz: 0.1 MHz to 120 MHz.
    #[arg(long)]
    freq_hz: f64,
    /// HEALPix nside: a power of two up to 1024.
    #[arg(long, default_value_t = 64)]
    nside: usize,
    /// Map to write (FITS); a picture of it goes beside it with the ending .png.
    #[arg(short, long, value_name = "FILE")]
    out: PathBuf,
    /// Seed of the fluctuations and sources.
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Leave the picture out.
    #[arg(long)]
    no_picture: bool,
}

pub(super) fn execute(args: &SkyArgs) -> CommandResult {
    let SkyArgs { freq_hz, nside, seed, .. } = *args;
    if !(BAND_HZ[0]..=BAND_HZ[1]).contains(&freq_hz) {
        return Err(format!("--freq-hz {freq_hz}: expected {} Hz to {} Hz", BAND_HZ[0], BAND_HZ[1]).into());
    }
    if !nside.is_power_of_two() || nside > GENERATED_NSIDE_MAX {
        return Err(
            format!("--nside {nside}: expected a power of two from 1 to {GENERATED_NSIDE_MAX}").into()
        );
    }
    let values = generate(&GeneratedSky::default(), freq_hz, nside, seed)?;
    let mean = values.iter().sum::<f64>() / values.len() as f64;
    let map = SkyMap::new(Frame::Ecliptic, values)?;
    write_map(&args.out, &map, &WriteOptions::default())?;
    print_text(&format!("{}: nside {nside}, {freq_hz} Hz, mean {mean:.4e} K", args.out.display()))?;
    if !args.no_picture {
        let picture = args.out.with_extension("png");
        let title = format!("Generated sky, {} MHz", freq_hz / 1e6);
        let panel = MapPanel {
            values: map.values(),
            caption: title,
            scale: Scale::robust(map.values(), Stretch::Log, Palette::default()),
            unit: "K".to_owned(),
        };
        draw_map(&panel, &format!("seed {seed}, nside {nside}"), &View::default())?.write(&picture)?;
        print_text(&format!("{}: picture", picture.display()))?;
    }
    Ok(Outcome::Done)
}
