//! `lunarray simulate`: run the space segment alone.

use std::io::IsTerminal;
use std::path::{Path, PathBuf};
use std::sync::atomic::Ordering;

use clap::Args;

use super::arguments::{PipelineArgs, group_size, is_standard, not_negative_s, output_or_standard};
use super::events::EventsArgs;
use super::interrupt::Interrupt;
use super::output::{
    CommandError, CommandResult, print_config_notes, print_json_line, print_notes, print_text,
};
use super::progress::{GroupSteps, Progress};
use super::send::say_waiting;
use super::serving::ServeArgs;
use crate::downlink::transport::socket::{SendOptions, SocketSink, Stations, TcpUrl};
use crate::files::ProtectedInputs;
use crate::pipeline::{
    Destination, GroupSize, INTEGRATE, Plan, RunGroups, Segment, simulate, simulate_in_groups, sky_notes,
    use_threads,
};

/// Simulate the space segment, and write its downlink to a file or send it to a listening ground segment.
///
/// The downlink holds CCSDS space packets with the instrument description, the ephemeris and the visibilities: all that `lunarray
/// replay` needs. A file that a failure leaves incomplete has the extension .partial. Ctrl-C ends the simulation after the
/// windows in progress, or without them if they take longer than runtime.grace_s, and leaves a valid file, or none before the
/// first window.
///
/// Example: lunarray simulate pipelines/quicklook.toml --out sky.ccsds
#[derive(Debug, Args)]
pub(super) struct SimulateArgs {
    #[command(flatten)]
    pipeline: PipelineArgs,
    /// Downlink file to write; - for standard output, as input of another program. No file of the true errors of the
    /// instrument is then written.
    #[arg(short, long, value_name = "FILE|-", required_unless_present = "send", value_parser = output_or_standard())]
    out: Option<PathBuf>,
    /// Simulate the channels in groups, to files beside the downlink, which are then merged: as many at a time as memory allows
    /// (auto), or this many. The downlink has the same bytes. When interrupted, repeat the command to go on with the next group.
    #[arg(long, value_name = "auto|NUMBER", value_parser = group_size, requires = "out", conflicts_with_all = ["send", "events"])]
    #[cfg_attr(feature = "serve", arg(conflicts_with = "serve"))]
    groups: Option<GroupSize>,
    /// Send the downlink to this address, where `lunarray replay --listen` listens, as it is made. A slow receiver slows
    /// the simulation.
    #[arg(long, value_name = "tcp://HOST:PORT")]
    send: Option<TcpUrl>,
    /// Connection timeout, s.
    #[arg(long, value_name = "SECONDS", default_value_t = 10.0, requires = "send", value_parser = not_negative_s)]
    connect_s: f64,
    /// Maximum rate, bytes/s; 0 for no limit.
    #[arg(long, value_name = "NUMBER", default_value_t = 0.0, requires = "send", value_parser = rate)]
    bytes_per_s: f64,
    /// Wait until a checkpoint on the ground's disk holds the whole downlink. If the ground ends before that and is back within
    /// --connect-s, send it all again. Needs a ground with --state, and a downlink of at most 16 MiB to be sent again.
    #[arg(long, requires = "send")]
    held: bool,
    /// File with the line NAME TOKEN of the station that sends, for a ground with --stations. Nobody else may be able to read it.
    #[arg(long, value_name = "FILE", requires = "send")]
    token: Option<PathBuf>,
    /// Print stages and throughput as one JSON object instead of a table.
    #[arg(long)]
    json: bool,
    #[command(flatten)]
    events: EventsArgs,
    #[command(flatten)]
    serve: ServeArgs,
}

fn rate(text: &str) -> Result<f64, String> {
    match text.trim().parse::<f64>() {
        Ok(value) if value == 0.0 || (1.0..=1e12).contains(&value) => Ok(value),
        _ => Err("expected 1 to 1e12 bytes/s, or 0 for no limit".into()),
    }
}

