//! Values in messages, shortened where they are long.

use std::fmt::Display;

/// Longest number that is repeated digit by digit: enough for all digits of a float.
const NUMBER_CHARS_MAX: usize = 24;
/// Longest value that is repeated in full, characters.
const VALUE_CHARS_MAX: usize = 80;

/// Formats a value for a message: a long number in scientific notation, any other long value shortened.
#[must_use]
pub fn echo(value: impl Display) -> String {
    let text = value.to_string();
    match text.parse::<f64>() {
        Ok(number) if number.is_finite() && text.len() > NUMBER_CHARS_MAX => format!("{number:e}"),
        _ => shortened(&text, VALUE_CHARS_MAX),
    }
}

/// A text of more than `chars_max` characters cut to that many, with its length appended.
#[must_use]
pub fn shortened(text: &str, chars_max: usize) -> String {
    match text.char_indices().nth(chars_max) {
        None => text.to_owned(),
        Some((end, _)) => format!("{}... ({} bytes)", &text[..end], text.len()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn long_values_are_cut() {
        for (number, expected) in [(1e300, "1e300"), (-2.5e-200, "-2.5e-200"), (0.1, "0.1"), (1e6, "1000000")]
        {
            assert_eq!(echo(number), expected);
        }
        assert_eq!(echo(f64::NAN), "NaN");
        assert_eq!(echo("x".repeat(VALUE_CHARS_MAX)), "x".repeat(VALUE_CHARS_MAX));
        let cut = echo("\u{e4}".repeat(10_000_000));
        assert_eq!(cut, format!("{}... (20000000 bytes)", "\u{e4}".repeat(VALUE_CHARS_MAX)));
        // Larger than a float can hold.
        assert_eq!(echo("9".repeat(400)), format!("{}... (400 bytes)", "9".repeat(VALUE_CHARS_MAX)));
    }
}
