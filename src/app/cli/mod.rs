//! The command line: one file per command, and shared files (`arguments`, `interrupt`, `output`, `progress`, `serving`).
//!
//! A command parses its arguments, calls [`crate::pipeline`] or another library function, and prints the result for people or, with
//! `--json`, for programs. It contains no physics. May use every other folder.

mod arguments;
mod bench;
mod bound;
mod bursts;
mod calibrate;
mod check;
mod compare;
mod corrupt;
mod cutout;
mod design;
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
mod proposal;
mod rebuild;
mod recalibrate;
mod replay;
mod retract;
mod run;
mod sample;
mod send;
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
mod zoom;

use std::ffi::OsString;
use std::process::ExitCode;

use clap::{CommandFactory, Parser, Subcommand};
use serde_json::Value;

use log::{Level, LogFormat};
use output::{Completion, WrongUsage, is_broken_pipe, print_error};

use crate::downlink::DownlinkError;
use crate::downlink::transport::socket::SocketError;
use crate::ground::GroundError;
use crate::pipeline::{ConfigError, PipelineError};
use crate::units::InvalidValue;

/// Simulate a lunar-orbit radio interferometer, and map the sky from its downlink.
///
/// Below 30 MHz the ionosphere hides the sky. Eight small satellites in lunar orbit observe it while the Moon hides the
/// Earth; a mother satellite correlates their signals, and sends visibilities down when the Earth is in sight again. lunarray
/// simulates the satellites, receives their downlink, and makes maps of the whole sky.
///
/// Start with `lunarray run`: it needs no input file and writes maps to out/quicklook/.
///
/// The file name - means standard input for a pipeline or a downlink: cat pass.cadu | lunarray inspect -
///
/// Exit codes: 0 done; 1 failed; 2 wrong usage or an unusable configuration; 3 a failure of the system (disk, socket, lock,
/// memory), after which the same command may succeed; 130 ended by Ctrl-C, 143 by SIGTERM, 129 by SIGHUP, after
/// data received were saved if there is a state. SIGTERM is the regular end of `replay --listen` and `--follow`: 0.
#[derive(Debug, Parser)]
#[command(name = "lunarray", version, propagate_version = true, max_term_width = 100)]
struct Cli {
    /// Format of messages on standard error: text, or json: one object per line with time (UTC), level, event, message and fields.
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
    Send(send::SendArgs),
    Gaps(gaps::GapsArgs),
    Merge(merge::MergeArgs),
    Rebuild(rebuild::RebuildArgs),
    Recalibrate(recalibrate::RecalibrateArgs),
    Retract(retract::RetractArgs),
    Sample(sample::SampleArgs),
    Joint(joint::JointArgs),
    Zoom(zoom::ZoomArgs),
    Compare(compare::CompareArgs),
    Geometry(geometry::GeometryArgs),
    Figure(figure::FigureArgs),
    Cutout(cutout::CutoutArgs),
    Calibrate(calibrate::CalibrateArgs),
    Bound(bound::BoundArgs),
    Bursts(bursts::BurstsArgs),
    Predict(predict::PredictArgs),
    Check(check::CheckArgs),
    Bench(bench::BenchArgs),
    Sky(sky::SkyArgs),
    Study(study::StudyArgs),
    Design(design::DesignArgs),
    Proposal(proposal::ProposalArgs),
    Explain(explain::ExplainArgs),
    Config(explain::ConfigArgs),
    Completions(shell::CompletionsArgs),
    Man(shell::ManArgs),
}

/// Whether an invalid command line requests messages as JSON.
fn asks_for_json(words: &[OsString]) -> bool {
    let is_option = |pair: &[OsString]| pair[0] == "--log" && pair[1] == "json";
    words.windows(2).any(is_option) || words.iter().any(|word| word == "--log=json")
}

/// Exit code of a failure of the data, or of any other failure.
const FAILED: u8 = 1;

/// Exit code of wrong usage or an unusable configuration: a restart would fail again.
const MISCONFIGURED: u8 = 2;

/// Exit code of a failure of the system: a disk, a socket, a lock, memory.
const SYSTEM: u8 = 3;