pub(super) fn execute(args: &SimulateArgs) -> CommandResult {
    let to_standard_output = args.out.as_deref().is_some_and(is_standard);
    if to_standard_output {
        args.require_standard_output()?;
    }
    let config = args.pipeline.load()?;
    print_config_notes(&config);
    let _inputs = (args.pipeline.protect(&config), ProtectedInputs::of(&args.token));
    let plan = Plan::new(config)?;
    print_notes(plan.array.notes());
    print_notes(sky_notes(&plan)?);
    use_threads(&plan.config.runtime)?;
    let cost = plan.cost();
    print_notes(plan.baseline_note(&cost, Segment::Space));
    if let (Some(size), Some(out)) = (args.groups, &args.out) {
        return in_groups(args, &plan, size, out);
    }
    cost.require_memory(Segment::Space, args.pipeline.memory_limit())?;
    let interrupt = Interrupt::default();
    let page = args.serve.start(&plan.config, "space", None, None)?;
    let cancel = interrupt.cancel();
    let token = args.token.as_ref().map(|path| Stations::read(path)?.only_token(path)).transpose()?;
    let options =
        SendOptions { connect_s: args.connect_s, bytes_per_s: args.bytes_per_s, held: args.held, token };
    let socket = args.send.as_ref().map(|url| SocketSink::new(url, options, cancel)).transpose()?;
    let socket = socket.map(|socket| socket.with_wait_handler(say_waiting));
    let confirmed = socket.as_ref().map(SocketSink::confirmed);
    let events = args.events.start(&plan.config, "space", args.out.as_slice(), true)?;
    let mut progress = None;
    let windows = plan.progress_windows();
    let file = args.out.clone().filter(|_| !to_standard_output);
    let destination = Destination { file, standard_output: to_standard_output, socket };
    let result = simulate(&plan, destination, cancel, &mut |handles| {
        interrupt.arm_or_note();
        page.watch(&handles);
        events.watch(&handles);
        progress = Some(Progress::watch(handles, INTEGRATE, windows, cancel));
    });
    drop(progress);
    let result = page.conclude(result, |report| report.cancelled);
    events.conclude(&result, |report| report.cancelled);
    let report = result?;
    let is_written = report.stage("record").is_some_and(|record| record.units > 0);
    let mut messages: Vec<String> = args
        .out
        .iter()
        .filter(|_| !to_standard_output)
        .map(|out| match is_written {
            true => format!("Wrote the downlink to {}", out.display()),
            false => format!("There is nothing to write to {}", out.display()),
        })
        .collect();
    if let (Some(url), Some(confirmed)) = (&args.send, confirmed) {
        messages.push(match confirmed.load(Ordering::Relaxed) {
            0 => format!("Sent the downlink to {url}, which confirmed no bytes"),
            bytes if args.held => format!("A checkpoint of {url} holds all {bytes} bytes"),
            bytes => format!("{url} confirmed all {bytes} bytes"),
        });
    }
    let printed = match args.json {
        _ if args.events.take_stdout() => Ok(()),
        _ if to_standard_output => {
            print_notes(messages);
            Ok(())
        }
        true => print_json_line(&report),
        false => print_text(&format!("{report}\n{}", messages.join("\n"))),
    };
    page.serve_until_interrupt(&interrupt);
    interrupt.completion(report.cancelled).after(printed)
}

impl SimulateArgs {
    /// Requires that standard output is used for the downlink only, and is not a terminal.
    fn require_standard_output(&self) -> Result<(), CommandError> {
        if self.json || self.groups.is_some() || self.events.take_stdout() {
            return Err("--out - writes the downlink to standard output; expected none of --json, --groups and --events -".into());
        }
        match std::io::stdout().is_terminal() {
            true => Err("--out - writes the downlink to standard output, which is a terminal; expected a pipe or a file".into()),
            false => Ok(()),
        }
    }
}

/// Simulates the channels in groups.
fn in_groups(args: &SimulateArgs, plan: &Plan, size: GroupSize, out: &Path) -> CommandResult {
    let simulated = plan.simulation_groups(size, args.pipeline.memory_limit())?;
    let groups = RunGroups { simulated, mapped: Vec::new() };
    let interrupt = Interrupt::default();
    let mut steps = GroupSteps::new(plan, &groups);
    let result = simulate_in_groups(plan, &groups.simulated, out, interrupt.cancel(), &mut |event, view| {
        steps.watch(event, view, &interrupt);
    });
    drop(steps);
    let reports = result?;
    let is_cancelled = reports.last().is_some_and(|report| report.cancelled);
    let message = match is_cancelled {
        true => "No downlink yet: repeat the command to go on".to_owned(),
        false => format!("Wrote the downlink to {}", out.display()),
    };
    let printed = match args.json {
        true => print_json_line(&reports),
        false => {
            let reports: Vec<String> = reports.iter().map(ToString::to_string).collect();
            print_text(&format!("{}\n{message}", reports.join("\n\n")))
        }
    };
    interrupt.completion(is_cancelled).after(printed)
}
