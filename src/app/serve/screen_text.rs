//! Reads JSON values and formats numbers for the terminal.

use serde_json::Value;

use crate::units::printable;

/// The elements of a JSON list; none if it is absent.
pub(super) fn list(value: &Value) -> &[Value] {
    value.as_array().map_or(&[], Vec::as_slice)
}

/// A JSON number; 0 if it is absent.
pub(super) fn as_number(value: &Value) -> f64 {
    value.as_f64().unwrap_or(0.0)
}

/// A JSON text without control characters; empty if it is absent.
pub(super) fn as_text(value: &Value) -> String {
    printable(value.as_str().unwrap_or_default()).into_owned()
}

/// Formats a JSON number as an integer with groups of three digits.
pub(super) fn format_integer(value: &Value) -> String {
    group_digits(as_number(value))
}

/// Formats a number as an integer with groups of three digits.
pub(super) fn group_digits(number: f64) -> String {
    let digits = format!("{:.0}", number.abs());
    let mut grouped = String::from(if number < 0.0 { "-" } else { "" });
    for (k, digit) in digits.chars().enumerate() {
        if k > 0 && (digits.len() - k).is_multiple_of(3) {
            grouped.push(',');
        }
        grouped.push(digit);
    }
    grouped
}

/// Formats an integer in at most this many characters, with a prefix such as M if the digits do not fit.
pub(super) fn format_within(number: f64, characters: usize) -> String {
    let all = group_digits(number);
    if all.chars().count() <= characters {
        return all;
    }
    let scales = [(1e15, 'P'), (1e12, 'T'), (1e9, 'G'), (1e6, 'M'), (1e3, 'k')];
    let scaled = scales.into_iter().find(|(size, _)| number.abs() >= *size);
    let Some((size, prefix)) = scaled else { return "#".repeat(characters) };
    let texts = [1, 0].map(|digits| format!("{:.digits$}{prefix}", number / size));
    let fitting = texts.into_iter().find(|text| text.chars().count() <= characters);
    fitting.unwrap_or_else(|| "#".repeat(characters))
}

/// Formats a JSON number with four digits, as the page does; a dash if it is absent.
pub(super) fn format_short(value: &Value) -> String {
    match value.as_f64() {
        None => "\u{2013}".to_owned(),
        Some(0.0) => "0".to_owned(),
        Some(v) if !(1e-2..1e5).contains(&v.abs()) => format!("{v:.3e}"),
        Some(v) => {
            let decimals = (3 - v.abs().log10().floor() as i32).max(0) as usize;
            let text = format!("{v:.decimals$}");
            if text.contains('.') {
                text.trim_end_matches('0').trim_end_matches('.').to_owned()
            } else {
                text
            }
        }
    }
}

/// Formats a rate with a prefix for its unit, such as 2.5 M.
pub(super) fn with_prefix(value: f64) -> String {
    let scales = [(1e9, " G"), (1e6, " M"), (1e3, " k")];
    match scales.into_iter().find(|(size, _)| value >= *size) {
        Some((size, prefix)) => format!("{:.1}{prefix}", value / size),
        None => format!("{value:.0} "),
    }
}

pub(super) fn percent(fraction: f64) -> String {
    format!("{:.0} %", 100.0 * fraction)
}

/// Formats a duration with a unit from microseconds to seconds.
pub(super) fn duration(seconds: f64) -> String {
    match seconds {
        s if s >= 1.0 => format!("{s:.2} s"),
        s if s >= 1e-3 => format!("{:.1} ms", 1e3 * s),
        s => format!("{:.0} \u{b5}s", 1e6 * s),
    }
}

/// Formats a time as minutes and seconds, or hours, minutes and seconds.
pub(super) fn clock(seconds: f64) -> String {
    let s = seconds.max(0.0) as u64;
    match s / 3600 {
        0 => format!("{}:{:02}", s / 60, s % 60),
        hours => format!("{hours}:{:02}:{:02}", s / 60 % 60, s % 60),
    }
}

pub(super) fn bar(fraction: f64, width: usize) -> String {
    let full = (fraction.clamp(0.0, 1.0) * width as f64).round() as usize;
    format!("{}{}", "\u{2588}".repeat(full), "\u{2591}".repeat(width - full))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_are_readable() {
        assert_eq!(
            [0.0, 999.0, 1000.0, 1234567.0, -1234.0].map(group_digits),
            ["0", "999", "1,000", "1,234,567", "-1,234"]
        );
        assert_eq!(
            [0.0, 0.25, 12.5, 20_725.495, 1.5e6, -0.001].map(|v| format_short(&v.into())),
            ["0", "0.25", "12.5", "20725", "1.500e6", "-1.000e-3"]
        );
        assert_eq!([0.0, 61.0, 36_061.0].map(clock), ["0:00", "1:01", "10:01:01"]);
        assert_eq!([2e-6, 0.0025, 3.0].map(duration), ["2 \u{b5}s", "2.5 ms", "3.00 s"]);
        assert_eq!([12.0, 1.5e3, 2e6, 3e9].map(with_prefix), ["12 ", "1.5 k", "2.0 M", "3.0 G"]);
        assert_eq!(
            [-1.0, 0.0, 0.5, 2.0].map(|fraction| bar(fraction, 2)),
            ["\u{2591}\u{2591}", "\u{2591}\u{2591}", "\u{2588}\u{2591}", "\u{2588}\u{2588}"]
        );
    }
}
