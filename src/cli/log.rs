//! The log: what commands say on standard error, as text for people or as one JSON object a line for programs.
//!
//! Standard error is one for the process, and so is the form in which it is written.

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

/// Form of the log.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, ValueEnum)]
pub(super) enum LogFormat {
    /// Lines for people.
    #[default]
    Text,
    /// One JSON object a line: time (UTC), level, event, message and fields.
    Json,
}

/// Whether the log is JSON.
static IS_JSON: AtomicBool = AtomicBool::new(false);

/// Lets panics be lines of the log.
static HOOK: Once = Once::new();

/// How much a message matters.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub(super) enum Level {
    /// All is well.
    Info,
    /// It should be looked at.
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

/// From now on the log has this form.
pub(super) fn use_format(format: LogFormat) {
    IS_JSON.store(format == LogFormat::Json, Ordering::Relaxed);
    if format == LogFormat::Json {
        // A panic is a line like others.
        HOOK.call_once(|| {
            let as_text = std::panic::take_hook();
            std::panic::set_hook(Box::new(move |panic| match is_json() {
                true => log_json(Level::Error, "panic", &Value::Null, Some(&panic.to_string())),
                false => as_text(panic),
            }));
        });
    }
}

/// Whether the log is for programs.
pub(super) fn is_json() -> bool {
    IS_JSON.load(Ordering::Relaxed)
}

/// Says what happens: as text the message, as JSON the event with its fields as well.
pub(super) fn say(event: &str, fields: &Value, message: impl Display) {
    match is_json() {
        true => log_json(Level::Info, event, fields, Some(&message.to_string())),
        false => print_line(message),
    }
}

/// As [`say`], of an event that names itself in its field `event`, as those of `--events` do.
pub(super) fn say_entry(level: Level, entry: &impl Serialize, message: Option<&str>) {
    // What can be written as a line can be written as a value.
    let mut fields = serde_json::to_value(entry).unwrap_or_default();
    let event = fields.as_object_mut().and_then(|fields| fields.remove("event"));
    let event = event.as_ref().and_then(Value::as_str).unwrap_or_default();
    log_json(level, event, &fields, message);
}

/// Notes what should be looked at.
pub(super) fn note(event: &str, fields: &Value, message: impl Display) {
    match is_json() {
        true => log_json(Level::Warn, event, fields, Some(&message.to_string())),
        false => print_line(format_args!("note: {}", printable_text(&message.to_string()))),
    }
}

/// Writes a line as JSON.
pub(super) fn log_json(level: Level, event: &str, fields: &Value, message: Option<&str>) {
    let message = message.map(|message| message.trim().to_owned());
    let time = format!("{}Z", utc_text(SystemTime::now()));
    if let Ok(text) = json_text(&LogLine { time, level, event, message, fields }) {
        print_line(text);
    }
}

/// A time as a date, UTC to the millisecond; that of 1970 for times before, as of a clock that was never set.
pub(super) fn utc_text(time: SystemTime) -> String {
    let unix_s = time.duration_since(UNIX_EPOCH).map_or(0.0, |since| since.as_secs_f64());
    tai_text(unix_s + TAI_1970_S)
}

/// Prints a line to standard error. If that is not possible, there is nobody to tell.
pub(super) fn print_line(line: impl Display) {
    // In one piece, so that lines of several threads stay apart.
    let _ = std::io::stderr().lock().write_all(format!("{line}\n").as_bytes());
}
