//! The command line: arguments, progress, output for people and for programs.

mod bench;
mod check;
mod compare;
mod corrupt;
mod gaps;
mod geometry;
mod inspect;
mod merge;
mod predict;
mod progress;
mod replay;
mod retract;
mod run;
mod simulate;
mod sky;

use std::io::Write;
use std::path::PathBuf;
use std::process::ExitCode;

use clap::{Args, Parser, Subcommand};

use crate::pipeline::{Config, ConfigSource};
use crate::units::constants::DAY_S;

/// What went wrong with a command; every variant says where and what was expected.
type CommandError = Box<dyn std::error::Error + Send + Sync>;
type CommandResult = Result<Outcome, CommandError>;

/// How a command that did not fail has ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Outcome {
    /// All of it was done.
    Done,
    /// Ctrl-C ended it early; what it leaves is valid.
    Interrupted,
}

/// From a sky, through a lunar-orbit interferometer and its downlink, to a map.
///
/// Below 30 MHz the ionosphere hides the sky. Eight small satellites that circle the Moon correlate
/// their signals while the Moon hides the Earth, and send visibilities down when it is in sight again;
/// lunarray simulates them, takes their downlink files, and turns them into maps of the whole sky.
///
/// Start with `lunarray run`: it needs no file and leaves maps in out/quicklook/.
#[derive(Debug, Parser)]
#[command(name = "lunarray", version, propagate_version = true, max_term_width = 100)]
struct Cli {
    #[command(subcommand)]
    command: Command,
}

#[derive(Debug, Subcommand)]
enum Command {
    Run(run::RunArgs),
    Simulate(simulate::SimulateArgs),
    Replay(replay::ReplayArgs),
    Inspect(inspect::InspectArgs),
    Corrupt(corrupt::CorruptArgs),
    Gaps(gaps::GapsArgs),
    Merge(merge::MergeArgs),
    Retract(retract::RetractArgs),
    Compare(compare::CompareArgs),
    Geometry(geometry::GeometryArgs),
    Predict(predict::PredictArgs),
    Check(check::CheckArgs),
    Bench(bench::BenchArgs),
    Sky(sky::SkyArgs),
}

/// A pipeline and what is laid over it.
#[derive(Debug, Args)]
struct PipelineArgs {
    /// Pipeline file (TOML); the embedded quicklook if none is named.
    #[arg(value_name = "PIPELINE.toml")]
    pipeline: Option<PathBuf>,
    /// Seed of everything random in the space segment, in place of the file's.
    #[arg(long)]
    seed: Option<u64>,
    /// Replace one setting, for example --set map.nside=32; may be given again.
    #[arg(long = "set", value_name = "KEY=VALUE")]
    overrides: Vec<String>,
    /// Format of the downlink, in place of the file's: space packets as they are, or in coded transfer frames.
    #[arg(long, value_name = "packets|cadu")]
    format: Option<String>,
}

/// An array, for commands that need no more of a pipeline.
#[derive(Debug, Args)]
struct ArrayArgs {
    /// Pipeline file (TOML) whose array is meant; the paper's fiducial array if none is named.
    #[arg(long, value_name = "PIPELINE.toml")]
    pipeline: Option<PathBuf>,
    /// Replace one setting, for example --set array.inclination_deg=60; may be given again.
    #[arg(long = "set", value_name = "KEY=VALUE")]
    overrides: Vec<String>,
}

impl ArrayArgs {
    fn source(&self) -> ConfigSource {
        ConfigSource { file: self.pipeline.clone(), overrides: self.overrides.clone(), seed: None }
    }
}

impl PipelineArgs {
    fn source(&self) -> ConfigSource {
        let Self { pipeline, seed, overrides, format } = self;
        let format = format.iter().map(|format| format!("downlink.format={format:?}"));
        let overrides = overrides.iter().cloned().chain(format).collect();
        ConfigSource { file: pipeline.clone(), overrides, seed: *seed }
    }
}

