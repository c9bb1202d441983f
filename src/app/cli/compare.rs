//! `lunarray compare`: compare a map with the truth, or runs with one another.

use std::path::{Path, PathBuf};

use clap::Args;

use super::arguments::{MapFileArgs, picture_path};
use super::output::{CommandError, CommandResult, Completion, print_json_line, print_notes, print_text};
use crate::files::ProtectedInputs;
use crate::products::{RunFigures, draw_comparison, draw_relative_error, draw_runs, runs_csv};
use crate::sky::Frame;
use crate::sky::fits::read_whole_map_file;
use crate::sky::{Comparison, SkyMap, compare};
use crate::units::Dimension;

/// Compare a map with the truth, degree by degree; or runs with one another.
///
/// Two maps are HEALPix FITS maps in K; they are converted to ecliptic axes and to the coarser of the two resolutions. rho_l =
/// C_l^X / sqrt(C_l^in C_l^re) is the correlation of map and truth at degree l, whatever the scale of the map; with a noise-only
/// map, SNR_l = C_l^X / sqrt(C_l^in C_l^ns). Draws these curves, and the relative error (map - truth) / truth over the sky.
///
/// For output folders of runs, it prints their figures as a table (CSV) and draws their curves over one another.
///
/// Examples: lunarray compare map.fits input.fits --noise noise.fits;
/// lunarray compare out/first out/second out/third --plot curves.png
#[derive(Debug, Args)]
pub(super) struct CompareArgs {
    /// A map and the truth (FITS); or two or more output folders of runs.
    #[arg(value_name = "MAP.fits TRUTH.fits|RUN", num_args = 2.., required = true)]
    paths: Vec<PathBuf>,
    /// Noise-only map (FITS), for SNR_l.
    #[arg(long, value_name = "NOISE.fits")]
    noise: Option<PathBuf>,
    #[command(flatten)]
    maps: MapFileArgs,
    /// Limit the truth to degrees up to L instead of averaging it over the map's pixels; for maps of harmonics up to
    /// degree L.
    #[arg(long, value_name = "L")]
    band_limit: Option<usize>,
    /// Maximum degree; 3 nside - 1 if not given.
    #[arg(long)]
    l_max: Option<usize>,
    /// Picture of the curves (PNG, or SVG if its name ends so); MAP-spectra.png, or compare.png of runs, if not given; none with --json. The picture
    /// of the relative error goes beside it, with -error before the extension.
    #[arg(long, value_name = "FILE", value_parser = picture_path())]
    plot: Option<PathBuf>,
    /// Draw no pictures.
    #[arg(long, conflicts_with = "plot")]
    no_plot: bool,
    /// Print one JSON object: l, cl_map, cl_truth, cl_cross, rho and, with noise, snr as arrays.
    #[arg(long)]
    json: bool,
}

pub(super) fn execute(args: &CompareArgs) -> CommandResult {
    let _inputs = ProtectedInputs::of(args.paths.iter().chain(&args.noise));
    let [map_path, truth_path] = &args.paths[..] else { return compare_runs(args) };
    if map_path.is_dir() {
        return compare_runs(args);
    }
    let read = |path: &Path| read(path, args.maps);
    let (map, map_hz) = read(map_path)?;
    let (mut truth, truth_hz) = read(truth_path)?;
    if let (Some(map_hz), Some(truth_hz)) = (map_hz, truth_hz)
        && (map_hz - truth_hz).abs() > 1e-6 * truth_hz
    {
        let [map, truth] = [map_hz, truth_hz].map(|hz| Dimension::Frequency.show(hz));
        print_notes([format!("the map is at {map}, the truth at {truth}, as their headers say")]);
    }
    if let Some(l_max) = args.band_limit {
        truth = truth.band_limited(map.nside(), l_max)?;
    }
    let noise = args.noise.as_deref().map(read).transpose()?.map(|(noise, _)| noise);
    let comparison = compare(&map, &truth, noise.as_ref(), args.l_max)?;
    if args.json {
        print_json_line(&comparison)?;
    } else {
        print_text(&table(&comparison))?;
    }
    // With --json, pictures are drawn only on request.
    let draws = !args.no_plot && (args.plot.is_some() || !args.json);
    let pictures = if draws { draw(args, [map_path, truth_path], &comparison)? } else { Vec::new() };
    if args.json {
        return Ok(Completion::Done);
    }
    for picture in pictures {
        print_text(&format!("{}", picture.display()))?;
    }
    Ok(Completion::Done)
}

