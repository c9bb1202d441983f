//! `lunarray inspect`: what is in a downlink file.

use std::path::PathBuf;

use clap::Args;
use serde::Serialize;

use super::output::{CommandResult, Completion, print_json_line, print_text};
use crate::accumulation::harmonic::{GeometryCoverage, GeometrySurvey};
use crate::downlink::Contents;
use crate::response::harmonic::GeometryLimits;

/// Show what a downlink file holds, and what is wrong with it.
///
/// Span, instrument, channels; packets and bytes by kind; visibilities by baseline and channel; gaps in
/// the packet counts, bad checksums, bytes between packets; how many visibilities are on one circle, as the
/// harmonic engine needs them, and why others are not.
#[derive(Debug, Args)]
pub(super) struct InspectArgs {
    /// Downlink file.
    #[arg(value_name = "FILE")]
    file: PathBuf,
    /// One JSON object instead of tables.
    #[arg(long)]
    json: bool,
}

/// What programs read.
#[derive(Serialize)]
struct Inspection<'a> {
    #[serde(flatten)]
    contents: &'a Contents,
    /// What the harmonic engine covers.
    geometry: &'a GeometryCoverage,
}

pub(super) fn execute(args: &InspectArgs) -> CommandResult {
    let mut survey = GeometrySurvey::new(GeometryLimits::default());
    let contents = Contents::read_with(&args.file, &mut |frame| survey.see(frame))?;
    let geometry = survey.finish();
    if args.json {
        print_json_line(&Inspection { contents: &contents, geometry: &geometry })?;
    } else {
        print_text(&format!("{contents}\n\n{geometry}"))?;
    }
    Ok(Completion::Done)
}
