//! Text without control characters for terminals.

use crate::units::printable;

/// Serialises a value to JSON, and escapes control characters that JSON permits but a terminal would interpret.
pub(super) fn json_text(value: &impl serde::Serialize) -> Result<String, serde_json::Error> {
    let text = serde_json::to_string(value)?;
    let escaped = |c: char| match printable(c.encode_utf8(&mut [0; 4])) {
        std::borrow::Cow::Borrowed(_) => c.to_string(),
        std::borrow::Cow::Owned(_) => format!("\\u{:04x}", u32::from(c)),
    };
    match printable(&text) {
        std::borrow::Cow::Borrowed(_) => Ok(text),
        std::borrow::Cow::Owned(_) => Ok(text.chars().map(escaped).collect()),
    }
}

/// Escapes control characters, except line breaks: the text may contain foreign names and replies.
pub(super) fn printable_text(text: &str) -> String {
    text.split('\n').map(printable).collect::<Vec<_>>().join("\n")
}