fn exit_code(error: &(dyn std::error::Error + 'static)) -> u8 {
    let causes = || std::iter::successors(Some(error), |error| error.source());
    if causes().any(is_configuration_error) {
        return MISCONFIGURED;
    }
    match causes().any(is_system_error) {
        true => SYSTEM,
        false => FAILED,
    }
}

fn is_configuration_error(error: &(dyn std::error::Error + 'static)) -> bool {
    let is_ground_configuration = |error: &GroundError| {
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
    let is_socket_configuration = |error: &SocketError| {
        use SocketError::{NoTruthFile, Remote, Stations};
        matches!(error, NoTruthFile | Remote { .. } | Stations { .. })
    };
    let is_pipeline_configuration = error.downcast_ref::<PipelineError>().is_some_and(|error| match error {
        PipelineError::Config(_) | PipelineError::Invalid(_) => true,
        PipelineError::Ground(error) => is_ground_configuration(error),
        PipelineError::Downlink(DownlinkError::Socket(error)) => is_socket_configuration(error),
        _ => false,
    });
    // The program's own refusal of a name, as that of an output that is an input.
    let is_refused_name = |error: &std::io::Error| {
        error.kind() == std::io::ErrorKind::InvalidInput && error.raw_os_error().is_none()
    };
    is_pipeline_configuration
        || error.downcast_ref::<std::io::Error>().is_some_and(is_refused_name)
        || error.is::<ConfigError>()
        || error.is::<InvalidValue>()
        || error.is::<WrongUsage>()
        || error.downcast_ref::<SocketError>().is_some_and(is_socket_configuration)
        || error.downcast_ref::<GroundError>().is_some_and(is_ground_configuration)
}

fn is_system_error(error: &(dyn std::error::Error + 'static)) -> bool {
    let is_locked =
        |error: &GroundError| matches!(error, GroundError::Locked { .. } | GroundError::FolderLost { .. });
    let is_pipeline_failure = error.downcast_ref::<PipelineError>().is_some_and(|error| match error {
        PipelineError::Unsaved { .. } | PipelineError::Memory { .. } => true,
        PipelineError::Ground(error) => is_locked(error),
        _ => false,
    });
    // A missing or invalid file is not a failure of the system.
    let is_system_failure = |error: &std::io::Error| {
        use std::io::ErrorKind::{InvalidData, NotFound, UnexpectedEof};
        ![InvalidData, NotFound, UnexpectedEof].contains(&error.kind())
    };
    is_pipeline_failure
        || error.downcast_ref::<std::io::Error>().is_some_and(is_system_failure)
        || error.downcast_ref::<GroundError>().is_some_and(is_locked)
}

/// Runs the command on the process's command line and returns the exit code.
///
/// 0: done, also if the reader of standard output has gone. 1: failed, with the reason on standard error. 2: wrong usage, or an
/// unusable configuration. 3: a failure of the system: a disk, a socket, a lock, memory. 128 plus the number of a signal:
/// interrupted, by Ctrl-C (130), SIGTERM (143) or SIGHUP (129); a second one, at least 0.2 s later, ends the process at once.
/// SIGTERM is the regular end of a ground segment that listens or follows: 0.
#[must_use]
pub fn main() -> ExitCode {
    #[cfg(unix)]
    interrupt::remove_files_on_signal();
    ExitCode::from(run_command(std::env::args_os()))
}

/// Runs a command line, whose first word is the program's name, and returns the exit code; see [`main`].
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
            // Help and version are errors of clap, too. A failure to print them is ignored.
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
        Command::Send(args) => send::execute(&args),
        Command::Gaps(args) => gaps::execute(&args),
        Command::Merge(args) => merge::execute(&args),
        Command::Rebuild(args) => rebuild::execute(&args),
        Command::Recalibrate(args) => recalibrate::execute(&args),
        Command::Retract(args) => retract::execute(&args),
        Command::Sample(args) => sample::execute(&args),
        Command::Joint(args) => joint::execute(&args),
        Command::Zoom(args) => zoom::execute(&args),
        Command::Compare(args) => compare::execute(&args),
        Command::Geometry(args) => geometry::execute(&args),
        Command::Figure(args) => figure::execute(&args),
        Command::Cutout(args) => cutout::execute(&args),
        Command::Calibrate(args) => calibrate::execute(&args),
        Command::Bound(args) => bound::execute(&args),
        Command::Bursts(args) => bursts::execute(&args),
        Command::Predict(args) => predict::execute(&args),
        Command::Check(args) => check::execute(&args),
        Command::Bench(args) => bench::execute(&args),
        Command::Sky(args) => sky::execute(&args),
        Command::Study(args) => study::execute(&args),
        Command::Design(args) => design::execute(&args),
        Command::Proposal(args) => proposal::execute(&args),
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
