//! `lunarray check`: every error at once, then the cost.

use clap::Args;

use super::{CommandResult, Outcome, PipelineArgs, print_json_line, print_text, tell_notes};
use crate::pipeline::{ConfigError, Plan};

/// Check a pipeline and say what it will cost, without running it.
///
/// Lists everything that is wrong with the file at once; then visibilities by channel, downlink bytes,
/// memory, operations, and and an estimate of the time.
#[derive(Debug, Args)]
pub(super) struct CheckArgs {
    #[command(flatten)]
    pipeline: PipelineArgs,
    /// One JSON object instead of a table.
    #[arg(long)]
    json: bool,
}

pub(super) fn execute(args: &CheckArgs) -> CommandResult {
    let source = args.pipeline.source();
    let config = source.load()?;
    tell_notes(&config);
    let plan = Plan::new(config)?;
    let problems = plan.file_problems();
    if !problems.is_empty() {
        return Err(Box::new(ConfigError::Values { origin: source.origin(), problems }));
    }
    let cost = plan.cost();
    if args.json {
        print_json_line(&cost)?;
    } else {
        print_text(&format!("{}: no problems\n\n{cost}", source.origin()))?;
    }
    Ok(Outcome::Done)
}
