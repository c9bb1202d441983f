//! `lunarray joint`: joint maps of several channels.

use std::path::{Path, PathBuf};

use clap::Args;
use serde::Serialize;

use super::arguments::{StateMapArgs, frequency_hz, output_path};
use super::output::{CommandError, CommandResult, Completion, print_json_line, print_text};
use super::progress::while_solving;
use crate::files::write_atomically;
use crate::imaging::SolveWatch;
use crate::imaging::joint::{Agreement, Correlation, JointMap, JointRequest, JointSolution, SpectralMaps};
use crate::pipeline::{solve_states_jointly, use_threads};
use crate::products::pictures::{ColourScale, MapPanel, Palette, Sampling, Scaling, View, draw_map};
use crate::sky::Frame;
use crate::sky::fits::{Card, Column, WriteOptions, write_columns};
use crate::units::constants::HEALPIX_UNSEEN as UNSEEN;

/// Maximum number of posterior samples, which are in memory for every channel.
const COUNT_MAX: u64 = 1_000;

/// Make maps of several channels together, each with what its neighbours see.
///
/// The sky's structure changes slowly with frequency. The data say how alike the channels are, and R follows from it: scales that
/// one frequency hardly sees come from those that see them. Takes the sums of one state or of several, whose nside may differ; no
/// visibility is read again, and the states stay as they are.
///
/// Leaves in the output folder for each channel, and each frequency of --at, map.fits (temperature and standard deviation, K) and a picture;
/// spectra.fits (spectral index, curvature, and their standard deviations); and joint.json: means with errors, how alike the channels are,
/// and how the data of each agree with the sky of all.
///
/// Example: lunarray joint state/ --at 6MHz --out joint/
#[derive(Debug, Args)]
pub(super) struct JointArgs {
    /// State folders of `lunarray replay --state`, with maps over harmonics (map.engine = "harmonic").
    #[arg(value_name = "DIR", required = true)]
    states: Vec<PathBuf>,
    /// Make a map at this frequency between the channels, too: Hz, or with a unit, such as 6MHz. May be repeated.
    #[arg(long, value_name = "FREQUENCY", value_parser = frequency_hz)]
    at: Vec<f64>,
    /// Draws from which errors of means and spectra are taken.
    #[arg(long, value_name = "NUMBER", default_value_t = 16, value_parser = clap::value_parser!(u64).range(2..=COUNT_MAX))]
    count: u64,
    /// Output folder.
    #[arg(short, long, value_name = "DIR", value_parser = output_path())]
    out: PathBuf,
    #[command(flatten)]
    map: StateMapArgs,
    /// Print one JSON object instead of text: that of joint.json.
    #[arg(long)]
    json: bool,
}

#[derive(Serialize)]
struct Report {
    /// Correlation of the channels.
    likeness: Correlation,
    iterations: usize,
    residual: f64,
    converged: bool,
    maps: Vec<MapReport>,
    spectra: String,
}

#[derive(Serialize)]
struct MapReport {
    frequency_hz: f64,
    folder: String,
    mean_k: f64,
    mean_sigma_k: f64,
    /// Root mean square of the pixels' standard deviations.
    sigma_rms_k: f64,
    /// `None` between channels.
    agreement: Option<Agreement>,
}

pub(super) fn execute(args: &JointArgs) -> CommandResult {
    let mut states = Vec::new();
    for folder in &args.states {
        states.push((folder.as_path(), args.map.source(folder)?.load_ground()?));
    }
    if let Some((_, config)) = states.first() {
        use_threads(&config.runtime)?;
    }
    // An unwritable folder is reported before minutes of work.
    std::fs::create_dir_all(&args.out).map_err(|error| format!("{}: {error}", args.out.display()))?;
    let request = |rule| JointRequest { rule, samples: args.count as usize, at_hz: args.at.clone() };
    let watch = SolveWatch::default();
    let solved = while_solving(&watch, || solve_states_jointly(&states, &request, &watch))?;
    let report = write(&args.out, &solved)?;
    if args.json {
        print_json_line(&report)?;
    } else {
        print_text(&text(&report))?;
    }
    Ok(Completion::Done)
}

