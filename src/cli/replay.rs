//! `lunarray replay`: the ground segment alone.

use std::path::PathBuf;

use clap::{ArgGroup, Args};
use crossbeam_channel::{Receiver, bounded};

use super::progress::{Progress, cancel_on_interrupt};
use super::{CommandError, CommandResult, Outcome, not_negative_s, print_json_line, print_text};
use crate::downlink::transport::socket::{SocketError, SocketSource, TcpUrl, Until};
use crate::downlink::{FileSource, Pace, Paced, Steps};
use crate::ground::{Ground, WAIT_BYTES};
use crate::pipeline::{
    Config, ConfigSource, GroundSource, PipelineError, READ, Summary, replay, use_threads,
};
use crate::runtime::Cancel;

/// Bytes of visibilities that wait for positions where several senders are listened to and nothing is kept.
const WAIT_BYTES_LIVE: u64 = 1 << 20;

/// Make maps from downlink files, or from stations that send, alone.
///
/// Takes everything from the downlink: instrument, positions, visibilities. Lost, damaged and unusable
/// data is counted in the ledger. A map file is a pipeline file of which only the sections calibration,
/// map, products, runtime and downlink.listen are used, so the file that made a simulation serves as it is;
/// replaying it gives, bit for bit, the maps that `lunarray run` gives.
#[derive(Debug, Args)]
#[command(group(ArgGroup::new("live").args(["follow", "listen"])))]
#[command(group(ArgGroup::new("pace").args(["speed", "step"])))]
pub(super) struct ReplayArgs {
    /// Downlink files, in the order of time.
    #[arg(required_unless_present_any = ["state", "listen"], value_name = "FILE")]
    files: Vec<PathBuf>,
    /// How to make the maps; the defaults of pipelines/reference.toml if not given.
    #[arg(long, value_name = "MAP.toml")]
    map: Option<PathBuf>,
    /// Folder for the products.
    #[arg(short, long, value_name = "DIR")]
    out: PathBuf,
    /// Folder in which everything received is kept: every packet is applied once, in this session and all later
    /// ones, however often and in whatever order it comes. Ended at any moment, give the same command again.
    #[arg(long, value_name = "DIR")]
    state: Option<PathBuf>,
    /// Visibilities between two checkpoints of the state; there is one at the end in any case.
    #[arg(long, value_name = "NUMBER", default_value_t = 1_000_000, requires = "state")]
    checkpoint_every: u64,
    /// Bytes of visibilities that may wait for their positions; beyond it, those sent first are flagged for want of them:
    /// 256 MiB, 1 MiB when listening without a state; an old state keeps its own.
    #[arg(long, value_name = "BYTES")]
    wait_bytes: Option<u64>,
    /// Read on in the last FILE as it grows, until Ctrl-C, which leaves maps of the data so far.
    #[arg(long, requires = "files")]
    follow: bool,
    /// Take the downlink from senders that connect here, instead of files, until Ctrl-C; port 0 chooses one.
    /// Standard error says `listening on tcp://HOST:PORT`.
    #[arg(long, value_name = "tcp://HOST:PORT", conflicts_with_all = ["files", "pace"])]
    listen: Option<TcpUrl>,
    /// Listen on an address that other machines can reach. Whoever connects can add to the maps.
    #[arg(long, requires = "listen")]
    allow_remote: bool,
    /// End after so many connections that gave packets have been closed; 0 for never.
    #[arg(long, value_name = "NUMBER", default_value_t = 0, requires = "listen")]
    connections: u64,
    /// Time without growth after which a followed file is taken to be whole, or without a sound packet from anyone
    /// after which listening ends: a number with s, h or d, such as 90s; 0 for never.
    #[arg(long, value_name = "TIME", default_value_t = 0.0, requires = "live", value_parser = not_negative_s)]
    idle_s: f64,
    /// How many times as fast as it was sent a FILE is replayed, by the times of its packets: a number, or max.
    #[arg(long, value_name = "max|NUMBER", default_value = "max", value_parser = speed)]
    speed: Speed,
    /// Replay step by step, a pass or so much mission time each (a number with s, h or d): each line of standard
    /// input is a step, its end ends the replay.
    #[arg(long, value_name = "pass|TIME", value_parser = step)]
    step: Option<Step>,
    /// Mission time between snapshot maps: a number with s, h or d, such as 7d; 0 for a final map alone.
    #[arg(long, value_name = "TIME", value_parser = not_negative_s)]
    snapshot_every: Option<f64>,
    /// Replace one setting, for example --set map.nside=8; may be given again.
    #[arg(long = "set", value_name = "KEY=VALUE")]
    overrides: Vec<String>,
    /// Print the summary as one JSON object instead of tables.
    #[arg(long)]
    json: bool,
}

/// How fast to replay; `None` for as fast as possible.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Speed(Option<f64>);

/// Mission time of a step, s; `None` for a pass.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Step(Option<f64>);

