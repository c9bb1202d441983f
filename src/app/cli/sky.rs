//! `lunarray sky`: write the generated sky.

use std::fmt::Write;
use std::path::{Path, PathBuf};

use clap::Args;

use super::arguments::{MapFileArgs, band_text, frequency_hz, output_path};
use super::output::{CommandError, CommandResult, Completion, cannot_write, print_json_line, print_text};
use crate::files::{ProtectedInputs, is_same_name, write_atomically};
use crate::mother::{BAND_HZ, NINTH_BAND_HZ};
use crate::pipeline::{Config, ConfigSource};
use crate::products::pictures::{ColourScale, MapPanel, Palette, Scaling, View, draw_map};
use crate::sky::fits::{Card, MapFile, WriteOptions, read_whole_map_file, write_map};
use crate::sky::generated::{GeneratedSky, catalogue, generate};
use crate::sky::{Frame, GENERATED_NSIDE_MAX, SkyMap};
use crate::units::Dimension;

/// Write the generated sky as a HEALPix FITS map, and a picture of it.
///
/// Diffuse Galactic emission with free-free absorption, small-scale fluctuations and point sources, in K and ecliptic
/// coordinates: the sky that `lunarray run` observes with the same pipeline file, seed and settings. The same seed gives
/// the same sky at every frequency and nside.
///
/// With --like it writes a sky to serve as a wrong prior: one with the mean and the angular power of another map, and a given correlation
/// with it at every degree. With --extrapolate-from it writes a wrong model: the sky of another frequency times a power of
/// frequency, without the absorption by gas below 10 MHz.
///
/// Examples: lunarray sky --freq-hz 10e6 --out sky.fits; lunarray sky --like sky.fits --correlation 0.8 --out wrong.fits
#[derive(Debug, Args)]
pub(super) struct SkyArgs {
    /// Pipeline file (TOML) with seed and sky.generated; the embedded quicklook if none is given.
    #[arg(value_name = "PIPELINE.toml")]
    pipeline: Option<PathBuf>,
    /// Frequency, Hz, or with a unit, such as 3MHz: 0.1 MHz to 120 MHz.
    #[arg(long, value_parser = frequency_hz, required_unless_present = "like")]
    freq_hz: Option<f64>,
    /// HEALPix nside: a power of two up to 1024.
    #[arg(long, default_value_t = 64, conflicts_with = "like")]
    nside: usize,
    /// Map to write (FITS); its picture goes beside it with the extension .png.
    #[arg(short, long, value_name = "FILE", value_parser = output_path())]
    out: PathBuf,
    /// Map (FITS) to resemble, at its own nside.
    #[arg(long, value_name = "MAP.fits", requires = "correlation", conflicts_with_all = ["freq_hz", "sources"])]
    like: Option<PathBuf>,
    /// Correlation with that map at every degree from 1 to 2 nside: 0 to 1.
    #[arg(long, requires = "like")]
    correlation: Option<f64>,
    /// Frequency, Hz or with a unit, whose sky is scaled to --freq-hz as a power of frequency.
    #[arg(long, value_parser = frequency_hz, conflicts_with = "like")]
    extrapolate_from: Option<f64>,
    /// Temperature index of that power.
    #[arg(long, default_value_t = -2.5, allow_negative_numbers = true, requires = "extrapolate_from")]
    index: f64,
    /// Table of the point sources (CSV): position, flux density at 154 MHz and at --freq-hz, without absorption.
    #[arg(long, value_name = "FILE")]
    sources: Option<PathBuf>,
    /// Seed of fluctuations and sources, in place of the file's.
    #[arg(long)]
    seed: Option<u64>,
    /// Replace one setting, for example --set sky.generated.point_sources=false; may be repeated.
    #[arg(long = "set", value_name = "KEY=VALUE")]
    overrides: Vec<String>,
    /// Draw no picture.
    #[arg(long)]
    no_picture: bool,
    #[command(flatten)]
    maps: MapFileArgs,
    /// Print one JSON object instead of text: file, nside, freq_hz, mean_k, picture, sources.
    #[arg(long)]
    json: bool,
}

