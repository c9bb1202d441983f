//! `lunarray run`: run the whole chain in one process.

use std::path::{Path, PathBuf};

use clap::Args;

use super::arguments::{PipelineArgs, default_out, group_size, output_path};
use super::events::EventsArgs;
use super::interrupt::Interrupt;
use super::job::Job;
use super::output::{
    CommandError, CommandResult, print_config_notes, print_incompleteness, print_json_line, print_notes,
    print_text,
};
use super::progress::{GroupSteps, Progress};
use super::serving::ServeArgs;
use crate::pipeline::{
    GroupSize, INTEGRATE, Plan, RunSummary, Segment, main_products, run_in_groups, run_with_ranks, sky_notes,
    use_threads,
};

/// Run the whole chain: sky, spacecraft, downlink, ground segment, maps.
///
/// Without a pipeline file it runs the embedded quicklook: three channels over one precession period of the orbit, in
/// half a minute. Writes, for each channel, snapshots as data arrive, the final map and a noise-only map (HEALPix FITS),
/// and pictures of map, input and error; and the downlink file and summary.json. Ctrl-C ends it early, with maps of the
/// data so far: runtime.grace_s limits the time for them. With joint.on it ends with joint maps, unless it was ended early.
///
/// Example: lunarray run pipelines/quicklook.toml --set map.nside=8 --out out/coarse
#[derive(Debug, Args)]
pub(super) struct RunArgs {
    #[command(flatten)]
    pipeline: PipelineArgs,
    /// Output folder for the products; by default out/NAME.
    #[arg(short, long, value_name = "DIR", value_parser = output_path())]
    out: Option<PathBuf>,
    /// Print the summary as one JSON object instead of tables.
    #[arg(long)]
    json: bool,
    /// Simulate and map the channels in groups: as many at a time as memory allows (auto), or this many. The maps are identical to
    /// those of all channels together. To resume after an interruption, repeat the command.
    #[arg(long, value_name = "auto|NUMBER", value_parser = group_size, conflicts_with_all = ["mpi", "events"])]
    #[cfg_attr(feature = "serve", arg(conflicts_with = "serve"))]
    groups: Option<GroupSize>,
    /// Share the sums of each map of the harmonic engine with the other ranks of an MPI job: mpirun -n 4 lunarray run --mpi. The
    /// first rank writes the products, which are those of one process. Needs a program built with --features mpi.
    #[arg(long, conflicts_with = "events")]
    #[cfg_attr(feature = "serve", arg(conflicts_with = "serve"))]
    mpi: bool,
    #[command(flatten)]
    events: EventsArgs,
    #[command(flatten)]
    serve: ServeArgs,
}

pub(super) fn execute(args: &RunArgs) -> CommandResult {
    let job = Job::join(args.mpi)?;
    let result = work(args, &job);
    job.conclude(result)
}

fn work(args: &RunArgs, job: &Job) -> CommandResult {
    let config = args.pipeline.load_noting(job.is_first())?;
    if job.is_first() {
        print_config_notes(&config);
    }
    let _inputs = args.pipeline.protect(&config);
    let plan = Plan::new(config)?;
    if job.is_first() {
        print_notes(plan.array.notes());
        print_notes(sky_notes(&plan)?);
    }
    use_threads(&plan.config.runtime)?;
    let out = args.out.clone().map_or_else(|| default_out(&plan.config.name), Ok)?;
    let cost = plan.cost_with_ranks(job.ranks().share().count);
    if job.is_first() {
        print_notes(plan.baseline_note(&cost, Segment::Whole).into_iter().chain(plan.unmapped_note(&cost)));
    }
    if let Some(size) = args.groups {
        return in_groups(args, &plan, size, &out);
    }
    cost.require_memory(Segment::Whole, job.memory_limit(args.pipeline.memory_limit()))?;
    let interrupt = Interrupt::default();
    let page = args.serve.start(&plan.config, "whole", None, None)?;
    let outputs = main_products(&plan.config, &out);
    let events = args.events.start(&plan.config, "whole", &outputs, job.is_first())?;
    let mut progress = None;
    let windows = plan.progress_windows();
    let result = run_with_ranks(job.ranks(), &plan, &out, interrupt.cancel(), &mut |handles| {
        interrupt.arm_or_note();
        page.watch(&handles);
        events.watch(&handles);
        if job.is_first() {
            progress = Some(Progress::watch(handles, INTEGRATE, windows, interrupt.cancel()));
        }
    });
    drop(progress);
    if let Some(completion) = job.completion_if_interrupted(&result, &interrupt) {
        return Ok(completion);
    }
    let result = page.conclude(result, |summary| summary.cancelled);
    events.conclude(&result, |summary| summary.cancelled);
    let summary = result?;
    if !job.is_first() {
        return Ok(interrupt.completion(summary.cancelled));
    }
    let printed = match args.events.take_stdout() {
        true => Ok(()),
        false => args.print(&summary, &out),
    };
    print_incompleteness(&summary);
    page.serve_until_interrupt(&interrupt);
    interrupt.completion(summary.cancelled).after(printed)
}

impl RunArgs {
    fn print(&self, summary: &RunSummary, out: &Path) -> Result<(), CommandError> {
        match self.json {
            true => print_json_line(summary),
            false => print_text(&format!("{summary}\nProducts are in {}", out.display())),
        }
    }
}

/// Simulates and maps the channels in groups.
fn in_groups(args: &RunArgs, plan: &Plan, size: GroupSize, out: &Path) -> CommandResult {
    let groups = plan.run_groups(size, args.pipeline.memory_limit())?;
    let interrupt = Interrupt::default();
    let mut steps = GroupSteps::new(plan, &groups);
    let result = run_in_groups(plan, &groups, out, interrupt.cancel(), &mut |event, view| {
        steps.watch(event, view, &interrupt);
    });
    drop(steps);
    let Some(summary) = result? else {
        return Ok(interrupt.completion(true));
    };
    let printed = args.print(&summary, out);
    print_incompleteness(&summary);
    interrupt.completion(summary.cancelled).after(printed)
}