fn write(out: &Path, solved: &JointSolution) -> Result<Report, CommandError> {
    let mut maps = Vec::new();
    for map in &solved.maps {
        let folder = out.join(format!("{:.3}MHz", map.frequency_hz / 1e6));
        std::fs::create_dir_all(&folder).map_err(|error| format!("{}: {error}", folder.display()))?;
        maps.push(write_map(&folder, map, solved.convergence.converged)?);
    }
    let spectra = out.join("spectra.fits");
    write_spectra(&spectra, &solved.spectra)?;
    let report = Report {
        likeness: solved.likeness,
        iterations: solved.convergence.iterations,
        residual: solved.convergence.residual,
        converged: solved.convergence.converged,
        maps,
        spectra: spectra.display().to_string(),
    };
    let path = out.join("joint.json");
    write_atomically(&path, &serde_json::to_vec_pretty(&report)?)
        .map_err(|error| format!("{}: {error}", path.display()))?;
    Ok(report)
}

fn write_map(folder: &Path, map: &JointMap, converged: bool) -> Result<MapReport, CommandError> {
    let columns = [
        Column { name: "TEMPERATURE", unit: "K", values: &map.map_k },
        Column { name: "SIGMA", unit: "K", values: &map.sigma_k },
    ];
    let cards = vec![
        Card::real("FREQ", map.frequency_hz, "Hz"),
        Card::text("WHAT", "joint map of several channels", "posterior mean and standard deviation"),
        Card::logical("CONVERGD", converged, "the iteration reached map.residual_max"),
    ];
    let options = WriteOptions { cards, ..WriteOptions::default() };
    write_columns(&folder.join("map.fits"), Frame::Ecliptic, &columns, &options)?;
    let pixels = map.map_k.len() as f64;
    let mean_k = map.map_k.iter().sum::<f64>() / pixels;
    let panel = MapPanel {
        values: &map.map_k,
        caption: format!("Joint map at {} MHz", map.frequency_hz / 1e6),
        scale: ColourScale::robust(&map.map_k, Scaling::Log, Palette::default()),
        unit: "K".to_owned(),
    };
    let ending = if converged { "" } else { "; not converged" };
    let subtitle = format!("mean ({mean_k:.4e} +- {:.1e}) K{ending}", map.mean_sigma_k);
    let view = View { sampling: Sampling::Interpolated, ..View::of(Frame::Galactic, Frame::Ecliptic) };
    draw_map(&panel, &subtitle, &view)?.write(&folder.join("map.png"))?;
    Ok(MapReport {
        frequency_hz: map.frequency_hz,
        folder: folder.display().to_string(),
        mean_k,
        mean_sigma_k: map.mean_sigma_k,
        sigma_rms_k: (map.sigma_k.iter().map(|sigma| sigma * sigma).sum::<f64>() / pixels).sqrt(),
        agreement: map.agreement,
    })
}

fn write_spectra(path: &Path, found: &SpectralMaps) -> Result<(), CommandError> {
    let with_unseen = |values: &[f64]| -> Vec<f64> {
        values.iter().map(|value| if value.is_finite() { *value } else { UNSEEN }).collect()
    };
    let named: Vec<(&str, Vec<f64>)> = [
        ("INDEX", &found.index),
        ("INDEX_SIGMA", &found.index_sigma),
        ("CURVATURE", &found.curvature),
        ("CURVATURE_SIGMA", &found.curvature_sigma),
    ]
    .into_iter()
    .filter(|(_, values)| !values.is_empty())
    .map(|(name, values)| (name, with_unseen(values)))
    .collect();
    let columns: Vec<Column<'_>> =
        named.iter().map(|(name, values)| Column { name, unit: "", values }).collect();
    let cards = vec![Card::real("FREQ", found.reference_hz, "Hz, of index and curvature")];
    let options = WriteOptions { cards, ..WriteOptions::default() };
    write_columns(path, Frame::Ecliptic, &columns, &options)?;
    Ok(())
}

fn text(report: &Report) -> String {
    let Correlation { length, own_share } = report.likeness;
    let mut lines = vec![format!(
        "channels stay alike over {length:.2} e-foldings of frequency; {:.2} % of the power is each channel's own",
        100.0 * own_share
    )];
    for map in &report.maps {
        let agreement = map.agreement.map_or("between channels".to_owned(), |found| {
            format!(
                "chi-square {:.4} alone, {:.4} together (strain {:.2})",
                found.chi_square_alone, found.chi_square, found.strain
            )
        });
        lines.push(format!(
            "{:>8.3} MHz  mean ({:.4e} +- {:.1e}) K, pixels +- {:.2e} K rms; {agreement}; {}",
            map.frequency_hz / 1e6,
            map.mean_k,
            map.mean_sigma_k,
            map.sigma_rms_k,
            map.folder
        ));
    }
    lines.push(format!("spectral index and curvature: {}", report.spectra));
    if !report.converged {
        lines.push(format!(
            "not converged: residual {:.1e} after {} products",
            report.residual, report.iterations
        ));
    }
    lines.join("\n")
}
