//! `lunarray send`: send downlink files to a listening ground.

use std::path::PathBuf;
use std::sync::atomic::Ordering;
use std::time::Duration;

use clap::Args;
use serde_json::json;

use super::arguments::input_path;
use super::interrupt::Interrupt;
use super::log::say;
use super::output::{CommandResult, print_json_line, print_text};
use super::replay::{Speed, speed};
use crate::downlink::transport::socket::{SendOptions, SocketSink, Stations, TcpUrl};
use crate::downlink::{FileSource, Pace, PacedSource};
use crate::pipeline::READ;
use crate::runtime::{Cancel, Graph, Report, RuntimeError, Source};

/// Time limit for connecting, and for attempts to reach a busy ground, s.
const CONNECT_S: f64 = 10.0;

/// Time for the end after a signal.
const END: Duration = Duration::from_secs(10);

/// Chunks of files that wait to be sent.
const QUEUE_CAPACITY: usize = 4;

/// Send downlink files to a listening ground segment.
///
/// The bytes of all files go over one connection, as a station sends them, and are confirmed by the ground. With --speed no packet is
/// sent before its time: 1 is the pace at which the packets were made.
///
/// Example: lunarray send pass-0042.cadu --to tcp://127.0.0.1:4711 --speed 100
#[derive(Debug, Args)]
pub(super) struct SendArgs {
    /// Downlink files, packets or CADUs; - for standard input.
    #[arg(required = true, value_name = "FILE", value_parser = input_path())]
    files: Vec<PathBuf>,
    /// Address where `lunarray replay --listen` listens.
    #[arg(long, value_name = "tcp://HOST:PORT")]
    to: TcpUrl,
    /// Pace relative to real time, or as fast as the ground reads.
    #[arg(long, value_name = "max|NUMBER", default_value = "max", value_parser = speed)]
    speed: Speed,
    /// Wait until a checkpoint on the ground's disk holds everything; needs a ground with --state.
    #[arg(long)]
    held: bool,
    /// File with the line NAME TOKEN of the station, for a ground with --stations. Nobody else may be able to read it.
    #[arg(long, value_name = "FILE")]
    token: Option<PathBuf>,
    /// Print one JSON object instead of text: confirmed (bytes), to.
    #[arg(long)]
    json: bool,
}

pub(super) fn execute(args: &SendArgs) -> CommandResult {
    let interrupt = Interrupt::default();
    let token = args.token.as_ref().map(|path| Stations::read(path)?.only_token(path)).transpose()?;
    let options = SendOptions { connect_s: CONNECT_S, bytes_per_s: 0.0, held: args.held, token };
    let socket = SocketSink::new(&args.to, options, interrupt.cancel())?.with_wait_handler(say_waiting);
    let confirmed = socket.confirmed();
    let files = FileSource::open(&args.files)?;
    interrupt.arm_or_note();
    let report = match args.speed {
        Speed(None) => send(files, socket, interrupt.cancel()),
        Speed(Some(times)) => send(PacedSource::new(files, Pace::Speed(times)), socket, interrupt.cancel()),
    }?;
    let (bytes, to) = (confirmed.load(Ordering::Relaxed), &args.to);
    let printed = match args.json {
        true => print_json_line(&json!({ "confirmed": bytes, "to": to.to_string() })),
        false if args.held => print_text(&format!("A checkpoint of {to} holds all {bytes} bytes")),
        false => print_text(&format!("{to} confirmed all {bytes} bytes")),
    };
    interrupt.completion(report.cancelled).after(printed)
}

/// Says that a ground has no checkpoint yet that holds everything.
pub(super) fn say_waiting(to: &TcpUrl, bytes: u64, waited: Duration) {
    let waited_s = waited.as_secs();
    let fields = json!({ "to": to.to_string(), "bytes": bytes, "waited_s": waited_s });
    say(
        "waiting",
        &fields,
        format_args!("{waited_s} s: no checkpoint of {to} holds all {bytes} bytes yet; waiting"),
    );
}

fn send<S: Source<Out = Vec<u8>> + 'static>(
    source: S,
    socket: SocketSink,
    cancel: &Cancel,
) -> Result<Report, RuntimeError> {
    let mut graph = Graph::new();
    let bytes = graph.source(READ, QUEUE_CAPACITY, source);
    graph.sink("send", bytes, socket);
    graph.cut_after(END, &[]);
    graph.run(cancel, END)
}
