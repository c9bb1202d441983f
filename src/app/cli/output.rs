//! Output and completion of commands.

use std::io::Write;
use std::path::{Path, PathBuf};

use serde_json::{Value, json};

use super::log::{self, Level};
pub(super) use super::printable_text::{json_text, printable_text};
use crate::pipeline::{Config, RunSummary};

/// Error of a command; its message says where it occurred and what was expected.
pub(super) type CommandError = Box<dyn std::error::Error + Send + Sync>;
pub(super) type CommandResult = Result<Completion, CommandError>;

/// Completion of a command that did not fail.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Completion {
    Done,
    /// A signal interrupted the command; its output is valid. Contains the exit code.
    Interrupted(u8),
}

impl Completion {
    /// Ends a command after it has `printed` its result. A closed standard output is not a failure.
    pub(super) fn after(self, printed: Result<(), CommandError>) -> CommandResult {
        match printed {
            Err(error) if !is_broken_pipe(error.as_ref()) => Err(error),
            _ => Ok(self),
        }
    }
}

/// Wrong usage that the parser of the command line does not see; exit code 2.
#[derive(Debug, thiserror::Error)]
#[error("{0}")]
pub(super) struct WrongUsage(pub(super) String);

/// Makes the error of a file that cannot be written. It keeps the system's error, which decides the exit code.
pub(super) fn cannot_write(path: &Path) -> impl FnOnce(std::io::Error) -> CommandError {
    move |source| WriteError { path: path.to_owned(), source }.into()
}

/// A file that cannot be written.
#[derive(Debug, thiserror::Error)]
#[error("cannot write {}: {source}", path.display())]
struct WriteError {
    path: PathBuf,
    source: std::io::Error,
}

/// Whether the reader of standard output has closed it, as `head` does.
pub(super) fn is_broken_pipe(error: &(dyn std::error::Error + 'static)) -> bool {
    error.downcast_ref::<std::io::Error>().is_some_and(|error| error.kind() == std::io::ErrorKind::BrokenPipe)
}

/// Prints one JSON object on a line of its own.
pub(super) fn print_json_line(value: &impl serde::Serialize) -> Result<(), CommandError> {
    print(&json_text(value)?)
}

pub(super) fn print_text(text: &str) -> Result<(), CommandError> {
    print(&printable_text(text))
}

/// Prints text and a line feed, without escaping.
fn print(text: &str) -> Result<(), CommandError> {
    let mut out = std::io::stdout().lock();
    let printed = out.write_all(text.as_bytes()).and_then(|()| out.write_all(b"\n"));
    printed.map_err(stdout_error)
}

/// Adds the name of standard output to an error, unless the reader has closed it.
pub(super) fn stdout_error(error: std::io::Error) -> CommandError {
    match error.kind() {
        std::io::ErrorKind::BrokenPipe => error.into(),
        _ => format!("standard output: cannot write: {error}").into(),
    }
}

pub(super) fn print_notes<T: std::fmt::Display>(notes: impl IntoIterator<Item = T>) {
    for note in notes {
        log::note("note", &Value::Null, note);
    }
}

/// Prints notes about a configuration that is valid but unusual.
pub(super) fn print_config_notes(config: &Config) {
    print_notes(config.notes());
}

/// Warns if more data may be missing than the ledger shows.
pub(super) fn print_incompleteness(summary: &RunSummary) {
    if !summary.completeness.complete {
        let fields = serde_json::to_value(&summary.completeness).unwrap_or_default();
        log::note("incomplete", &fields, format_args!("the ledger is {}", summary.completeness));
    }
}

/// Prints an error and its causes; causes that the message already quotes are left out.
pub(super) fn print_error(error: &(dyn std::error::Error + 'static)) {
    let message = error.to_string();
    let (mut outer, mut causes, mut cause) = (message.clone(), Vec::new(), error.source());
    while let Some(error) = cause {
        let text = error.to_string();
        if !outer.contains(&text) {
            causes.push(text.clone());
        }
        outer = text;
        cause = error.source();
    }
    if log::is_json() {
        return log::log_json(Level::Error, "error", &json!({ "causes": causes }), Some(&message));
    }
    log::print_line(format_args!("error: {}", printable_text(&message)));
    for cause in causes {
        log::print_line(format_args!("  because: {}", printable_text(&cause)));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn no_control_character_reaches_the_terminal() {
        let name = "a\u{1b}[2J\u{9b}31m\u{202e}b";
        assert_eq!(printable_text(&format!("{name}\nnext")), "a\\u{1b}[2J\\u{9b}31m\\u{202e}b\nnext");
        let text = json_text(&[name, "plain \u{e9}"]).unwrap();
        assert!(text.is_ascii() || !text.contains(|c: char| c.is_control() || c == '\u{202e}'), "{text}");
        // The content is unchanged.
        assert_eq!(serde_json::from_str::<Vec<String>>(&text).unwrap(), [name, "plain \u{e9}"]);
    }
}