/// Runs the command that the process was given; the process's exit code.
///
/// 0: done. 1: failed, with the reason on standard error. 2: wrong usage. 130: ended early by Ctrl-C,
/// leaving valid products of the data so far.
#[must_use]
pub fn main() -> ExitCode {
    let result = match Cli::parse().command {
        Command::Run(args) => run::execute(&args),
        Command::Simulate(args) => simulate::execute(&args),
        Command::Replay(args) => replay::execute(&args),
        Command::Inspect(args) => inspect::execute(&args),
        Command::Corrupt(args) => corrupt::execute(&args),
        Command::Gaps(args) => gaps::execute(&args),
        Command::Merge(args) => merge::execute(&args),
        Command::Retract(args) => retract::execute(&args),
        Command::Compare(args) => compare::execute(&args),
        Command::Geometry(args) => geometry::execute(&args),
        Command::Predict(args) => predict::execute(&args),
        Command::Check(args) => check::execute(&args),
        Command::Bench(args) => bench::execute(&args),
        Command::Sky(args) => sky::execute(&args),
    };
    match result {
        Ok(Outcome::Done) => ExitCode::SUCCESS,
        Ok(Outcome::Interrupted) => ExitCode::from(130),
        Err(error) if is_broken_pipe(error.as_ref()) => ExitCode::SUCCESS,
        Err(error) => {
            report(error.as_ref());
            ExitCode::FAILURE
        }
    }
}

/// The reader of our output has had enough, as `head` has: not a failure.
fn is_broken_pipe(error: &(dyn std::error::Error + 'static)) -> bool {
    error.downcast_ref::<std::io::Error>().is_some_and(|error| error.kind() == std::io::ErrorKind::BrokenPipe)
}

/// Prints an error and its causes, leaving out causes that the message already tells.
fn report(error: &(dyn std::error::Error + 'static)) {
    let mut said = error.to_string();
    eprintln!("error: {said}");
    let mut cause = error.source();
    while let Some(error) = cause {
        let text = error.to_string();
        if !said.contains(&text) {
            eprintln!("  because: {text}");
        }
        said = text;
        cause = error.source();
    }
}

/// Seconds from a time such as `7d`, `12h`, `90s` or `90`, within 30 years.
fn time_s(text: &str) -> Result<f64, String> {
    let text = text.trim();
    let (number, unit_s) = match text.strip_suffix(['s', 'h', 'd']) {
        Some(number) if text.ends_with('d') => (number, DAY_S),
        Some(number) if text.ends_with('h') => (number, 3600.0),
        Some(number) => (number, 1.0),
        None => (text, 1.0),
    };
    match number.trim().parse::<f64>() {
        Ok(value) if (value * unit_s).abs() <= 1e9 => Ok(value * unit_s),
        _ => Err("expected a number with s, h or d, such as 90s or 7d, at most 1e9 s".into()),
    }
}

/// As [`time_s`], not negative.
fn not_negative_s(text: &str) -> Result<f64, String> {
    match time_s(text)? {
        value if value >= 0.0 => Ok(value),
        _ => Err("expected a time that is not negative".into()),
    }
}

/// Says what is odd about a pipeline that can run as it is.
fn tell_notes(config: &Config) {
    for note in config.notes() {
        eprintln!("note: {note}");
    }
}

/// Prints one JSON object on a line of its own.
fn print_json_line(value: &impl serde::Serialize) -> Result<(), CommandError> {
    let mut out = std::io::stdout().lock();
    serde_json::to_writer(&mut out, value).map_err(|error| match error.io_error_kind() {
        Some(kind) => Box::new(std::io::Error::from(kind)) as CommandError,
        None => Box::new(error),
    })?;
    out.write_all(b"\n")?;
    Ok(())
}

/// Prints text for people.
fn print_text(text: &str) -> Result<(), CommandError> {
    let mut out = std::io::stdout().lock();
    out.write_all(text.as_bytes())?;
    out.write_all(b"\n")?;
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn times_have_units() {
        for (text, expected_s) in
            [("7d", 604_800.0), ("1.5 h", 5400.0), ("90s", 90.0), ("90", 90.0), ("0", 0.0)]
        {
            assert_eq!((time_s(text), not_negative_s(text)), (Ok(expected_s), Ok(expected_s)));
        }
        assert_eq!(time_s("-1d"), Ok(-86_400.0));
        assert!(not_negative_s("-1d").is_err());
        for text in ["", "d", "infd", "7w", "NaN", "1e9d"] {
            assert!(time_s(text).is_err() && not_negative_s(text).is_err(), "{text}");
        }
    }
}
