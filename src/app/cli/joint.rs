//! `lunarray joint`: joint maps of several channels.

use std::path::{Path, PathBuf};

use clap::Args;
use serde::Serialize;

use super::arguments::{StateMapArgs, frequency_hz, output_path, size_bytes};
use super::output::{CommandError, CommandResult, Completion, print_json_line, print_text};
use super::progress::while_solving;
use crate::files::write_atomically;
use crate::imaging::SolveWatch;
use crate::imaging::joint::{
    Agreement, Correlation, JointMap, JointRequest, JointSolution, PowerAgreement, PowerPriors, SpectralMaps,
};
use crate::pipeline::{MemoryLimit, SumsPlace, solve_states_jointly, use_threads};
use crate::products::pictures::{ColourScale, MapPanel, Palette, Sampling, Scaling, View, draw_map};
use crate::sky::Frame;
use crate::sky::fits::{Card, Column, WriteOptions, write_columns};
use crate::units::constants::HEALPIX_UNSEEN as UNSEEN;

/// Maximum number of posterior samples, which are in memory for every channel.
const COUNT_MAX: u64 = 1_000;

/// Make maps of several channels together, also from the daughters' total powers.
///
/// The sky's structure changes slowly with frequency. The correlation of channels is estimated from the data and sets R: scales that
/// one frequency hardly measures come from others that do. Takes the sums of one state or of several, whose nside may differ; no
/// visibility is read again, and the states stay as they are.
///
/// Where a state has total powers (spacecraft.auto_powers = true), they are fitted, too: as the Moon's disc moves over the sky they measure its
/// largest scales, and its mean. Gain, offset and slope of each are free in every pass of every daughter. With powers one channel suffices.
///
/// Leaves in the output folder for each channel, and each frequency of --at, map.fits (temperature and standard deviation, K) and a picture;
/// spectra.fits (spectral index, curvature, and their standard deviations); and joint.json: means with errors, the correlation of channels,
/// and the chi-square of each channel's data.
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
    /// Posterior samples, for the errors of means and spectra.
    #[arg(long, value_name = "NUMBER", default_value_t = 16, value_parser = clap::value_parser!(u64).range(2..=COUNT_MAX))]
    count: u64,
    /// Leave out the total powers.
    #[arg(long)]
    no_powers: bool,
    /// Standard deviations of gain, offset and slope of a power over a pass, percent of the power.
    #[arg(long, value_name = "GAIN,OFFSET,SLOPE", default_value = "10,1,1", value_parser = power_priors)]
    power_priors: [f64; 3],
    /// Part of the powers that is not the sky, receiver noise and the Moon's emission, K sr: one value, or one for each channel in order of frequency.
    #[arg(long, value_name = "K_SR", default_value = "0", value_delimiter = ',')]
    power_constant_k_sr: Vec<f64>,
    /// Maximum memory, with a unit, such as 8GB; by default what the machine has available. Sums that it does not hold are kept in the output
    /// folder while the command runs.
    #[arg(long, value_name = "SIZE", value_parser = size_bytes)]
    memory_max: Option<u64>,
    /// Output folder.
    #[arg(short, long, value_name = "DIR", value_parser = output_path())]
    out: PathBuf,
    #[command(flatten)]
    map: StateMapArgs,
    /// Print one JSON object instead of text: that of joint.json.
    #[arg(long)]
    json: bool,
}

/// Standard deviations of gain, offset and slope, percent.
fn power_priors(text: &str) -> Result<[f64; 3], String> {
    let numbers: Result<Vec<f64>, _> = text.split(',').map(|number| number.trim().parse()).collect();
    let found = numbers.ok().and_then(|numbers| <[f64; 3]>::try_from(numbers).ok());
    let found = found.filter(|numbers| numbers.iter().all(|percent| (0.0..=1000.0).contains(percent)));
    found.ok_or_else(|| {
        "expected three percentages of 0 to 1000, of gain, offset and slope, such as 10,1,1".into()
    })
}

#[derive(Serialize)]
struct Report {
    /// Correlation of the channels; `None` for one alone.
    likeness: Option<Correlation>,
    /// Priors of the total powers; `None` if no channel has any, or they are left out.
    power_priors: Option<PowerPriors>,
    iterations: usize,
    residual: f64,
    converged: bool,
    maps: Vec<MapReport>,
    /// `None` for a channel alone.
    spectra: Option<String>,
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
    /// `None` without total powers.
    powers: Option<PowerAgreement>,
}

impl JointArgs {
    fn priors(&self) -> Option<PowerPriors> {
        let [gain, offset, slope] = self.power_priors.map(|percent| percent / 100.0);
        let constant_k_sr = self.power_constant_k_sr.clone();
        (!self.no_powers).then_some(PowerPriors { gain, offset, slope, constant_k_sr })
    }
}

