//! `lunarray bench`: measure the speed of the chain on this machine.

use std::path::{Path, PathBuf};

use clap::Args;

use super::arguments::input_path;
use super::output::{CommandError, CommandResult, Completion, print_json_line, print_text};
use crate::bench::{BENCH_STAGES, BenchSettings, Comparison, bench_config};
use crate::files::read_text;
use crate::pipeline::{ConfigSource, Plan, use_threads};

/// Largest file of earlier measurements that is read, bytes.
const BASELINE_BYTES_MAX: u64 = 1 << 24;

/// Measure the speed of each stage of sample fidelity, and of the chain from samples to received visibilities.
///
/// Without a pipeline file it measures 16 s of the design: 30 channels, eight daughters, 8 bits, with a generated sky of
/// nside 8. Prints median and quartiles of the time of a run, samples, visibilities and bytes per second, times real time
/// (mission time over time), processor time, latencies from sample to packet and from packet to sums, queue depths, and the
/// stage that saturates first; with version, processor and date, and a warning if others used the processors meanwhile.
///
/// Every run starts cold: its times include the first tables of the sampler and the predictions of the sky.
///
/// Example: lunarray bench --stage correlate --runs 9
#[derive(Debug, Args)]
pub(super) struct BenchArgs {
    /// Pipeline file (TOML); measures its first window, at most spacecraft.window_s_max long.
    #[arg(value_name = "PIPELINE.toml", value_parser = input_path())]
    pipeline: Option<PathBuf>,
    /// Replace one setting of the pipeline file, for example --set daughters.bits=2; may be repeated.
    #[arg(long = "set", value_name = "KEY=VALUE", requires = "pipeline")]
    overrides: Vec<String>,
    /// Measure only this stage.
    #[arg(long, value_parser = BENCH_STAGES)]
    stage: Option<String>,
    /// Number of runs of each stage.
    #[arg(long, default_value_t = 5, value_parser = clap::value_parser!(u16).range(1..=1000))]
    runs: u16,
    /// Also run the chain with other numbers of channels and daughters, and other block sizes.
    #[arg(long)]
    growth: bool,
    /// Compare with an earlier benchmark of the same size: a file with what --json printed.
    #[arg(long, value_name = "FILE.json", value_parser = input_path())]
    compare: Option<PathBuf>,
    /// Print one JSON object instead of tables; includes every run, and the queue depths over time.
    #[arg(long)]
    json: bool,
}

pub(super) fn execute(args: &BenchArgs) -> CommandResult {
    let config = match &args.pipeline {
        Some(_) => {
            let (file, overrides) = (args.pipeline.clone(), args.overrides.clone());
            ConfigSource { file, overrides, seed: None }.load()?
        }
        None => bench_config(),
    };
    let plan = Plan::new(config)?;
    use_threads(&plan.config.runtime)?;
    let settings = BenchSettings { stage: args.stage.clone(), runs: args.runs.into(), growth: args.growth };
    let baseline = args.compare.as_deref().map(read_baseline).transpose()?;
    let mut measured = crate::bench::bench(&plan, &settings)?;
    if let Some((path, before)) = baseline {
        let compared = Comparison::of(&serde_json::to_value(&measured)?, &before);
        measured.comparison = Some(compared.map_err(|error| format!("{}: {error}", path.display()))?);
    }
    if args.json {
        print_json_line(&measured)?;
    } else {
        print_text(&measured.to_string())?;
    }
    Ok(Completion::Done)
}

fn read_baseline(path: &Path) -> Result<(&Path, serde_json::Value), CommandError> {
    let text = read_text(path, BASELINE_BYTES_MAX)
        .map_err(|error| format!("{}: cannot read: {error}", path.display()))?;
    let expected = "expected what `lunarray bench --json` prints";
    let value =
        serde_json::from_str(&text).map_err(|error| format!("{}: {error}; {expected}", path.display()))?;
    Ok((path, value))
}
