//! `lunarray retract`: a bad file out of a state again.

use std::path::PathBuf;

use clap::Args;

use super::{CommandResult, Outcome, print_json_line, print_text};
use crate::ground::{Ground, WAIT_BYTES};
use crate::pipeline::{ConfigSource, use_threads};
use crate::units::MissionTime;

/// Take the packets of files out of a state again.
///
/// Every packet of the files that is in the state is taken out of the sums, the accounts and the set of packets that
/// have come, as if it had never come; a good copy can be replayed later, and until then it is missing in `lunarray
/// gaps` and lost in the ledger. Packets that are not in the state are counted. A packet that differs from the one that
/// was applied, as a good copy of a bad one does, stays, and is named: subtracting something else would spoil
/// the sums. Positions that other visibilities were placed by stay too. Ended at any moment, the folder holds the old
/// state or the new one.
#[derive(Debug, Args)]
pub(super) struct RetractArgs {
    /// Downlink files.
    #[arg(required = true, value_name = "FILE")]
    files: Vec<PathBuf>,
    /// The state, a folder of `lunarray replay --state`.
    #[arg(long, value_name = "DIR")]
    state: PathBuf,
    /// Take out visibilities alone, and only packets that begin at this mission time, s, or later.
    #[arg(long, value_name = "SECONDS", allow_negative_numbers = true)]
    from_s: Option<f64>,
    /// Take out visibilities alone, and only packets that end at this mission time, s, or before.
    #[arg(long, value_name = "SECONDS", allow_negative_numbers = true)]
    to_s: Option<f64>,
    /// The map file that the state was made with; the embedded quicklook's settings if not given.
    #[arg(long, value_name = "MAP.toml")]
    map: Option<PathBuf>,
    /// Replace one setting, for example --set map.nside=8; may be given again.
    #[arg(long = "set", value_name = "KEY=VALUE")]
    overrides: Vec<String>,
    /// Print one JSON object.
    #[arg(long)]
    json: bool,
}

pub(super) fn execute(args: &RetractArgs) -> CommandResult {
    let source = ConfigSource { file: args.map.clone(), overrides: args.overrides.clone(), seed: None };
    let config = source.load_ground()?;
    use_threads(&config.runtime)?;
    let ticks = |s: Option<f64>, otherwise: i64| s.map_or(MissionTime(otherwise), MissionTime::from_seconds);
    let span = match (args.from_s, args.to_s) {
        (None, None) => None,
        (from_s, to_s) => Some([ticks(from_s, i64::MIN), ticks(to_s, i64::MAX)]),
    };
    let config = config.ground(WAIT_BYTES);
    let (found, notes) = Ground::retract(&args.state, &args.files, span, &config)?;
    for note in notes {
        eprintln!("note: {note}");
    }
    for refused in &found.named {
        eprintln!(
            "note: the packet of {} with count {} stays: {}",
            refused.kind, refused.count, refused.reason
        );
    }
    if args.json {
        print_json_line(&found)?;
        return Ok(Outcome::Done);
    }
    let mut text = format!(
        "{} packets are taken out of {}, {} of which waited; {} of their {} visibilities were in the sums",
        found.packets,
        args.state.display(),
        found.waited,
        found.accumulated,
        found.visibilities,
    );
    for (count, what) in [
        (found.absent, "packets were not in it"),
        (found.kept, "packets of positions or of parts of payloads stay, for what others need them"),
        (found.refused, "packets stay, for taking them out would take out something else"),
    ] {
        if count > 0 {
            text.push_str(&format!("\n{count} {what}"));
        }
    }
    print_text(&text)?;
    Ok(Outcome::Done)
}
