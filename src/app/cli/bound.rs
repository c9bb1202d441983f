//! `lunarray bound`: Cramer-Rao bounds of the gains in one pass.

use std::path::PathBuf;

use clap::Args;

use super::arguments::{MapFileArgs, input_path};
use super::output::{CommandResult, print_json_line, print_text};
use crate::pipeline::{ConfigSource, Plan, bound, use_threads};
use crate::sky::fits::{check_frequencies, read_known_sky};

/// Print how well gains, clocks and positions of a planned array can be known after one pass.
///
/// The Cramer-Rao bound is the least standard deviation that any calibration on a known sky can have: here with the array,
/// integrations and channels of the pipeline, noise of the sky's power, and the parameters and priors of its section [calibrate].
///
/// Example: lunarray bound mission.toml --model model.fits
#[derive(Debug, Args)]
pub(super) struct BoundArgs {
    /// Pipeline file (TOML); the embedded quicklook if none is given.
    #[arg(value_name = "PIPELINE.toml", value_parser = input_path())]
    pipeline: Option<PathBuf>,
    /// HEALPix map of the sky in K; one per channel, in their order; calibrate.model_files if not given.
    #[arg(long, value_name = "MAP.fits", num_args = 1..)]
    model: Vec<PathBuf>,
    /// Number of the pass, from 0.
    #[arg(long, value_name = "N", default_value_t = 0)]
    pass: usize,
    /// Replace one setting, for example --set calibrate.clock_sigma_ns=50; may be repeated.
    #[arg(long = "set", value_name = "KEY=VALUE")]
    overrides: Vec<String>,
    #[command(flatten)]
    maps: MapFileArgs,
    /// Print one JSON object instead of a table.
    #[arg(long)]
    json: bool,
}

pub(super) fn execute(args: &BoundArgs) -> CommandResult {
    let source = ConfigSource { file: args.pipeline.clone(), overrides: args.overrides.clone(), seed: None };
    let plan = Plan::new(source.load()?)?;
    use_threads(&plan.config.runtime)?;
    let files = if args.model.is_empty() { &plan.config.calibrate.model_files } else { &args.model };
    let options = args.maps.options();
    let maps = files.iter().map(|path| read_known_sky(path, &options)).collect::<Result<Vec<_>, _>>()?;
    check_frequencies(files, &plan.instrument.frequencies_hz())?;
    let found = bound(&plan, &maps, args.pass)?;
    if args.json {
        print_json_line(&found)?
    } else {
        print_text(&found.to_string())?
    }
    Ok(super::output::Completion::Done)
}
