//! `lunarray inspect`: show the contents of a downlink file.

use std::path::PathBuf;

use clap::Args;
use serde::Serialize;

use super::arguments::input_path;
use super::output::{CommandResult, Completion, print_json_line, print_text};
use crate::downlink::Contents;
use crate::imaging::circle::{GeometryCoverage, GeometrySurvey};
use crate::response::harmonic::GeometryLimits;

/// Show the contents of a downlink file, and its defects.
///
/// Prints time span, instrument and channels; packets and bytes by kind; visibilities by baseline and channel; gaps in
/// the packet counts, bad checksums and bytes between packets; and how many visibilities have the circular geometry
/// that the harmonic engine needs, with the reasons why others do not.
///
/// Example: lunarray inspect out/quicklook/downlink.ccsds
#[derive(Debug, Args)]
pub(super) struct InspectArgs {
    /// Downlink file.
    #[arg(value_name = "FILE", value_parser = input_path())]
    file: PathBuf,
    /// Print one JSON object instead of tables.
    #[arg(long)]
    json: bool,
}

/// The JSON output.
#[derive(Serialize)]
struct Inspection<'a> {
    #[serde(flatten)]
    contents: &'a Contents,
    /// Visibilities that the harmonic engine covers.
    geometry: &'a GeometryCoverage,
}

pub(super) fn execute(args: &InspectArgs) -> CommandResult {
    let mut survey = GeometrySurvey::new(GeometryLimits::default());
    let mut contents = Contents::read_with(&args.file, &mut |frame| survey.add(frame))?;
    let geometry = survey.finish();
    contents.without_positions = geometry.without_ephemeris;
    if args.json {
        print_json_line(&Inspection { contents: &contents, geometry: &geometry })?;
    } else {
        print_text(&format!("{contents}\n\n{geometry}"))?;
    }
    Ok(Completion::Done)
}
