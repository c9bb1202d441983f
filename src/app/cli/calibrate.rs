//! `lunarray calibrate`: find gains, clocks and positions from the data.

use std::path::PathBuf;

use clap::Args;

use super::arguments::{MapFileArgs, input_path, output_path, require_repeatable};
use super::interrupt::Interrupt;
use super::output::{CommandResult, print_json_line, print_notes, print_text};
use super::progress::CalibrateLines;
use crate::files::ProtectedInputs;
use crate::pipeline::{CalibrateJob, CalibrateSummary, ConfigSource, calibrate, use_threads};
use crate::sky::fits::read_known_sky;

/// Find the gains of every daughter, pass by pass, from the visibilities of a known signal.
///
/// The signal is the sky of a map, the mother's artificial signal, or both (calibrate.mode). Solves for amplitudes and
/// phases, and if asked for clocks and positions, with priors (section [calibrate]). With calibrate.map_rounds, map and
/// solutions are made in turn until they settle. Writes gains.json, which `lunarray replay --calibration` applies, tables
/// (solutions.csv, solutions.json) and a picture. Everything is written at the end: an interrupted command leaves no
/// gains, and its repetition the same bytes.
///
/// Example: lunarray calibrate sky.ccsds --model model.fits --map map.toml --out calibration/
#[derive(Debug, Args)]
pub(super) struct CalibrateArgs {
    /// Downlink files in the order of time.
    #[arg(required = true, value_name = "FILE", value_parser = input_path())]
    files: Vec<PathBuf>,
    /// HEALPix map of the sky in K; one for each channel of the downlink, in their order; calibrate.model_files if not given.
    #[arg(long, value_name = "MAP.fits", num_args = 1..)]
    model: Vec<PathBuf>,
    /// Map file (TOML): settings of the ground segment; the defaults of pipelines/reference.toml if not given.
    #[arg(long, value_name = "MAP.toml", value_parser = input_path())]
    map: Option<PathBuf>,
    /// Output folder.
    #[arg(short, long, value_name = "DIR", value_parser = output_path())]
    out: PathBuf,
    /// Replace one setting, for example --set calibrate.clock_sigma_ns=50; may be repeated.
    #[arg(long = "set", value_name = "KEY=VALUE")]
    overrides: Vec<String>,
    #[command(flatten)]
    maps: MapFileArgs,
    /// Print the summary as one JSON object instead of text.
    #[arg(long)]
    json: bool,
}

pub(super) fn execute(args: &CalibrateArgs) -> CommandResult {
    let source = ConfigSource { file: args.map.clone(), overrides: args.overrides.clone(), seed: None };
    let config = source.load_ground()?;
    let named = args.files.iter().chain(&args.model).chain(&args.map).cloned();
    let _inputs = ProtectedInputs::of(named.chain(config.input_files()));
    if config.calibrate.map_rounds > 0 {
        let reason = "calibrate.map_rounds above 0 reads the downlink again for each round";
        args.files.iter().try_for_each(|path| require_repeatable(path, reason))?;
    }
    use_threads(&config.runtime)?;
    let options = args.maps.options();
    let (model_files, models) = match args.model.is_empty() {
        true => (&config.calibrate.model_files, config.calibrate.models()?),
        false => {
            let models = args.model.iter().map(|path| read_known_sky(path, &options));
            (&args.model, models.collect::<Result<_, _>>()?)
        }
    };
    let interrupt = Interrupt::default();
    interrupt.arm_or_note();
    let mut lines = CalibrateLines::new();
    let job = CalibrateJob {
        config: &config,
        files: &args.files,
        models,
        model_files,
        out: &args.out,
        watch: &mut |progress| lines.show(&progress),
    };
    let summary = calibrate(job, interrupt.cancel())?;
    print_notes(&summary.conventions);
    print_notes(&summary.warnings);
    interrupt.completion(summary.cancelled).after(if args.json {
        print_json_line(&summary)
    } else {
        print_text(&summary_text(&summary, args))
    })
}

fn summary_text(summary: &CalibrateSummary, args: &CalibrateArgs) -> String {
    let mut lines = vec![summary.to_string()];
    for round in &summary.rounds {
        // Without rounds there is one solution.
        let mut line =
            if summary.rounds.len() > 1 { format!("round {}: ", round.round) } else { String::new() };
        line += &format!("chi-square {:.4}", round.chi_square);
        for (name, value) in [("held out", round.chi_square_held_out), ("change of gains", round.change_rms)]
        {
            line += &value.map_or_else(String::new, |value| format!(", {name} {value:.4}"));
        }
        lines.push(line);
    }
    for (channel, sigmas) in summary.phase_sigma_deg.iter().enumerate() {
        let sigmas: Vec<String> = sigmas
            .iter()
            .map(|sigma| sigma.map_or_else(|| "-".to_owned(), |sigma| format!("{sigma:.2}")))
            .collect();
        lines.push(format!(
            "channel {}: phases known to {} deg (median by daughter, - without a good gain)",
            channel,
            sigmas.join(", ")
        ));
    }
    match summary.cancelled {
        true => lines.push("Ended early: nothing is written".to_owned()),
        false => lines.push(format!("Solutions are in {}", args.out.display())),
    }
    lines.join("\n")
}
