//! `lunarray simulate`: the space segment alone.

use std::path::PathBuf;
use std::sync::atomic::Ordering;

use clap::Args;

use super::arguments::{PipelineArgs, not_negative_s};
use super::output::{CommandResult, Completion, print_config_notes, print_json_line, print_text};
use super::progress::{Progress, cancel_on_interrupt};
use crate::downlink::transport::socket::{SendOptions, SocketSink, TcpUrl};
use crate::pipeline::{Destination, INTEGRATE, Plan, simulate, use_threads};

/// Simulate the space segment, to a downlink file or to a ground that listens.
///
/// The downlink holds CCSDS space packets with the instrument description, the ephemeris and the
/// visibilities: all that `lunarray replay` needs. A file bears its name once it is complete; until then it
/// ends in .partial. Ctrl-C ends it after the window in hand and leaves a valid file.
#[derive(Debug, Args)]
pub(super) struct SimulateArgs {
    #[command(flatten)]
    pipeline: PipelineArgs,
    /// Downlink file to write.
    #[arg(short, long, value_name = "FILE", required_unless_present = "send")]
    out: Option<PathBuf>,
    /// Send the downlink to this place as it is made, as `lunarray replay --listen` takes it: a slow ground slows the
    /// spacecraft.
    #[arg(long, value_name = "tcp://HOST:PORT")]
    send: Option<TcpUrl>,
    /// How long to try to connect, s.
    #[arg(long, value_name = "SECONDS", default_value_t = 10.0, requires = "send", value_parser = not_negative_s)]
    connect_s: f64,
    /// Bytes a second to send at most; 0 for as many as the ground takes.
    #[arg(long, value_name = "NUMBER", default_value_t = 0.0, requires = "send", value_parser = rate)]
    bytes_per_s: f64,
    /// Print stages and throughput as one JSON object instead of a table.
    #[arg(long)]
    json: bool,
}

fn rate(text: &str) -> Result<f64, String> {
    match text.trim().parse::<f64>() {
        Ok(value) if value == 0.0 || (1.0..=1e12).contains(&value) => Ok(value),
        _ => Err("expected 1 to 1e12 bytes a second, or 0 for no limit".into()),
    }
}

pub(super) fn execute(args: &SimulateArgs) -> CommandResult {
    let config = args.pipeline.source().load()?;
    print_config_notes(&config);
    let plan = Plan::new(config)?;
    use_threads(&plan.config.runtime)?;
    let cancel = cancel_on_interrupt()?;
    let options = SendOptions { connect_s: args.connect_s, bytes_per_s: args.bytes_per_s };
    let socket = args.send.as_ref().map(|url| SocketSink::new(url, options, &cancel)).transpose()?;
    let confirmed = socket.as_ref().map(SocketSink::confirmed);
    let mut progress = None;
    let windows = plan.windows_watched();
    let to = Destination { file: args.out.clone(), socket };
    let report = simulate(&plan, to, &cancel, &mut |metrics| {
        progress = Some(Progress::watch(metrics, INTEGRATE, windows));
    })?;
    drop(progress);
    let mut places: Vec<String> =
        args.out.iter().map(|out| format!("The downlink is in {}", out.display())).collect();
    if let (Some(url), Some(confirmed)) = (&args.send, confirmed) {
        places.push(match confirmed.load(Ordering::Relaxed) {
            0 => format!("The downlink was sent to {url}, which did not say how much of it it took"),
            bytes => format!("{url} took all {bytes} bytes"),
        });
    }
    if args.json {
        print_json_line(&report)?;
    } else {
        print_text(&format!("{report}\n{}", places.join("\n")))?;
    }
    Ok(Completion::of(report.cancelled))
}