fn speed(text: &str) -> Result<Speed, String> {
    match (text.trim(), text.trim().parse::<f64>()) {
        ("max", _) => Ok(Speed(None)),
        (_, Ok(times)) if (1e-3..=1e12).contains(&times) => Ok(Speed(Some(times))),
        _ => Err("expected max, or a number of times real time from 0.001 to 1e12".into()),
    }
}

fn step(text: &str) -> Result<Step, String> {
    match text.trim() {
        "pass" => Ok(Step(None)),
        text => match not_negative_s(text) {
            Ok(every_s) if every_s > 0.0 => Ok(Step(Some(every_s))),
            _ => Err("expected pass, or a number above 0 with s, h or d, such as 1d".into()),
        },
    }
}

pub(super) fn execute(args: &ReplayArgs) -> CommandResult {
    let mut overrides = args.overrides.clone();
    if let Some(every_s) = args.snapshot_every {
        overrides.push(format!("map.snapshot_every_s={every_s:?}"));
    }
    let config = ConfigSource { file: args.map.clone(), overrides, seed: None }.load_ground()?;
    use_threads(&config.runtime)?;
    let wait_bytes = match (&args.state, &args.listen) {
        (None, Some(_)) => WAIT_BYTES_LIVE,
        _ => WAIT_BYTES,
    };
    let settings = config.ground(args.wait_bytes.unwrap_or(wait_bytes));
    let ground = match &args.state {
        Some(folder) => Ground::open(folder, &settings, args.checkpoint_every)?,
        None => Ground::new(&settings)?,
    };
    for note in ground.notes() {
        eprintln!("note: {note}");
    }
    let summary = match &args.listen {
        Some(url) => from_senders(args, url, &config, ground)?,
        None => from_files(args, &config, ground)?,
    };
    if args.json {
        print_json_line(&summary)?;
    } else {
        print_text(&format!("{summary}\nProducts are in {}", args.out.display()))?;
    }
    Ok(if summary.cancelled { Outcome::Interrupted } else { Outcome::Done })
}

fn from_senders(
    args: &ReplayArgs,
    url: &TcpUrl,
    config: &Config,
    ground: Ground,
) -> Result<Summary, CommandError> {
    let addresses = if args.allow_remote { url.addresses()? } else { url.own_addresses()? };
    let until = Until { idle_s: args.idle_s, connections: args.connections };
    let source = SocketSource::bind(&addresses, &config.downlink.listen, until)
        .map_err(|error| match error {
            SocketError::Listen { source, .. } => SocketError::Listen { url: url.clone(), source },
            other => other,
        })?
        .knowing(ground.instrument().cloned())
        .telling(Box::new(|note| eprintln!("note: {note}")));
    let cancel = cancel_on_interrupt()?;
    eprintln!("listening on {}", source.url());
    Ok(watched(source, args, config, ground, &cancel)?)
}

fn from_files(args: &ReplayArgs, config: &Config, ground: Ground) -> Result<Summary, CommandError> {
    let files = match args.follow {
        true => FileSource::follow(&args.files, args.idle_s)?,
        false => FileSource::open(&args.files)?,
    };
    let cancel = cancel_on_interrupt()?;
    let pace = match (args.step, args.speed) {
        (Some(Step(every_s)), _) => {
            let tell = Box::new(|note: &str| eprintln!("{note}"));
            Pace::Steps(Steps { every_s, go: lines_of_input(), tell })
        }
        (None, Speed(Some(times))) => Pace::Speed(times),
        (None, Speed(None)) => return Ok(watched(files, args, config, ground, &cancel)?),
    };
    Ok(watched(Paced::new(files, pace), args, config, ground, &cancel)?)
}

fn watched<S: GroundSource + 'static>(
    source: S,
    args: &ReplayArgs,
    config: &Config,
    ground: Ground,
    cancel: &Cancel,
) -> Result<Summary, PipelineError> {
    let mut progress = None;
    replay(source, config, ground, &args.out, cancel, &mut |watched| {
        progress = Some(Progress::watch(watched, READ, 0));
    })
}

/// A message for each line of standard input, until its end.
fn lines_of_input() -> Receiver<()> {
    let (say, go) = bounded(0);
    // The thread ends with the input or the process: nothing else can end its reading.
    std::thread::spawn(move || {
        for line in std::io::stdin().lines() {
            if line.is_err() || say.send(()).is_err() {
                return;
            }
        }
    });
    go
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::units::constants::DAY_S;

    #[test]
    fn paces_are_read() {
        assert_eq!(speed("max"), Ok(Speed(None)));
        assert_eq!(speed("1000"), Ok(Speed(Some(1000.0))));
        assert_eq!(step("pass"), Ok(Step(None)));
        assert_eq!(step("1d"), Ok(Step(Some(DAY_S))));
        assert!(["0", "-1", "inf", "NaN", "fast"].iter().all(|text| speed(text).is_err()));
        assert!(["0", "-1d", "file.ccsds", ""].iter().all(|text| step(text).is_err()));
    }
}
