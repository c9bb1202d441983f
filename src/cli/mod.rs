//! The command line: one file per command, plus what commands share (`arguments`, `interrupt`, `output`, `progress`, `serving`).
//!
//! A command parses its arguments, calls [`crate::pipeline`] (or another library function) and prints the result for
//! people or, with `--json`, for programs. It holds no physics and no state of its own. May use every other folder.

mod arguments;
mod bench;
mod bound;
mod calibrate;
mod check;
mod compare;
mod corrupt;
mod cutout;
#[cfg(all(test, feature = "serve"))]
#[allow(clippy::unwrap_used, clippy::panic)] // A test fails by panicking.
mod documented;
mod events;
mod explain;
mod export;
mod extract;
mod figure;
mod gaps;
mod geometry;
mod inspect;
mod interrupt;
mod job;
mod joint;
mod lines;
mod log;
mod merge;
#[cfg(unix)]
mod notify;
mod output;
mod predict;
mod printable_text;
mod progress;
mod rebuild;
mod recalibrate;
mod replay;
mod retract;
mod run;
mod sample;
#[cfg(not(feature = "serve"))]
#[path = "not_serving.rs"]
mod serving;
#[cfg(feature = "serve")]
mod serving;
mod shell;
mod simulate;
mod sky;
mod study;
#[cfg(feature = "serve")]
mod top;

use std::ffi::OsString;
use std::process::ExitCode;

use clap::{CommandFactory, Parser, Subcommand};
use serde_json::Value;

use log::{Level, LogFormat};
use output::{Completion, is_broken_pipe, print_error};

use crate::ground::GroundError;
use crate::pipeline::{ConfigError, PipelineError};
use crate::units::InvalidValue;

/// Simulate a lunar-orbit radio interferometer, and map the sky from its downlink.
///
/// Below 30 MHz the ionosphere hides the sky. Eight small satellites in lunar orbit correlate their signals while the
/// Moon hides the Earth, and send visibilities down when the Earth is in sight again. lunarray simulates the satellites,
/// receives their downlink, and makes maps of the whole sky.
///
/// Start with `lunarray run`: it needs no input file and writes maps to out/quicklook/.
///
/// A file of - is standard input where a pipeline or a downlink is read: cat pass.cadu | lunarray inspect -
///
/// Exit codes: 0 done; 1 failed; 2 wrong usage; 130 ended by Ctrl-C, 143 by SIGTERM, 129 by SIGHUP, with what was
/// received saved if there is a state. 0 also for `replay --listen` and `--follow` that SIGTERM ends.
#[derive(Debug, Parser)]
#[command(name = "lunarray", version, propagate_version = true, max_term_width = 100)]
struct Cli {
    /// Format of messages on standard error: text, or json: one object a line with time (UTC), level, event, message and fields.
    #[arg(
        long,
        global = true,
        value_enum,
        value_name = "text|json",
        default_value_t,
        hide_possible_values = true
    )]
    log: LogFormat,
    #[command(subcommand)]
    command: Command,
}

#[derive(Debug, Subcommand)]
enum Command {
    Run(run::RunArgs),
    Simulate(simulate::SimulateArgs),
    Replay(replay::ReplayArgs),
    #[cfg(feature = "serve")]
    Top(top::TopArgs),
    Inspect(inspect::InspectArgs),
    Corrupt(corrupt::CorruptArgs),
    Export(export::ExportArgs),
    Extract(extract::ExtractArgs),
    Gaps(gaps::GapsArgs),
    Merge(merge::MergeArgs),
    Rebuild(rebuild::RebuildArgs),
    Recalibrate(recalibrate::RecalibrateArgs),
    Retract(retract::RetractArgs),
    Sample(sample::SampleArgs),
    Joint(joint::JointArgs),
    Compare(compare::CompareArgs),
    Geometry(geometry::GeometryArgs),
    Figure(figure::FigureArgs),
    Cutout(cutout::CutoutArgs),
    Calibrate(calibrate::CalibrateArgs),
    Bound(bound::BoundArgs),
    Predict(predict::PredictArgs),
    Check(check::CheckArgs),
    Bench(bench::BenchArgs),
    Sky(sky::SkyArgs),
    Study(study::StudyArgs),
    Explain(explain::ExplainArgs),
    Config(explain::ConfigArgs),
    Completions(shell::CompletionsArgs),
    Man(shell::ManArgs),
}

/// Whether words that are no command line ask for messages as JSON.
fn asks_for_json(words: &[OsString]) -> bool {
    let is_option = |pair: &[OsString]| pair[0] == "--log" && pair[1] == "json";
    words.windows(2).any(is_option) || words.iter().any(|word| word == "--log=json")
}

/// Exit code of a failure: of the data, or any other.
const FAILED: u8 = 1;

/// Exit code of a configuration that cannot be used, as of wrong usage: to start again is of no use.
const MISCONFIGURED: u8 = 2;

/// Exit code of what the system refused: a disk, a socket, a lock, memory.
const SYSTEM: u8 = 3;

