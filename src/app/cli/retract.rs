//! `lunarray retract`: remove the packets of bad files from a state.

use std::path::PathBuf;

use clap::Args;

use super::arguments::{StateMapArgs, input_path};
use super::output::{CommandResult, Completion, print_json_line, print_notes, print_text};
use crate::ground::{Ground, WAIT_BYTES};
use crate::pipeline::use_threads;
use crate::units::MissionTime;

/// Remove the packets of files from a state.
///
/// Every packet of the files that is in the state is removed from the sums, the counters and the received set, as if it
/// had never arrived. A good copy can be replayed later; until then the packet is a gap in `lunarray gaps` and lost in the
/// ledger. Packets that are not in the state are counted. A packet that differs from the one applied, such as a good
/// copy of a bad packet, is listed and not removed, because subtracting other values would corrupt the sums. Positions that other
/// visibilities depend on stay too. If interrupted, the folder holds either the old state or the new one.
///
/// Example: lunarray retract bad-pass.ccsds --state state/
#[derive(Debug, Args)]
pub(super) struct RetractArgs {
    /// Downlink files whose packets are removed.
    #[arg(required = true, value_name = "FILE", value_parser = input_path())]
    files: Vec<PathBuf>,
    /// State folder of `lunarray replay --state`.
    #[arg(long, value_name = "DIR")]
    state: PathBuf,
    /// Remove only packets of visibilities that begin at this mission time, s, or later.
    #[arg(long, value_name = "SECONDS", allow_negative_numbers = true)]
    from_s: Option<f64>,
    /// Remove only packets of visibilities that end at this mission time, s, or earlier.
    #[arg(long, value_name = "SECONDS", allow_negative_numbers = true)]
    to_s: Option<f64>,
    #[command(flatten)]
    map: StateMapArgs,
    /// Print one JSON object instead of text.
    #[arg(long)]
    json: bool,
}

pub(super) fn execute(args: &RetractArgs) -> CommandResult {
    let config = args.map.source(&args.state)?.load_ground()?;
    use_threads(&config.runtime)?;
    let ticks = |s: Option<f64>, otherwise: i64| s.map_or(MissionTime(otherwise), MissionTime::from_seconds);
    let span = match (args.from_s, args.to_s) {
        (None, None) => None,
        (from_s, to_s) => Some([ticks(from_s, i64::MIN), ticks(to_s, i64::MAX)]),
    };
    let config = config.ground(WAIT_BYTES);
    let (found, notes) = Ground::retract(&args.state, &args.files, span, &config)?;
    print_notes(notes.iter().map(String::as_str));
    print_notes(found.refused_packets.iter().map(|refused| {
        format!("packet {} of {} was not removed: {}", refused.count, refused.kind, refused.reason)
    }));
    if args.json {
        print_json_line(&found)?;
        return Ok(Completion::Done);
    }
    let mut text = format!(
        "Removed {} packets from {}; {} of them were in the hold buffer; {} of their {} visibilities were in the sums",
        found.packets,
        args.state.display(),
        found.held,
        found.accumulated,
        found.visibilities,
    );
    for (count, what) in [
        (found.absent, "packets were not in the state"),
        (found.kept, "packets of positions or of partial payloads stay, because other packets need them"),
        (found.refused, "packets stay, because they differ from those applied"),
    ] {
        if count > 0 {
            text.push_str(&format!("\n{count} {what}"));
        }
    }
    print_text(&text)?;
    Ok(Completion::Done)
}
