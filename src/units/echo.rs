//! Values as messages repeat them.

use std::fmt::Display;

/// Longest number that is repeated digit by digit: as long as one with all digits of a float.
const NUMBER_CHARS: usize = 24;
/// Longest value that is repeated whole, characters.
const VALUE_CHARS: usize = 80;

/// A value as a message repeats it, whatever its length: a long number in scientific notation, of other long values the
/// beginning.
#[must_use]
pub fn echo(value: impl Display) -> String {
    let text = value.to_string();
    match text.parse::<f64>() {
        Ok(number) if number.is_finite() && text.len() > NUMBER_CHARS => format!("{number:e}"),
        _ => shortened(&text, VALUE_CHARS),
    }
}

/// The first `most` characters of a text that is longer, and its length.
#[must_use]
pub fn shortened(text: &str, most: usize) -> String {
    match text.char_indices().nth(most) {
        None => text.to_owned(),
        Some((end, _)) => format!("{}... ({} bytes)", &text[..end], text.len()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_long_is_cut() {
        for (number, expected) in [(1e300, "1e300"), (-2.5e-200, "-2.5e-200"), (0.1, "0.1"), (1e6, "1000000")]
        {
            assert_eq!(echo(number), expected);
        }
        assert_eq!(echo(f64::NAN), "NaN");
        assert_eq!(echo("x".repeat(VALUE_CHARS)), "x".repeat(VALUE_CHARS));
        let cut = echo("\u{e4}".repeat(10_000_000));
        assert_eq!(cut, format!("{}... (20000000 bytes)", "\u{e4}".repeat(VALUE_CHARS)));
        // More than a float holds.
        assert_eq!(echo("9".repeat(400)), format!("{}... (400 bytes)", "9".repeat(VALUE_CHARS)));
    }
}
