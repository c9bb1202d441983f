//! `lunarray inspect`: what is in a downlink file.

use std::path::PathBuf;

use clap::Args;

use super::{CommandResult, Outcome, print_json_line, print_text};
use crate::downlink::Contents;

/// Show what a downlink file holds, and what is wrong with it.
///
/// Span, instrument, channels; packets and bytes by kind; visibilities by baseline and channel; gaps in
/// the packet counts, bad checksums, bytes between packets.
#[derive(Debug, Args)]
pub(super) struct InspectArgs {
    /// Downlink file.
    #[arg(value_name = "FILE")]
    file: PathBuf,
    /// One JSON object instead of tables.
    #[arg(long)]
    json: bool,
}

pub(super) fn execute(args: &InspectArgs) -> CommandResult {
    let contents = Contents::read(&args.file)?;
    if args.json {
        print_json_line(&contents)?;
    } else {
        print_text(&contents.to_string())?;
    }
    Ok(Outcome::Done)
}
