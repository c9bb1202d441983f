//! Values as messages repeat them.

use std::fmt::Display;

/// Longest number that is repeated digit by digit: as long as one with all digits of a float.
const NUMBER_CHARS: usize = 24;
/// Longest value that is repeated whole, characters.
const VALUE_CHARS: usize = 160;
/// Longest line that is repeated whole, characters: room for the names of all keys of a section.
const LINE_CHARS: usize = 1600;
/// Characters that are repeated of what is longer.
const BEGINNING_CHARS: usize = 60;

/// A value as a message repeats it, whatever its length: a long number in scientific notation, of other long values the
/// beginning.
#[must_use]
pub fn echo(value: impl Display) -> String {
    let text = value.to_string();
    match text.parse::<f64>() {
        Ok(number) if number.is_finite() && text.len() > NUMBER_CHARS => format!("{number:e}"),
        _ => beginning(&text, VALUE_CHARS),
    }
}

/// A message of several lines that may repeat what it is about, with the beginning of lines that are long.
#[must_use]
pub fn echo_lines(text: impl Display) -> String {
    let lines: Vec<String> =
        text.to_string().lines().map(|line| beginning(line.trim_end(), LINE_CHARS)).collect();
    lines.join("\n")
}

fn beginning(text: &str, chars_max: usize) -> String {
    // The number of bytes is at least that of characters.
    if text.len() <= chars_max || text.chars().nth(chars_max).is_none() {
        return text.to_owned();
    }
    let beginning: String = text.chars().take(BEGINNING_CHARS).collect();
    format!("{beginning}... ({} characters)", text.chars().count())
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
        assert_eq!(cut, format!("{}... (10000000 characters)", "\u{e4}".repeat(BEGINNING_CHARS)));
        // More than a float holds.
        assert_eq!(echo("9".repeat(400)), format!("{}... (400 characters)", "9".repeat(BEGINNING_CHARS)));
        let lines = format!("one\n{}\nthree", "1".repeat(2000));
        assert_eq!(
            echo_lines(lines),
            format!("one\n{}... (2000 characters)\nthree", "1".repeat(BEGINNING_CHARS))
        );
    }
}