pub(super) fn execute(args: &SkyArgs) -> CommandResult {
    let picture = (!args.no_picture).then(|| args.out.with_extension("png"));
    let mut others = [(&args.out, picture.as_ref()), (&args.out, args.sources.as_ref())].to_vec();
    others.extend(picture.iter().map(|picture| (picture, args.sources.as_ref())));
    let is_twice =
        |(one, other): &(&PathBuf, Option<&PathBuf>)| other.is_some_and(|other| is_same_name(one, other));
    if let Some((path, _)) = others.into_iter().find(is_twice) {
        let path = path.display();
        return Err(format!(
            "{path}: two of map, picture and --sources would be written there; expected different names"
        )
        .into());
    }
    let SkyArgs { nside, seed, .. } = *args;
    let _inputs = ProtectedInputs::of(args.pipeline.iter().chain(&args.like));
    if let (Some(path), Some(correlation)) = (&args.like, args.correlation) {
        return resemble(args, path, correlation);
    }
    let freq_hz = args.freq_hz.unwrap_or_default();
    let band_hz = [BAND_HZ[0], NINTH_BAND_HZ[1]];
    if !(band_hz[0]..=band_hz[1]).contains(&freq_hz) {
        return Err(format!(
            "--freq-hz {}: expected {}",
            Dimension::Frequency.show(freq_hz),
            band_text(band_hz)
        )
        .into());
    }
    let source = ConfigSource { file: args.pipeline.clone(), overrides: args.overrides.clone(), seed };
    let config = source.load()?;
    if config.sky.file.is_some() {
        return Err("sky.file: this command generates the sky and reads no map of it; expected a pipeline without sky.file".into());
    }
    let _named = ProtectedInputs::of(config.input_files());
    let Config { seed, sky, .. } = config;
    if !nside.is_power_of_two() || nside > GENERATED_NSIDE_MAX {
        return Err(
            format!("--nside {nside}: expected a power of two from 1 to {GENERATED_NSIDE_MAX}").into()
        );
    }
    let made_hz = args.extrapolate_from.unwrap_or(freq_hz);
    if !(band_hz[0]..=band_hz[1]).contains(&made_hz) || !(-10.0..=10.0).contains(&args.index) {
        return Err(format!(
            "--extrapolate-from {made_hz} --index {}: expected {} Hz to {} Hz, and -10 to 10",
            args.index, band_hz[0], band_hz[1]
        )
        .into());
    }
    let factor = (freq_hz / made_hz).powf(args.index);
    let values = generate(&sky.generated, made_hz, nside, seed)?.into_iter().map(|value| factor * value);
    let map = SkyMap::new(Frame::Ecliptic, values.collect())?;
    let mut report = SkyReport::write(args, &map, Some(freq_hz), &Dimension::Frequency.show(freq_hz))?;
    if let Some(path) = &args.sources {
        let count = write_sources(path, &sky.generated, freq_hz, seed)?;
        report.lines.push(format!("{}: {count} sources", path.display()));
    }
    let title = format!("Generated sky, {} MHz", freq_hz / 1e6);
    report.draw(args, &map, title, &format!("seed {seed}, nside {nside}"))?;
    report.print(args)
}

/// Writes a sky that is correlated with another map.
fn resemble(args: &SkyArgs, path: &Path, correlation: f64) -> CommandResult {
    if !(0.0..=1.0).contains(&correlation) {
        return Err(format!("--correlation {correlation}: expected 0 to 1").into());
    }
    let MapFile { map: other, frequency_hz, .. } = read_whole_map_file(path, &args.maps.options())?;
    let seed = args.seed.unwrap_or(0);
    let map = other.correlated(correlation, seed)?;
    let description = format!("correlation {correlation} with {}", path.display());
    let mut report = SkyReport::write(args, &map, frequency_hz, &description)?;
    let title = format!("A sky of correlation {correlation} with another");
    report.draw(args, &map, title, &format!("seed {seed}, nside {}", map.nside()))?;
    report.print(args)
}

/// Report on the files that were written.
struct SkyReport {
    nside: usize,
    mean_k: f64,
    picture: Option<PathBuf>,
    lines: Vec<String>,
}

impl SkyReport {
    /// Writes the map, with its frequency if that is known.
    fn write(
        args: &SkyArgs,
        map: &SkyMap,
        freq_hz: Option<f64>,
        description: &str,
    ) -> Result<Self, CommandError> {
        let (nside, mean_k) = (map.nside(), map.values().iter().sum::<f64>() / map.values().len() as f64);
        let freq = freq_hz.map(|hz| Card::real("FREQ", hz, "[Hz] centre frequency"));
        let options = WriteOptions { cards: freq.into_iter().collect(), ..WriteOptions::default() };
        write_map(&args.out, map, &options)?;
        let lines =
            vec![format!("{}: nside {nside}, {description}, mean {mean_k:.4e} K", args.out.display())];
        Ok(Self { nside, mean_k, picture: None, lines })
    }

    /// Draws the map, unless that is switched off.
    fn draw(
        &mut self,
        args: &SkyArgs,
        map: &SkyMap,
        title: String,
        subtitle: &str,
    ) -> Result<(), CommandError> {
        if args.no_picture {
            return Ok(());
        }
        let path = args.out.with_extension("png");
        let panel = MapPanel {
            values: map.values(),
            caption: title,
            scale: ColourScale::robust(map.values(), Scaling::Log, Palette::default()),
            unit: "K".to_owned(),
        };
        draw_map(&panel, subtitle, &View::of(Frame::Galactic, map.frame()))?.write(&path)?;
        self.lines.push(format!("{}: picture", path.display()));
        self.picture = Some(path);
        Ok(())
    }

    fn print(&self, args: &SkyArgs) -> CommandResult {
        if args.json {
            print_json_line(&serde_json::json!({
                "file": args.out, "nside": self.nside, "freq_hz": args.freq_hz, "mean_k": self.mean_k,
                "picture": self.picture, "sources": args.sources,
            }))?;
        } else {
            print_text(&self.lines.join("\n"))?;
        }
        Ok(Completion::Done)
    }
}

/// Writes a table of the point sources, brightest first; returns their number.
fn write_sources(path: &Path, config: &GeneratedSky, freq_hz: f64, seed: u64) -> Result<usize, CommandError> {
    let sources = catalogue(config, freq_hz, seed);
    let mut csv = "ecliptic_longitude_deg,ecliptic_latitude_deg,flux_154mhz_jy,flux_jy\n".to_owned();
    for source in &sources {
        let [longitude, latitude] = source.place_deg;
        // Writing to a string cannot fail.
        let _ =
            writeln!(csv, "{longitude:.6},{latitude:.6},{:.6},{:.6}", source.flux_154mhz_jy, source.flux_jy);
    }
    write_atomically(path, csv.as_bytes()).map_err(cannot_write(path))?;
    Ok(sources.len())
}
