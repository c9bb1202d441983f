//! `lunarray merge`: several states to one.

use std::path::PathBuf;

use clap::Args;

use super::{CommandResult, Outcome, print_text};
use crate::ground::{Ground, WAIT_BYTES};
use crate::pipeline::{ConfigSource, use_threads};

/// Put the states of several grounds together.
///
/// Takes folders of `lunarray replay --state` that were summed with the same settings and hold different packets, such
/// as those of passes received at different stations, and leaves a state in a new folder, to be gone on with. States
/// that hold the same visibilities are refused: replay the files of one into the other, which takes
/// every packet once. Sums are exact: they are the same in whatever order states are put together.
#[derive(Debug, Args)]
pub(super) struct MergeArgs {
    /// States.
    #[arg(required = true, num_args = 1.., value_name = "STATE")]
    states: Vec<PathBuf>,
    /// Folder for the new state.
    #[arg(short, long, value_name = "STATE")]
    out: PathBuf,
    /// The map file that the states were made with; the embedded quicklook's settings if not given.
    #[arg(long, value_name = "MAP.toml")]
    map: Option<PathBuf>,
    /// Replace one setting, for example --set map.nside=8; may be given again.
    #[arg(long = "set", value_name = "KEY=VALUE")]
    overrides: Vec<String>,
}

pub(super) fn execute(args: &MergeArgs) -> CommandResult {
    let source = ConfigSource { file: args.map.clone(), overrides: args.overrides.clone(), seed: None };
    let config = source.load_ground()?;
    use_threads(&config.runtime)?;
    let whole = Ground::merge(&args.out, &args.states, &config.ground(WAIT_BYTES))?;
    for note in whole.notes() {
        eprintln!("note: {note}");
    }
    let (packets, out) = (whole.packets(), args.out.display());
    let (states, are) = match args.states.len() {
        1 => ("1 state".to_owned(), "is"),
        number => (format!("{number} states"), "are together"),
    };
    print_text(&format!("{states} with {packets} packets of visibilities {are} in {out}"))?;
    Ok(Outcome::Done)
}
