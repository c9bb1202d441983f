//! `lunarray check`: validate a pipeline and estimate its cost.

use clap::Args;
use serde::Serialize;

use super::arguments::{PipelineArgs, group_size};
use super::output::{
    CommandError, CommandResult, Completion, print_config_notes, print_json_line, print_notes, print_text,
};
use crate::array::EarthModel;
use crate::pipeline::{ConfigError, Cost, GroupSize, Plan, RunGroups, Segment, sky_notes};
use crate::units::time_scales::utc_text;

/// Check a pipeline and estimate its cost, without running it.
///
/// Lists all problems of the file at once. If there are none, prints what was understood of each map and catalogue (frequency, frame,
/// unit, resolution), the number of visibilities by channel, downlink bytes, memory, operations and an estimated run time. Fails if the memory is more than this machine has available;
/// --memory-max states another machine's.
///
/// Example: lunarray check pipelines/reference.toml --set map.nside=32
#[derive(Debug, Args)]
pub(super) struct CheckArgs {
    #[command(flatten)]
    pipeline: PipelineArgs,
    /// Estimate for one of this many ranks that share the sums of each map (run --mpi): prints memory a rank, bytes exchanged, and the nodes
    /// needed, each with the memory of --memory-max or of this machine. Fails if not even one rank fits a node.
    #[arg(long, value_name = "NUMBER", default_value_t = 1, value_parser = clap::value_parser!(u16).range(1..))]
    ranks: u16,
    /// As a run in groups of channels (run --groups): prints the groups, and fails only if a channel alone needs too much memory.
    #[arg(long, value_name = "auto|NUMBER", value_parser = group_size, conflicts_with = "ranks")]
    groups: Option<GroupSize>,
    /// Print one JSON object instead of a table; of a pipeline with problems, their list.
    #[arg(long)]
    json: bool,
}

/// The JSON output.
#[derive(Serialize)]
struct CheckReport<'a> {
    #[serde(flatten)]
    cost: &'a Cost,
    epoch_utc: &'a str,
    /// Description of the model of the Earth.
    earth: String,
    #[serde(skip_serializing_if = "Option::is_none")]
    groups: Option<&'a RunGroups>,
    /// Description of each map and catalogue.
    #[serde(skip_serializing_if = "<[String]>::is_empty")]
    files: &'a [String],
}

/// The JSON output of a pipeline with problems, which are on standard error, too.
#[derive(Serialize)]
struct ProblemReport {
    problems: Vec<String>,
    /// Number of all problems; of many, only the first are listed.
    count: usize,
}

impl ProblemReport {
    fn of(error: &CommandError) -> Self {
        match error.downcast_ref::<ConfigError>() {
            Some(ConfigError::Values { problems, .. }) => {
                Self { problems: problems.iter().map(ToString::to_string).collect(), count: problems.len() }
            }
            _ => Self { problems: vec![error.to_string()], count: 1 },
        }
    }
}

pub(super) fn execute(args: &CheckArgs) -> CommandResult {
    let checked = checked(args);
    if let (true, Err(error)) = (args.json, &checked) {
        print_json_line(&ProblemReport::of(error))?;
    }
    let (plan, cost) = checked?;
    report(args, &plan, &cost)
}

/// The plan of a pipeline without problems, and its cost.
fn checked(args: &CheckArgs) -> Result<(Plan, Cost), CommandError> {
    let config = args.pipeline.load()?;
    print_config_notes(&config);
    let plan = Plan::new(config)?;
    print_notes(plan.array.notes());
    print_notes(plan.thinning_notes());
    let problems = plan.file_problems();
    if !problems.is_empty() {
        return Err(Box::new(ConfigError::Values { origin: args.pipeline.source().origin(), problems }));
    }
    let ranks = usize::from(args.ranks);
    plan.config.require_shareable_run(ranks)?;
    if plan.config.joint.on {
        print_notes([
            "joint maps are not in the estimates of memory and run time; sums that the machine's memory does not hold then go to disk, in OUT/joint",
        ]);
    }
    print_notes(sky_notes(&plan)?);
    let cost = plan.cost_with_ranks(ranks).on_nodes(args.pipeline.memory_limit());
    cost.require_finite()?;
    plan.require_baseline(&cost)?;
    print_notes(plan.baseline_note(&cost, Segment::Whole).into_iter().chain(plan.unmapped_note(&cost)));
    Ok((plan, cost))
}

fn report(args: &CheckArgs, plan: &Plan, cost: &Cost) -> CommandResult {
    let source = args.pipeline.source();
    let files = plan.file_descriptions();
    let limit = args.pipeline.memory_limit();
    let groups = args.groups.map(|size| plan.run_groups(size, limit)).transpose();
    let found = groups.as_ref().ok().and_then(Option::as_ref);
    let epoch_utc = &utc_text(plan.instrument.epoch_tai_s);
    let earth = EarthModel::of(&plan.config.array).to_string();
    if args.json {
        print_json_line(&CheckReport { cost, epoch_utc, earth, groups: found, files: &files })?;
    } else {
        let files: String = files.iter().map(|line| format!("{line}\n")).collect();
        let mission = format!("epoch {epoch_utc} UTC; the Earth is {earth}");
        print_text(&format!("{}: no problems\n{files}{mission}\n\n{cost}", source.origin()))?;
        if let Some(groups) = found {
            print_text(&format!("{groups}\nMemory above is that of all channels at once."))?;
        }
    }
    if groups?.is_some() {
        return Ok(Completion::Done);
    }
    cost.require_memory(Segment::Whole, args.pipeline.memory_limit())?;
    Ok(Completion::Done)
}
