//! `lunarray replay`: the ground segment alone.

use std::path::PathBuf;

use clap::Args;

use super::progress::{Progress, cancel_on_interrupt};
use super::{CommandError, CommandResult, Outcome, print_json_line, print_text};
use crate::downlink::FileSource;
use crate::pipeline::state::{Keeper, WAIT_BYTES};
use crate::pipeline::{ConfigSource, replay, use_threads};
use crate::units::constants::DAY_S;

/// Make maps from downlink files alone.
///
/// Takes everything from the files: instrument, positions, visibilities. Lost, damaged and unusable
/// data is counted in the ledger. A map file is a pipeline file of which only the sections calibration,
/// map, products and runtime are used, so the file that made a simulation serves as it is; replaying it
/// gives, bit for bit, the maps that `lunarray run` gives.
#[derive(Debug, Args)]
pub(super) struct ReplayArgs {
    /// Downlink files, in the order of time.
    #[arg(required_unless_present = "state", value_name = "FILE")]
    files: Vec<PathBuf>,
    /// How to make the maps; the embedded quicklook's settings if not given.
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
    /// Bytes of packets that may wait for missing ones sent before them, or for positions, to be applied in order;
    /// of a new state, an old one keeps its own.
    #[arg(long, value_name = "BYTES", default_value_t = WAIT_BYTES, requires = "state")]
    wait_bytes: u64,
    /// Read on in the last FILE as it grows, until Ctrl-C, which leaves maps of the data so far.
    #[arg(long, requires = "files")]
    follow: bool,
    /// Seconds without growth after which a followed file is taken to be whole; 0 for never.
    #[arg(long, value_name = "SECONDS", default_value_t = 0.0, requires = "follow")]
    idle_s: f64,
    /// Mission time between snapshot maps: a number with s, h or d, such as 7d; 0 for a final map alone.
    #[arg(long, value_name = "TIME", value_parser = seconds)]
    snapshot_every: Option<f64>,
    /// Replace one setting, for example --set map.nside=8; may be given again.
    #[arg(long = "set", value_name = "KEY=VALUE")]
    overrides: Vec<String>,
    /// Print the summary as one JSON object instead of tables.
    #[arg(long)]
    json: bool,
}

/// Seconds from a text such as `7d`, `12h`, `90s` or `90`.
fn seconds(text: &str) -> Result<f64, String> {
    let text = text.trim();
    let (number, unit_s) = match text.strip_suffix(['s', 'h', 'd']) {
        Some(number) if text.ends_with('d') => (number, DAY_S),
        Some(number) if text.ends_with('h') => (number, 3600.0),
        Some(number) => (number, 1.0),
        None => (text, 1.0),
    };
    match number.trim().parse::<f64>() {
        Ok(value) if value >= 0.0 && value.is_finite() => Ok(value * unit_s),
        _ => Err("expected a number, not negative, with s, h or d, such as 7d".into()),
    }
}

pub(super) fn execute(args: &ReplayArgs) -> CommandResult {
    let mut overrides = args.overrides.clone();
    if let Some(every_s) = args.snapshot_every {
        overrides.push(format!("map.snapshot_every_s={every_s:?}"));
    }
    let config = ConfigSource { file: args.map.clone(), overrides, seed: None }.load_ground()?;
    use_threads(&config.runtime)?;
    let keeper = match &args.state {
        Some(folder) => Some(Keeper::open(folder, &config, args.wait_bytes, args.checkpoint_every)?),
        None => None,
    };
    for note in keeper.iter().flat_map(Keeper::notes) {
        eprintln!("note: {note}");
    }
    let files = match args.follow {
        true => FileSource::follow(&args.files, args.idle_s)?,
        false => FileSource::open(&args.files)?,
    };
    let cancel = cancel_on_interrupt()?;
    let mut progress = None;
    let summary = replay(files, &config, keeper, &args.out, &cancel, &mut |metrics| {
        progress = Some(Progress::watch(metrics, "read", 0));
    })?;
    drop(progress);
    if summary.channels.is_empty() && !summary.cancelled {
        let files: Vec<String> = args.files.iter().map(|file| file.display().to_string()).collect();
        let error = format!(
            "{}: no visibility could be used; see the ledger in {} and `lunarray inspect`\n{}",
            files.join(", "),
            args.out.join("summary.json").display(),
            summary.ledger
        );
        return Err(CommandError::from(error));
    }
    if args.json {
        print_json_line(&summary)?;
    } else {
        print_text(&format!("{summary}\nProducts are in {}", args.out.display()))?;
    }
    Ok(if summary.cancelled { Outcome::Interrupted } else { Outcome::Done })
}

#[cfg(test)]
mod tests {
    use super::seconds;

    #[test]
    fn times_have_units() {
        assert_eq!(seconds("7d"), Ok(604_800.0));
        assert_eq!(seconds("1.5 h"), Ok(5400.0));
        assert_eq!(seconds("90s"), Ok(90.0));
        assert_eq!(seconds("90"), Ok(90.0));
        for text in ["", "d", "-1d", "infd", "7w", "NaN"] {
            assert!(seconds(text).is_err(), "{text}");
        }
    }
}