/// Reads a map in K, and its frequency, Hz, if the file states it.
fn read(path: &Path, maps: MapFileArgs) -> Result<(SkyMap, Option<f64>), CommandError> {
    let file = read_whole_map_file(path, &maps.options())?;
    let frequency_hz = file.frequency_hz;
    Ok((file.map, frequency_hz))
}

fn compare_runs(args: &CompareArgs) -> CommandResult {
    let map_options = [
        ("--noise", args.noise.is_some()),
        ("--band-limit", args.band_limit.is_some()),
        ("--l-max", args.l_max.is_some()),
    ];
    if let Some((option, _)) = map_options.into_iter().find(|(_, is_given)| *is_given) {
        return Err(format!("{option} is for two maps; expected none with output folders of runs").into());
    }
    let runs: Vec<RunFigures> = args
        .paths
        .iter()
        .map(|folder| Ok(RunFigures { label: folder.display().to_string(), ..RunFigures::read(folder)? }))
        .collect::<Result<_, CommandError>>()?;
    let all: Vec<&RunFigures> = runs.iter().collect();
    if args.json {
        print_json_line(&runs)?;
    } else {
        print_text(runs_csv(&all).trim_end())?;
    }
    if args.no_plot || (args.json && args.plot.is_none()) {
        return Ok(Completion::Done);
    }
    let plot = args.plot.clone().unwrap_or_else(|| "compare.png".into());
    draw_runs("", &all, std::slice::from_ref(&all))?.write(&plot)?;
    if !args.json {
        print_text(&format!("{}", plot.display()))?;
    }
    Ok(Completion::Done)
}

fn draw(
    args: &CompareArgs,
    [map, truth]: [&Path; 2],
    comparison: &Comparison,
) -> Result<Vec<PathBuf>, CommandError> {
    let name = |path: &Path| path.file_name().map_or_else(String::new, |n| n.to_string_lossy().into_owned());
    let title = format!("{} against {}", name(map), name(truth));
    let plot = args.plot.clone().unwrap_or_else(|| beside(map, "-spectra"));
    let error = match plot.extension() {
        Some(extension) => beside(&plot, "-error").with_extension(extension),
        None => beside(&plot, "-error"),
    };
    draw_comparison(&title, comparison)?.write(&plot)?;
    draw_relative_error(&title, "", comparison, Frame::Galactic)?.write(&error)?;
    Ok(vec![plot, error])
}

/// A path beside `path`: its stem, `suffix` and `.png`.
fn beside(path: &Path, suffix: &str) -> PathBuf {
    let stem = path.file_stem().map_or_else(|| "map".into(), |stem| stem.to_string_lossy().into_owned());
    path.with_file_name(format!("{stem}{suffix}.png"))
}

fn table(comparison: &Comparison) -> String {
    let mut lines =
        vec![format!("{:>5} {:>12} {:>12} {:>9} {:>12}", "l", "C_l map, K²", "truth, K²", "rho_l", "SNR_l")];
    let l_max = comparison.l.last().copied().unwrap_or(0);
    let step = (l_max / 24).max(1);
    for &l in comparison.l.iter().step_by(step) {
        let snr = comparison.snr.as_ref().and_then(|snr| snr.get(l));
        lines.push(format!(
            "{l:>5} {:>12.4e} {:>12.4e} {:>9.4} {:>12}",
            comparison.cl_map[l],
            comparison.cl_truth[l],
            comparison.rho[l],
            snr.map_or_else(|| "-".to_owned(), |snr| format!("{snr:.3}"))
        ));
    }
    let error = &comparison.relative_error;
    lines.push(format!("(map - truth) / truth: mean {:+.4}, rms {:.4}", error.mean, error.rms));
    lines.join("\n")
}