/// The code that says of which sort a failure is.
fn exit_code(error: &(dyn std::error::Error + 'static)) -> u8 {
    let causes = || std::iter::successors(Some(error), |error| error.source());
    if causes().any(is_configuration) {
        return MISCONFIGURED;
    }
    match causes().any(is_of_system) {
        true => SYSTEM,
        false => FAILED,
    }
}

fn is_configuration(error: &(dyn std::error::Error + 'static)) -> bool {
    let is_of_ground = |error: &GroundError| {
        use GroundError::{FilesOfState, GivenTwice, MergeIntoPart, Occupied, Settings};
        matches!(
            error,
            Settings { .. }
                | FilesOfState { .. }
                | Occupied { .. }
                | GivenTwice { .. }
                | MergeIntoPart { .. }
        )
    };
    let of_pipeline = error.downcast_ref::<PipelineError>().is_some_and(|error| match error {
        PipelineError::Config(_) | PipelineError::Invalid(_) => true,
        PipelineError::Ground(error) => is_of_ground(error),
        _ => false,
    });
    of_pipeline
        || error.is::<ConfigError>()
        || error.is::<InvalidValue>()
        || error.downcast_ref::<GroundError>().is_some_and(is_of_ground)
}

fn is_of_system(error: &(dyn std::error::Error + 'static)) -> bool {
    let is_locked =
        |error: &GroundError| matches!(error, GroundError::Locked { .. } | GroundError::FolderLost { .. });
    let of_pipeline = error.downcast_ref::<PipelineError>().is_some_and(|error| match error {
        PipelineError::Unsaved { .. } | PipelineError::Memory { .. } => true,
        PipelineError::Ground(error) => is_locked(error),
        _ => false,
    });
    // A file that is not there, or is not what it should be, is not the system's fault.
    let is_of_system = |error: &std::io::Error| {
        use std::io::ErrorKind::{InvalidData, NotFound, UnexpectedEof};
        ![InvalidData, NotFound, UnexpectedEof].contains(&error.kind())
    };
    of_pipeline
        || error.downcast_ref::<std::io::Error>().is_some_and(is_of_system)
        || error.downcast_ref::<GroundError>().is_some_and(is_locked)
}

/// Runs the command on the process's command line and returns the exit code.
///
/// 0: done, also if the reader of standard output has gone. 1: failed, with the reason on standard error. 2: wrong usage, or a
/// configuration that cannot be used. 3: the system refused: a disk, a socket, a lock, memory.
/// 128 and the number of the signal: ended early, by Ctrl-C with 130, by SIGTERM with 143, by SIGHUP with 129; a second
/// signal ends the process at once with the same code. For a ground that listens or follows, SIGTERM is the regular end: 0.
#[must_use]
pub fn main() -> ExitCode {
    ExitCode::from(run_command(std::env::args_os()))
}

/// As [`main`], for a command line of which the first word is the program's name; returns the exit code.
pub fn run_command(words: impl IntoIterator<Item = OsString>) -> u8 {
    let words: Vec<OsString> = words.into_iter().collect();
    log::use_format(LogFormat::Text);
    crate::array::report_propagation_to(progress::say_propagation);
    let command = match Cli::try_parse_from(&words) {
        Ok(Cli { log, command }) => {
            log::use_format(log);
            command
        }
        Err(error) => {
            // Help and version are such errors too. Nobody may be there to read it.
            match error.use_stderr() && asks_for_json(&words) {
                true => log::log_json(Level::Error, "usage", &Value::Null, Some(&error.to_string())),
                false => drop(error.print()),
            }
            return u8::try_from(error.exit_code()).unwrap_or(FAILED);
        }
    };
    let result = match command {
        Command::Run(args) => run::execute(&args),
        Command::Simulate(args) => simulate::execute(&args),
        Command::Replay(args) => replay::execute(&args),
        #[cfg(feature = "serve")]
        Command::Top(args) => top::execute(&args),
        Command::Inspect(args) => inspect::execute(&args),
        Command::Corrupt(args) => corrupt::execute(&args),
        Command::Export(args) => export::execute(&args),
        Command::Extract(args) => extract::execute(&args),
        Command::Gaps(args) => gaps::execute(&args),
        Command::Merge(args) => merge::execute(&args),
        Command::Rebuild(args) => rebuild::execute(&args),
        Command::Recalibrate(args) => recalibrate::execute(&args),
        Command::Retract(args) => retract::execute(&args),
        Command::Sample(args) => sample::execute(&args),
        Command::Joint(args) => joint::execute(&args),
        Command::Compare(args) => compare::execute(&args),
        Command::Geometry(args) => geometry::execute(&args),
        Command::Figure(args) => figure::execute(&args),
        Command::Cutout(args) => cutout::execute(&args),
        Command::Calibrate(args) => calibrate::execute(&args),
        Command::Bound(args) => bound::execute(&args),
        Command::Predict(args) => predict::execute(&args),
        Command::Check(args) => check::execute(&args),
        Command::Bench(args) => bench::execute(&args),
        Command::Sky(args) => sky::execute(&args),
        Command::Study(args) => study::execute(&args),
        Command::Explain(args) => explain::explain(&args),
        Command::Config(args) => explain::config(&args),
        Command::Completions(args) => shell::completions(&args, Cli::command()),
        Command::Man(args) => shell::man(&args, Cli::command()),
    };
    match result {
        Ok(Completion::Done) => 0,
        Ok(Completion::Interrupted(code)) => code,
        Err(error) if is_broken_pipe(error.as_ref()) => 0,
        Err(error) => {
            print_error(error.as_ref());
            exit_code(error.as_ref())
        }
    }
}
