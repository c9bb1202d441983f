//! `lunarray bench`: measure the speed of the chain on this machine.

use std::path::PathBuf;

use clap::Args;

use super::arguments::input_path;
use super::output::{CommandResult, Completion, print_json_line, print_text};
use crate::bench::{BENCH_STAGES, BenchSettings, bench_config};
use crate::pipeline::{ConfigSource, Plan, use_threads};

/// Measure the speed of each stage of sample fidelity, and of the chain from samples to received visibilities.
///
/// Without a pipeline file it measures 16 s of the design: 30 channels, eight daughters, 8 bits, with a generated sky of
/// nside 8. Prints samples, visibilities and bytes per second, the ratio to real time of the design, the spread over
/// runs, processor time, latencies from sample to packet and from packet to sums, queue depths, and the stage that
/// saturates first.
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
    /// Print one JSON object instead of tables; includes the queue depths over time.
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
    let measured = crate::bench::bench(&plan, &settings)?;
    if args.json {
        print_json_line(&measured)?;
    } else {
        print_text(&measured.to_string())?;
    }
    Ok(Completion::Done)
}
