//! `lunarray zoom`: a patch of sky at the array's own resolution.

use std::path::PathBuf;

use clap::Args;

use super::arguments::{GainsArgs, input_path, output_path};
use super::output::{CommandResult, Completion, print_json_line, print_text};
use crate::files::ProtectedInputs;
use crate::pipeline::{ZoomCentre, ZoomJob, ZoomReport, use_threads, zoom_downlink};
use crate::units::ChannelId;

/// Greatest radius of a patch, degrees.
const RADIUS_DEG_MAX: f64 = 20.0;

/// Image a patch of sky with baselines of any length, and list its sources.
///
/// Reads downlink files as `lunarray replay` does. Visibilities are phased to the centre, and averaged while phases at the edge hardly change;
/// those for which the Moon hides the patch, or its limb crosses it, are left out and counted. Sources are points of any position; the
/// residual gives an image, and a map if it exceeds the noise. Short baselines, which see the diffuse sky around, are left out by --baseline-min.
///
/// Leaves image.fits, residual.fits, sigma.fits and beam.fits (J2000, for DS9, CARTA or Aladin), image.png, sources.csv, sources.vot
/// (VOTable) and summary.json in the output folder.
///
/// Example: lunarray zoom pass-*.ccsds --centre 83.63,22.01 --radius-deg 2 --out crab/
#[derive(Debug, Args)]
pub(super) struct ZoomArgs {
    /// Downlink files.
    #[arg(required = true, value_name = "FILE", value_parser = input_path())]
    files: Vec<PathBuf>,
    /// Right ascension and declination of the centre (J2000), degrees, or the name of a source in --catalogue.
    #[arg(long, value_name = "RA,DEC|NAME", allow_hyphen_values = true, value_parser = centre)]
    centre: ZoomCentre,
    /// Radius, degrees, up to 20.
    #[arg(long, value_name = "DEG", default_value_t = 5.0)]
    radius_deg: f64,
    /// Side of a pixel; by default a third of the longest baseline's fringe.
    #[arg(long, value_name = "ARCMIN")]
    pixel_arcmin: Option<f64>,
    /// Channel, from 0 in the order of the instrument.
    #[arg(long, value_name = "NUMBER", default_value_t = 0)]
    channel: u16,
    /// Shortest baseline, wavelengths. Shorter ones see the diffuse sky around the patch.
    #[arg(long, value_name = "WAVELENGTHS", default_value_t = 100.0)]
    baseline_min: f64,
    /// Longest baseline, wavelengths; by default all.
    #[arg(long, value_name = "WAVELENGTHS")]
    baseline_max: Option<f64>,
    /// Table (CSV) of known sources, whose names sources found get.
    #[arg(long, value_name = "SOURCES.csv", value_parser = input_path())]
    catalogue: Option<PathBuf>,
    /// Subtract sources of the catalogue outside the patch that are at least this bright, Jy.
    #[arg(long, value_name = "JY", requires = "catalogue")]
    subtract_jy: Option<f64>,
    #[command(flatten)]
    gains: GainsArgs,
    /// Output folder.
    #[arg(short, long, value_name = "DIR", value_parser = output_path())]
    out: PathBuf,
    /// Print one JSON object instead of text: that of summary.json.
    #[arg(long)]
    json: bool,
}

fn centre(text: &str) -> Result<ZoomCentre, String> {
    let numbers: Vec<f64> = text.split(',').filter_map(|part| part.trim().parse().ok()).collect();
    let numeric = text.chars().all(|c| c.is_ascii_digit() || " ,.+-".contains(c));
    match numbers[..] {
        [ra, dec] if text.split(',').count() == 2 && ra.abs() <= 360.0 && dec.abs() <= 90.0 => {
            Ok(ZoomCentre::Equatorial([ra.rem_euclid(360.0), dec]))
        }
        _ if numeric => {
            Err("expected right ascension and declination in degrees, such as 83.6,22.0, or a name".into())
        }
        _ => Ok(ZoomCentre::Named(text.trim().to_owned())),
    }
}

pub(super) fn execute(args: &ZoomArgs) -> CommandResult {
    let above = |name: &str, value: f64, limit: f64| {
        let good = value > 0.0 && value <= limit;
        good.then_some(()).ok_or_else(|| format!("--{name} {value}: expected more than 0, up to {limit}"))
    };
    above("radius-deg", args.radius_deg, RADIUS_DEG_MAX)?;
    args.pixel_arcmin.map_or(Ok(()), |arcmin| above("pixel-arcmin", arcmin, 600.0))?;
    args.baseline_max.map_or(Ok(()), |limit| above("baseline-max", limit, f64::MAX))?;
    let config = args.gains.source(&args.files).load_ground()?;
    let named = args.files.iter().chain(&args.gains.map).chain(&args.catalogue).cloned();
    let _inputs = ProtectedInputs::of(named.chain(config.input_files()));
    use_threads(&config.runtime)?;
    let report = zoom_downlink(&ZoomJob {
        config: &config,
        files: &args.files,
        centre: args.centre.clone(),
        radius_deg: args.radius_deg,
        pixel_arcmin: args.pixel_arcmin,
        channel: ChannelId(args.channel),
        catalogue: args.catalogue.as_deref(),
        subtract_jy: args.subtract_jy,
        baselines_wavelengths: [Some(args.baseline_min).filter(|least| *least > 0.0), args.baseline_max],
        out: &args.out,
    })?;
    if args.json {
        print_json_line(&report)?;
    } else {
        print_text(&text(&report))?;
        print_text(&format!("Products are in {}", args.out.display()))?;
    }
    Ok(Completion::Done)
}

fn text(report: &ZoomReport) -> String {
    let zoom = &report.zoom;
    let mut lines = vec![
        report.ledger.to_string(),
        format!(
            "{} averages; beam {:.2}' x {:.2}'; noise {:.3} Jy/beam by the weights, {:.3} in the image; sources above {:.2} sigma",
            zoom.rows,
            zoom.beam.fwhm_major_arcmin,
            zoom.beam.fwhm_minor_arcmin,
            zoom.noise.thermal_jy,
            zoom.noise.measured_jy,
            zoom.threshold
        ),
        format!("{:>4} {:>10} {:>10} {:>12} {:>10}  {}", "", "ra deg", "dec deg", "Jy", "error", "known as"),
    ];
    lines.extend(zoom.sources.iter().map(|one| {
        let known = one.known_flux_jy.map_or_else(String::new, |flux| {
            let name = if one.known_name.is_empty() { "a source" } else { &one.known_name };
            format!("{name} of {flux:.3} Jy, {:.1}\" away", one.known_distance_arcsec.unwrap_or_default())
        });
        format!(
            "{:>4} {:>10.5} {:>10.5} {:>12.3} {:>10.3}  {known}",
            one.id, one.ra_deg, one.dec_deg, one.flux_jy, one.flux_error_jy
        )
    }));
    lines.join("\n")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_centre_is_two_angles_or_a_name() {
        assert_eq!(centre("83.6,-22"), Ok(ZoomCentre::Equatorial([83.6, -22.0])));
        assert_eq!(centre("3C 84"), Ok(ZoomCentre::Named("3C 84".to_owned())));
        assert!(centre("83.6").is_err() && centre("10,95").is_err() && centre("1,2,3").is_err());
    }
}
