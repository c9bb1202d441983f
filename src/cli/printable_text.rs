//! Text without characters that a terminal would obey.

use crate::units::printable;

/// A JSON object whose strings hold no character that a terminal would obey. JSON itself allows some of them.
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

/// Text for a terminal, with its line breaks: names and replies of others in it are shown, not obeyed.
pub(super) fn printable_text(text: &str) -> String {
    text.split('\n').map(printable).collect::<Vec<_>>().join("\n")
}
