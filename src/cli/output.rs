//! What commands print, and how they end.

use std::io::Write;

use crate::pipeline::Config;

/// Why a command failed; the message says where and what was expected.
pub(super) type CommandError = Box<dyn std::error::Error + Send + Sync>;
/// What a command returns.
pub(super) type CommandResult = Result<Completion, CommandError>;

/// How a command ended that did not fail.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Completion {
    /// It did all of its work.
    Done,
    /// A signal ended it early; what it leaves is valid. The code to exit with.
    Interrupted(u8),
}

impl Completion {
    /// Ends a command after it has `printed` its result. That nobody reads it is not a failure.
    pub(super) fn after(self, printed: Result<(), CommandError>) -> CommandResult {
        match printed {
            Err(error) if !is_broken_pipe(error.as_ref()) => Err(error),
            _ => Ok(self),
        }
    }
}

/// Whether the reader of our output has closed it, as `head` does: not a failure.
pub(super) fn is_broken_pipe(error: &(dyn std::error::Error + 'static)) -> bool {
    error.downcast_ref::<std::io::Error>().is_some_and(|error| error.kind() == std::io::ErrorKind::BrokenPipe)
}

/// Prints a line to standard error. If that is not possible, there is nobody to tell.
pub(super) fn say(line: impl std::fmt::Display) {
    // In one piece, so that lines of several threads stay apart.
    let _ = std::io::stderr().lock().write_all(format!("{line}\n").as_bytes());
}

/// Prints one JSON object on a line of its own.
pub(super) fn print_json_line(value: &impl serde::Serialize) -> Result<(), CommandError> {
    let mut out = std::io::stdout().lock();
    serde_json::to_writer(&mut out, value).map_err(|error| match error.io_error_kind() {
        Some(kind) => Box::new(std::io::Error::from(kind)) as CommandError,
        None => Box::new(error),
    })?;
    out.write_all(b"\n")?;
    Ok(())
}

/// Prints text for people.
pub(super) fn print_text(text: &str) -> Result<(), CommandError> {
    let mut out = std::io::stdout().lock();
    out.write_all(text.as_bytes())?;
    out.write_all(b"\n")?;
    Ok(())
}

/// Prints notes to standard error.
pub(super) fn print_notes<T: std::fmt::Display>(notes: impl IntoIterator<Item = T>) {
    for note in notes {
        say(format_args!("note: {note}"));
    }
}

/// Prints notes about a configuration that is valid but unusual.
pub(super) fn print_config_notes(config: &Config) {
    print_notes(config.notes());
}

/// Prints an error and its causes; causes that the message already quotes are left out.
pub(super) fn print_error(error: &(dyn std::error::Error + 'static)) {
    let mut said = error.to_string();
    say(format_args!("error: {said}"));
    let mut cause = error.source();
    while let Some(error) = cause {
        let text = error.to_string();
        if !said.contains(&text) {
            say(format_args!("  because: {text}"));
        }
        said = text;
        cause = error.source();
    }
}
