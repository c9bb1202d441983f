//! Untrusted text, made safe to print.

use std::borrow::Cow;

/// Escapes what a terminal would interpret in a line: control characters, line breaks, and marks of text direction.
#[must_use]
pub fn printable(line: &str) -> Cow<'_, str> {
    if !line.contains(is_control) {
        return Cow::Borrowed(line);
    }
    let mut shown = String::with_capacity(line.len() + 16);
    for c in line.chars() {
        match is_control(c) {
            true => shown.extend(c.escape_unicode()),
            false => shown.push(c),
        }
    }
    Cow::Owned(shown)
}

/// Whether a terminal interprets a character: ASCII and C1 controls, separators, and marks of text direction.
fn is_control(c: char) -> bool {
    let is_direction =
        matches!(c, '\u{200e}' | '\u{200f}' | '\u{202a}'..='\u{202e}' | '\u{2066}'..='\u{2069}');
    c.is_control() || matches!(c, '\u{2028}' | '\u{2029}') || is_direction
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn control_characters_are_escaped_and_the_rest_is_kept() {
        assert_eq!(printable("H\u{f3}ngm\u{e9}ng 'x' \\ \"y\""), "H\u{f3}ngm\u{e9}ng 'x' \\ \"y\"");
        let bad = "a\u{1b}[2Jb\u{9b}31mc\r\n\td\u{7f}\u{202e}\0";
        let shown = printable(bad);
        assert_eq!(shown, r"a\u{1b}[2Jb\u{9b}31mc\u{d}\u{a}\u{9}d\u{7f}\u{202e}\u{0}");
        assert!(!shown.contains(is_control));
    }
}
