//! `lunarray figure`: figures of the array and its beam matrix.

use std::path::PathBuf;

use clap::Args;

use super::arguments::{TimeOfMission, input_path, output_path, time_of_mission};
use super::output::{CommandResult, Completion, print_json_line, print_text};
use crate::figures::{FIGURES, FigureRequest, make_figure};
use crate::files::ProtectedInputs;
use crate::pipeline::{ConfigSource, Plan, use_threads};
use crate::units::Pair;

/// Draw figures of the array and its beam matrix, which need no map.
///
/// Leaves a picture (PNG), a table (CSV) and numbers (JSON) of each:
/// spacing: the ratio q0 of the formation's steps against R and R_2;
/// baselines: lengths, components across the track and upwards, and altitudes, over the mission;
/// pair-time: observing time of pairs, also for other breathing ratios, and visibilities by baseline length;
/// uvw: distribution of baselines on ecliptic axes;
/// coverage: observing time, visibilities, shortest projected baseline and uv coverage by direction, also as FITS maps;
/// rows: a row of B at pixel centres and averaged over pixels, drawn without the Moon;
/// waterfall: visibilities of one pair over time and within 10 % of the frequency, of the sky and of the sky in the map's pixels;
/// sub-pixel: effect of the sky's structure within pixels of nside 8 and 16 on visibilities and maps.
///
/// Example: lunarray figure pair-time pipelines/paper-10mhz.toml --out out/figures
#[derive(Debug, Args)]
pub(super) struct FigureArgs {
    /// Which figure.
    #[arg(value_name = "NAME", value_parser = FIGURES)]
    name: String,
    /// Pipeline file (TOML); the embedded quicklook if none is given.
    #[arg(value_name = "PIPELINE.toml", value_parser = input_path())]
    pipeline: Option<PathBuf>,
    /// Replace one setting, for example --set spacecraft.channels_hz=[3e6,10e6]; may be repeated.
    #[arg(long = "set", value_name = "KEY=VALUE")]
    overrides: Vec<String>,
    /// Output folder.
    #[arg(short, long, value_name = "DIR", default_value = "out/figures", value_parser = output_path())]
    out: PathBuf,
    /// Pair of rows and waterfall, such as 1-2; the one closest to 2 b_p if not given.
    #[arg(long)]
    pair: Option<Pair>,
    /// Time of rows and waterfall since the mission epoch, a number with an optional unit s, h or d, or a date (TAI, or UTC with a Z); the middle of the
    /// first window if not given.
    #[arg(long, value_name = "TIME", value_parser = time_of_mission)]
    at: Option<TimeOfMission>,
    /// Print the numbers as one JSON object.
    #[arg(long)]
    json: bool,
}

pub(super) fn execute(args: &FigureArgs) -> CommandResult {
    let source = ConfigSource { file: args.pipeline.clone(), overrides: args.overrides.clone(), seed: None };
    let plan = Plan::new(source.load()?)?;
    let _inputs = ProtectedInputs::of(args.pipeline.iter().cloned().chain(plan.config.input_files()));
    use_threads(&plan.config.runtime)?;
    let at_s = args.at.map(|time| time.since_s(plan.instrument.epoch_tai_s));
    let request = FigureRequest { name: args.name.clone(), pair: args.pair, at_s };
    let figure = make_figure(&request, &plan, &args.out)?;
    if args.json {
        print_json_line(&figure)?;
    } else {
        let files: Vec<String> = figure.files.iter().map(|path| path.display().to_string()).collect();
        print_text(&files.join("\n"))?;
    }
    Ok(Completion::Done)
}
