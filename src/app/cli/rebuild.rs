//! `lunarray rebuild`: make a state from a raw archive.

use std::path::PathBuf;

use clap::Args;

use super::arguments::{StateMapArgs, new_state_path};
use super::output::{CommandResult, Completion, print_json_line, print_notes, print_text};
use crate::ground::{Ground, WAIT_BYTES, packets_folder};
use crate::pipeline::use_threads;

/// Make a new state from the raw archive of a ground.
///
/// A ground that listens keeps every packet in a raw archive, the folder `archive` of its state. This command applies them to a new
/// state, as `lunarray replay` does: for other settings or another version, or when the checkpoints are damaged. Packets that were retracted stay out. The archive stays as it is, and may be a copy.
///
/// Example: lunarray rebuild state/ --out state-new/
#[derive(Debug, Args)]
pub(super) struct RebuildArgs {
    /// The state whose raw archive is read, or a raw archive.
    #[arg(value_name = "STATE|ARCHIVE")]
    from: PathBuf,
    /// New folder for the state.
    #[arg(short, long, value_name = "STATE", value_parser = new_state_path())]
    out: PathBuf,
    #[command(flatten)]
    map: StateMapArgs,
    /// Print one JSON object instead of text: packets, bytes, damaged, whole, out.
    #[arg(long)]
    json: bool,
}

pub(super) fn execute(args: &RebuildArgs) -> CommandResult {
    let config = args.map.source(&args.from)?.load_ground()?;
    use_threads(&config.runtime)?;
    let inner = packets_folder(&args.from);
    let archive = if inner.is_dir() { inner } else { args.from.clone() };
    let (ground, found) = Ground::rebuild(&args.out, &archive, &config.ground(WAIT_BYTES))?;
    print_notes(ground.notes());
    let is_whole = found.first_segment == 1;
    let (packets, damaged) = (found.packets, found.damaged);
    if args.json {
        print_json_line(&serde_json::json!({
            "packets": packets, "bytes": found.bytes, "damaged": damaged, "whole": is_whole, "out": args.out
        }))?;
        return Ok(Completion::Done);
    }
    if damaged > 0 {
        print_notes([format!(
            "{damaged} stretches of the archive are damaged: `lunarray gaps` names the packets that are missing"
        )]);
    }
    if !is_whole {
        let first = found.first_segment;
        print_notes([format!(
            "the archive begins with segment {first}: older ones were deleted, and their packets are missing"
        )]);
    }
    let (bytes, out) = (found.bytes, args.out.display());
    print_text(&format!("Made a state of {packets} packets ({bytes} bytes) in {out}"))?;
    Ok(Completion::Done)
}
