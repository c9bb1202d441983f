//! `lunarray bursts`: light curves and dynamic spectra of bursts.

use std::path::PathBuf;

use clap::Args;

use super::arguments::{GainsArgs, input_path, output_path};
use super::output::{CommandResult, Completion, print_json_line, print_text};
use crate::files::ProtectedInputs;
use crate::pipeline::{BurstsReport, bursts_of_downlink, use_threads};

/// Find bursts in downlink files, and write their light curves and dynamic spectra.
///
/// Reads downlink files, or the segments of a state's raw archive, and searches each pass as `lunarray replay` does with calibration.bursts. Bursts
/// that overlap in time in any channels are one event. In all channels the flux density from its direction is fitted by time, each value with its
/// standard error.
///
/// Leaves event-0001.csv and so on (light curves of all channels), event-0001.png (dynamic spectrum; grey where no value is above its error) and summary.json
/// in the output folder.
///
/// Example: lunarray bursts pass-*.ccsds --out bursts/
#[derive(Debug, Args)]
pub(super) struct BurstsArgs {
    /// Downlink files.
    #[arg(required = true, value_name = "FILE", value_parser = input_path())]
    files: Vec<PathBuf>,
    #[command(flatten)]
    gains: GainsArgs,
    /// Output folder.
    #[arg(short, long, value_name = "DIR", value_parser = output_path())]
    out: PathBuf,
    /// Print one JSON object instead of text: that of summary.json.
    #[arg(long)]
    json: bool,
}

pub(super) fn execute(args: &BurstsArgs) -> CommandResult {
    let config = args.gains.source(&args.files).load_ground()?;
    let named = args.files.iter().chain(&args.gains.map).cloned();
    let _inputs = ProtectedInputs::of(named.chain(config.input_files()));
    use_threads(&config.runtime)?;
    let report = bursts_of_downlink(&config, &args.files, &args.out)?;
    if args.json {
        print_json_line(&report)?;
    } else {
        print_text(&text(&report))?;
        print_text(&format!("Products are in {}", args.out.display()))?;
    }
    Ok(Completion::Done)
}

fn text(report: &BurstsReport) -> String {
    let mut lines = vec![report.ledger.to_string()];
    lines.extend(report.searched.iter().map(ToString::to_string));
    for event in &report.events {
        let [number, curves] = [event.event, event.light_curves];
        lines.push(format!("event {number}: light curves of {curves} channels"));
        lines.extend(event.bursts.iter().map(|burst| format!("  {burst}")));
    }
    lines.join("\n")
}