pub(super) fn execute(args: &JointArgs) -> CommandResult {
    let mut states = Vec::new();
    for folder in &args.states {
        states.push((folder.as_path(), args.map.source(folder)?.load_ground()?));
    }
    let _inputs: Vec<_> = states.iter().map(|(_, config)| args.map.protect(config)).collect();
    if let Some((_, config)) = states.first() {
        use_threads(&config.runtime)?;
    }
    // An unwritable folder is reported before minutes of work.
    std::fs::create_dir_all(&args.out).map_err(|error| format!("{}: {error}", args.out.display()))?;
    let request = |rule| JointRequest {
        rule,
        samples: args.count as usize,
        at_hz: args.at.clone(),
        powers: args.priors(),
    };
    let watch = SolveWatch::default();
    let limit = args.memory_max.map(MemoryLimit::of_user).or_else(MemoryLimit::of_machine);
    let place = SumsPlace { limit, folder: &args.out };
    let solved = while_solving(&watch, || solve_states_jointly(&states, &request, place, &watch))?;
    let report = write(&args.out, &solved, args.priors())?;
    if args.json {
        print_json_line(&report)?;
    } else {
        print_text(&text(&report))?;
    }
    Ok(Completion::Done)
}

fn write(out: &Path, solved: &JointSolution, priors: Option<PowerPriors>) -> Result<Report, CommandError> {
    let power_priors = priors.filter(|_| solved.maps.iter().any(|map| map.powers.is_some()));
    let mut maps = Vec::new();
    for map in &solved.maps {
        let folder = out.join(format!("{:.3}MHz", map.frequency_hz / 1e6));
        std::fs::create_dir_all(&folder).map_err(|error| format!("{}: {error}", folder.display()))?;
        maps.push(write_map(&folder, map, power_priors.as_ref(), solved.convergence.converged)?);
    }
    let spectra = out.join("spectra.fits");
    solved.spectra.iter().try_for_each(|spectral| write_spectra(&spectra, spectral))?;
    let report = Report {
        likeness: solved.likeness,
        power_priors,
        iterations: solved.convergence.iterations,
        residual: solved.convergence.residual,
        converged: solved.convergence.converged,
        maps,
        spectra: solved.spectra.is_some().then(|| spectra.display().to_string()),
    };
    let path = out.join("joint.json");
    write_atomically(&path, &serde_json::to_vec_pretty(&report)?)
        .map_err(|error| format!("{}: {error}", path.display()))?;
    Ok(report)
}

fn write_map(
    folder: &Path,
    map: &JointMap,
    priors: Option<&PowerPriors>,
    converged: bool,
) -> Result<MapReport, CommandError> {
    let columns = [
        Column { name: "TEMPERATURE", unit: "K", values: &map.map_k },
        Column { name: "SIGMA", unit: "K", values: &map.sigma_k },
    ];
    let mut cards = vec![
        Card::real("FREQ", map.frequency_hz, "Hz"),
        Card::text("WHAT", "joint map", "posterior mean and standard deviation"),
        Card::logical("CONVERGD", converged, "the iteration reached map.residual_max"),
        Card::logical("POWERS", map.powers.is_some(), "total powers are in the fit"),
    ];
    if let Some((found, priors)) = map.powers.zip(priors) {
        cards.extend([
            Card::integer("PWROWS", found.rows as i64, "averages of total powers"),
            Card::integer("PWPASSES", found.passes as i64, "passes of daughters, each with its own gain"),
            Card::real("PWCHISQ", found.chi_square, "reduced chi-square of the total powers"),
            Card::real("PWGAIN", priors.gain, "prior standard deviation of gains"),
            Card::real("PWOFFSET", priors.offset, "prior of offsets, of the mean power"),
            Card::real("PWSLOPE", priors.slope, "prior of slopes over a pass, of the mean power"),
        ]);
    }
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
        powers: map.powers,
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
    let mut lines = Vec::new();
    if let Some(Correlation { length, own_share }) = report.likeness {
        lines.push(format!(
            "channels stay alike over {length:.2} e-foldings of frequency; {:.2} % of the power is each channel's own",
            100.0 * own_share
        ));
    }
    if let Some(PowerPriors { gain, offset, slope, .. }) = &report.power_priors {
        let [gain, offset, slope] = [gain, offset, slope].map(|fraction| 100.0 * fraction);
        lines.push(format!(
            "total powers: in every pass of a daughter gain, offset and slope are free within {gain}, {offset} and {slope} %"
        ));
    }
    for map in &report.maps {
        let agreement = map.agreement.map_or("between channels".to_owned(), |found| {
            format!(
                "chi-square {:.4} alone, {:.4} together (strain {:.2})",
                found.chi_square_alone, found.chi_square, found.strain
            )
        });
        let powers = map.powers.map_or(String::new(), |PowerAgreement { rows, passes, chi_square }| {
            format!("; {rows} rows of total powers in {passes} passes, chi-square {chi_square:.4}")
        });
        lines.push(format!(
            "{:>8.3} MHz  mean ({:.4e} +- {:.1e}) K, pixels +- {:.2e} K rms; {agreement}{powers}; {}",
            map.frequency_hz / 1e6,
            map.mean_k,
            map.mean_sigma_k,
            map.sigma_rms_k,
            map.folder
        ));
    }
    lines.extend(report.spectra.iter().map(|path| format!("spectral index and curvature: {path}")));
    if !report.converged {
        lines.push(format!(
            "not converged: residual {:.1e} after {} products",
            report.residual, report.iterations
        ));
    }
    lines.join("\n")
}
