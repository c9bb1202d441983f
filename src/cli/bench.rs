//! `lunarray bench`: how fast the chain is on this machine.

use std::path::PathBuf;

use clap::Args;

use super::output::{CommandResult, Completion, print_json_line, print_text};
use crate::bench::{BENCH_STAGES, BenchSettings, bench_config};
use crate::pipeline::{ConfigSource, Plan, use_threads};

/// Measure each stage of the sampled spacecraft alone, and the chain from samples to received visibilities.
///
/// Without a pipeline, 16 s of the design are measured: 30 channels, eight daughters, 8 bits, over a generated
/// sky of nside 8. Prints samples, visibilities and bytes a second, the ratio to real time of the design, the
/// spread over runs, processor time, latencies from sample to packet and from packet to sums, queues and the stage that
/// saturates first.
///
/// Every run begins with nothing prepared: what sampling and the chain take is with their first tables, and with the
/// predictions of a sky that they sum for themselves.
#[derive(Debug, Args)]
pub(super) struct BenchArgs {
    /// Pipeline file (TOML); its first window is measured, of spacecraft.window_s_max at best.
    #[arg(value_name = "PIPELINE.toml")]
    pipeline: Option<PathBuf>,
    /// Replace one setting of the pipeline file, for example --set daughters.bits=2; may be given again.
    #[arg(long = "set", value_name = "KEY=VALUE", requires = "pipeline")]
    overrides: Vec<String>,
    /// Measure one stage only.
    #[arg(long, value_parser = BENCH_STAGES)]
    stage: Option<String>,
    /// Runs of each stage.
    #[arg(long, default_value_t = 5, value_parser = clap::value_parser!(u16).range(1..=1000))]
    runs: u16,
    /// Run the chain at other sizes as well: channels, daughters, blocks.
    #[arg(long)]
    growth: bool,
    /// One JSON object instead of a table; with the queues' depths as they changed.
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
