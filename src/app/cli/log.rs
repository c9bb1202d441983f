//! The log on standard error: text for people, or one JSON object per line for programs. The format is global, as standard error is.

use std::fmt::Display;
use std::io::Write;
use std::sync::Once;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{SystemTime, UNIX_EPOCH};

use clap::ValueEnum;
use serde::Serialize;
use serde_json::Value;

use super::printable_text::{json_text, printable_text};
use crate::units::calendar::{TAI_1970_S, tai_text};

/// Format of the log.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, ValueEnum)]
pub(super) enum LogFormat {
    /// Lines for people.
    #[default]
    Text,
    /// One JSON object per line: time (UTC), level, event, message and fields.
    Json,
}

static IS_JSON: AtomicBool = AtomicBool::new(false);

/// Installs the panic hook once.
static HOOK: Once = Once::new();

/// Severity of a message.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub(super) enum Level {
    /// Information.
    Info,
    /// A problem that needs attention.
    Warn,
    /// The command failed.
    Error,
}

/// A line of the log as JSON.
#[derive(Serialize)]
struct LogLine<'a> {
    time: String,
    level: Level,
    event: &'a str,
    #[serde(skip_serializing_if = "Option::is_none")]
    message: Option<String>,
    #[serde(flatten)]
    fields: &'a Value,
}

pub(super) fn use_format(format: LogFormat) {
    IS_JSON.store(format == LogFormat::Json, Ordering::Relaxed);
    if format == LogFormat::Json {
        // Panics are logged as JSON, too.
        HOOK.call_once(|| {
            let as_text = std::panic::take_hook();
            std::panic::set_hook(Box::new(move |panic| match is_json() {
                true => log_json(Level::Error, "panic", &Value::Null, Some(&panic.to_string())),
                false => as_text(panic),
            }));
        });
    }
}

pub(super) fn is_json() -> bool {
    IS_JSON.load(Ordering::Relaxed)
}

/// Logs information: the message as text, or the event, fields and message as JSON.
pub(super) fn say(event: &str, fields: &Value, message: impl Display) {
    match is_json() {
        true => log_json(Level::Info, event, fields, Some(&message.to_string())),
        false => print_line(message),
    }
}

/// Logs, as JSON, an entry that names its event in the field `event`, as entries of `--events` do.
pub(super) fn say_entry(level: Level, entry: &impl Serialize, message: Option<&str>) {
    let mut fields = serde_json::to_value(entry).unwrap_or_default();
    let event = fields.as_object_mut().and_then(|fields| fields.remove("event"));
    let event = event.as_ref().and_then(Value::as_str).unwrap_or_default();
    log_json(level, event, &fields, message);
}

/// Logs a warning: the message as text, or the event, fields and message as JSON.
pub(super) fn note(event: &str, fields: &Value, message: impl Display) {
    match is_json() {
        true => log_json(Level::Warn, event, fields, Some(&message.to_string())),
        false => print_line(format_args!("note: {}", printable_text(&message.to_string()))),
    }
}

pub(super) fn log_json(level: Level, event: &str, fields: &Value, message: Option<&str>) {
    let message = message.map(|message| message.trim().to_owned());
    let time = format!("{}Z", system_utc_text(SystemTime::now()));
    if let Ok(text) = json_text(&LogLine { time, level, event, message, fields }) {
        print_line(text);
    }
}

/// Formats a time as a date, UTC to the millisecond; times before 1970, as of a clock that was never set, as 1970.
pub(super) fn system_utc_text(time: SystemTime) -> String {
    let unix_s = time.duration_since(UNIX_EPOCH).map_or(0.0, |since| since.as_secs_f64());
    tai_text(unix_s + TAI_1970_S)
}

/// Prints a line to standard error, ignoring errors.
pub(super) fn print_line(line: impl Display) {
    // A single write keeps lines of several threads apart.
    let _ = std::io::stderr().lock().write_all(format!("{line}\n").as_bytes());
}
