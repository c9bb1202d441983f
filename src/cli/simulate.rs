//! `lunarray simulate`: the space segment alone.

use std::path::PathBuf;

use clap::Args;

use super::progress::{Progress, cancel_on_interrupt};
use super::{CommandResult, Outcome, PipelineArgs, print_json_line, print_text};
use crate::pipeline::{INTEGRATE, Plan, simulate, use_threads};

/// Simulate the space segment, to a downlink file.
///
/// The file holds CCSDS space packets with the instrument description, the ephemeris and the
/// visibilities: all that `lunarray replay` needs. It bears its name once it is complete; until then it
/// ends in .partial. Ctrl-C ends it after the window in hand and leaves a valid file.
#[derive(Debug, Args)]
pub(super) struct SimulateArgs {
    #[command(flatten)]
    pipeline: PipelineArgs,
    /// Downlink file to write.
    #[arg(short, long, value_name = "FILE")]
    out: PathBuf,
    /// Print stages and throughput as one JSON object instead of a table.
    #[arg(long)]
    json: bool,
}

pub(super) fn execute(args: &SimulateArgs) -> CommandResult {
    let plan = Plan::new(args.pipeline.source().load()?)?;
    use_threads(&plan.config.runtime)?;
    let cancel = cancel_on_interrupt()?;
    let mut progress = None;
    let windows = plan.windows_watched();
    let report = simulate(&plan, &args.out, &cancel, &mut |metrics| {
        progress = Some(Progress::watch(metrics, INTEGRATE, windows));
    })?;
    drop(progress);
    if args.json {
        print_json_line(&report)?;
    } else {
        print_text(&format!("{report}\nThe downlink is in {}", args.out.display()))?;
    }
    Ok(if report.cancelled { Outcome::Interrupted } else { Outcome::Done })
}
