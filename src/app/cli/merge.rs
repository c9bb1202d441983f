//! `lunarray merge`: merge several states into one.

use std::path::PathBuf;

use clap::Args;

use super::arguments::{StateMapArgs, new_state_path};
use super::output::{CommandResult, Completion, print_json_line, print_notes, print_text};
use crate::ground::{Ground, WAIT_BYTES};
use crate::pipeline::use_threads;

/// Merge the states of several ground segments.
///
/// Reads state folders of `lunarray replay --state` that were made with the same settings from different packets, for
/// example from passes received at different stations, and writes a merged state to a new folder, which later replays
/// can continue. States that share visibilities are refused: replay the files of one into the other instead, which
/// applies every packet once. Sums are exact: the order of the states does not matter.
///
/// Example: lunarray merge station-a/ station-b/ --out both/
#[derive(Debug, Args)]
pub(super) struct MergeArgs {
    /// State folders to merge.
    #[arg(required = true, num_args = 1.., value_name = "STATE")]
    states: Vec<PathBuf>,
    /// New folder for the merged state.
    #[arg(short, long, value_name = "STATE", value_parser = new_state_path())]
    out: PathBuf,
    #[command(flatten)]
    map: StateMapArgs,
    /// Print one JSON object instead of text: states, packets, out.
    #[arg(long)]
    json: bool,
}

pub(super) fn execute(args: &MergeArgs) -> CommandResult {
    // Merging requires that all states have the same settings.
    let first = args.states.first().map_or(args.out.as_path(), PathBuf::as_path);
    let config = args.map.source(first)?.load_ground()?;
    use_threads(&config.runtime)?;
    let merged = Ground::merge(&args.out, &args.states, &config.ground(WAIT_BYTES))?;
    print_notes(merged.notes());
    if args.json {
        let (states, packets) = (args.states.len(), merged.packets());
        print_json_line(&serde_json::json!({ "states": states, "packets": packets, "out": args.out }))?;
        return Ok(Completion::Done);
    }
    let (packets, out) = (merged.packets(), args.out.display());
    let states = match args.states.len() {
        1 => "1 state".to_owned(),
        number => format!("{number} states"),
    };
    print_text(&format!("Merged {states} with {packets} packets of visibilities into {out}"))?;
    Ok(Completion::Done)
}
