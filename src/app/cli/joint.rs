//! `lunarray joint`: joint maps of several channels.

use std::path::{Path, PathBuf};
use std::time::Duration;

use clap::Args;

use super::arguments::{StateMapArgs, frequency_hz, output_path, size_bytes};
use super::interrupt::Interrupt;
use super::output::{
    CommandError, CommandResult, Completion, WrongUsage, print_json_line, print_notes, print_text,
};
use super::progress::while_solving;
use crate::imaging::SolveWatch;
use crate::imaging::joint::{JointRequest, PRIOR_PERCENT_MAX, PowerPriors, SAMPLES_MAX};
use crate::pipeline::{MemoryLimit, SumsStorage, has_powers, solve_states_jointly, use_threads};
use crate::products::write_joint;
use crate::sky::Frame;

/// Standard deviations of gain, offset and slope of total powers, percent, if not given.
const PRIORS_PERCENT: [f64; 3] = [10.0, 1.0, 1.0];

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
/// and the chi-square of each channel's data. Ctrl-C ends it without maps.
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
    #[arg(long, conflicts_with_all = ["power_priors", "power_constant_k_sr"])]
    no_powers: bool,
    /// Standard deviations of gain, offset and slope of a power over a pass, percent of the power; by default 10,1,1.
    #[arg(long, value_name = "GAIN,OFFSET,SLOPE", value_parser = power_priors)]
    power_priors: Option<[f64; 3]>,
    /// Part of the powers that is not the sky, receiver noise and the Moon's emission, K sr: one value, or one for each channel in order of frequency; by default 0.
    #[arg(long, value_name = "K_SR", value_delimiter = ',')]
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
        let percent = self.power_priors.unwrap_or(PRIORS_PERCENT);
        let constant_k_sr = match self.power_constant_k_sr.is_empty() {
            true => vec![0.0],
            false => self.power_constant_k_sr.clone(),
        };
        (!self.no_powers).then(|| PowerPriors::of_percent(percent, constant_k_sr))
    }

    /// Refuses a state that is given twice, and options of total powers where there are none.
    fn require_effect(&self) -> Result<(), CommandError> {
        let same = |folder: &Path| folder.canonicalize().unwrap_or_else(|_| folder.to_owned());
        for (number, folder) in self.states.iter().enumerate() {
            if self.states[..number].iter().any(|before| same(before) == same(folder)) {
                let folder = folder.display();
                return Err(WrongUsage(format!(
                    "{folder}: the state is given twice; expected each state once, as its channels are already all in"
                ))
                .into());
            }
        }
        let options = [
            ("--no-powers", self.no_powers),
            ("--power-priors", self.power_priors.is_some()),
            ("--power-constant-k-sr", !self.power_constant_k_sr.is_empty()),
        ];
        match options.into_iter().find(|(_, is_given)| *is_given) {
            Some((option, _)) if !has_powers(&self.states)? => {
                let states: Vec<String> =
                    self.states.iter().map(|folder| folder.display().to_string()).collect();
                Err(WrongUsage(format!(
                    "{option} has no effect, as there are no total powers in {}: leave it out, or use data with them (spacecraft.auto_powers = true)",
                    states.join(" and ")
                ))
                .into())
            }
            _ => Ok(()),
        }
    }
}

pub(super) fn execute(args: &JointArgs) -> CommandResult {
    args.require_effect()?;
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
    let interrupt = Interrupt::default();
    interrupt.arm_or_note();
    let watch = SolveWatch::new(interrupt.cancel().clone()).with_grace(Duration::ZERO);
    let limit = args.memory_max.map(MemoryLimit::of_user).or_else(MemoryLimit::of_machine);
    let place = SumsStorage { limit, folder: &args.out };
    let solved = while_solving(&watch, || solve_states_jointly(&states, &request, place, &watch));
    // A solution that was cut short may also fail.
    if watch.is_cancelled() {
        print_notes([format!(
            "ended early: no maps are written to {}, and the states are as they were; repeat the command for them",
            args.out.display()
        )]);
        return Ok(interrupt.completion(true));
    }
    let report = write_joint(&args.out, &solved?, args.priors(), Some(Frame::Galactic))?;
    if args.json {
        print_json_line(&report)?;
    } else {
        print_text(&report.to_string())?;
    }
    Ok(Completion::Done)
}
