//! `lunarray recalibrate`: replace the gains of the data in a state.

use std::path::PathBuf;

use clap::Args;

use super::arguments::StateMapArgs;
use super::output::{CommandResult, Completion, print_json_line, print_notes, print_text};
use crate::ground::{Ground, WAIT_BYTES};
use crate::pipeline::{Config, use_threads, with_gains};

/// Replace the gains that were applied to the data of a state.
///
/// The visibilities of the files are subtracted from the sums with their old gains, and added with the new ones, both exactly: the
/// sums are those of a new state made with the new gains. The files have to contain all packets whose gains change. Replay later data
/// with the same --calibration. The state's version grows by one. If interrupted, the folder holds either the old state or the new one.
///
/// Example: lunarray recalibrate pass.ccsds --state state/ --old-calibration old/gains.json --calibration new/gains.json
#[derive(Debug, Args)]
pub(super) struct RecalibrateArgs {
    /// Downlink files whose visibilities get new gains.
    #[arg(required = true, value_name = "FILE")]
    files: Vec<PathBuf>,
    /// State folder of `lunarray replay --state`.
    #[arg(long, value_name = "DIR")]
    state: PathBuf,
    /// The new gains, as `lunarray calibrate` writes them.
    #[arg(long, value_name = "GAINS")]
    calibration: PathBuf,
    /// The gains file that the state was made with, if any.
    #[arg(long, value_name = "GAINS")]
    old_calibration: Option<PathBuf>,
    #[command(flatten)]
    map: StateMapArgs,
    /// Print one JSON object instead of text.
    #[arg(long)]
    json: bool,
}

pub(super) fn execute(args: &RecalibrateArgs) -> CommandResult {
    let old = args.old_calibration.iter().flat_map(|path| {
        let path = path.display().to_string();
        ["calibration.hook=antenna-gains".to_owned(), format!("calibration.gains_file={path:?}")]
    });
    let config = args.map.source_with(&args.state, old)?.load_ground()?;
    use_threads(&config.runtime)?;
    let new = with_gains(&config, args.calibration.clone());
    let ground = |config: &Config| config.ground(WAIT_BYTES);
    let (found, notes) = Ground::recalibrate(&args.state, &args.files, &ground(&config), &ground(&new))?;
    print_notes(new.positions_note());
    print_notes(notes.iter().map(String::as_str));
    if args.json {
        print_json_line(&found)?;
        return Ok(Completion::Done);
    }
    print_text(&format!(
        "{} packets of {} have new gains: {} of their visibilities were in the sums, {} are now; gains of {} packets did not change. \
         Calibration {}: {}",
        found.packets,
        args.state.display(),
        found.accumulated_before,
        found.accumulated,
        found.unchanged,
        found.version,
        found.gains,
    ))?;
    Ok(Completion::Done)
}
