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
    /// Ctrl-C ended it early; what it leaves is valid.
    Interrupted,
}

impl Completion {
    /// `Interrupted` if the run was cancelled.
    pub(super) fn of(cancelled: bool) -> Self {
        if cancelled { Self::Interrupted } else { Self::Done }
    }
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
        eprintln!("note: {note}");
    }
}

/// Prints notes about a configuration that is valid but unusual.
pub(super) fn print_config_notes(config: &Config) {
    print_notes(config.notes());
}

/// Prints an error and its causes; causes that the message already quotes are left out.
pub(super) fn print_error(error: &(dyn std::error::Error + 'static)) {
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
