//! `lunarray joint`: joint maps of several channels.

use std::path::PathBuf;

use clap::Args;

use super::arguments::{StateMapArgs, frequency_hz, output_path, size_bytes};
use super::output::{CommandResult, Completion, print_json_line, print_text};
use super::progress::while_solving;
use crate::imaging::SolveWatch;
use crate::imaging::joint::{JointRequest, PRIOR_PERCENT_MAX, PowerPriors, SAMPLES_MAX};
use crate::pipeline::{MemoryLimit, SumsStorage, solve_states_jointly, use_threads};
use crate::products::write_joint;
use crate::sky::Frame;

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
    #[arg(long, value_name = "NUMBER", default_value_t = 16, value_parser = clap::value_parser!(u64).range(2..=SAMPLES_MAX))]
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
    let found =
        found.filter(|numbers| numbers.iter().all(|percent| (0.0..=PRIOR_PERCENT_MAX).contains(percent)));
    found.ok_or_else(|| {
        "expected three percentages of 0 to 1000, of gain, offset and slope, such as 10,1,1".into()
    })
}

impl JointArgs {
    fn priors(&self) -> Option<PowerPriors> {
        (!self.no_powers)
            .then(|| PowerPriors::of_percent(self.power_priors, self.power_constant_k_sr.clone()))
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
    let place = SumsStorage { limit, folder: &args.out };
    let solved = while_solving(&watch, || solve_states_jointly(&states, &request, place, &watch))?;
    let report = write_joint(&args.out, &solved, args.priors(), Some(Frame::Galactic))?;
    if args.json {
        print_json_line(&report)?;
    } else {
        print_text(&report.to_string())?;
    }
    Ok(Completion::Done)
}
