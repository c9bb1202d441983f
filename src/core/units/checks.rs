//! Checks of configuration values, which collect all invalid values of a section.

use std::borrow::Cow;
use std::fmt;

use thiserror::Error;

use super::shortened;

/// Maximum number of characters of a value in a message.
const SHOWN_MAX: usize = 80;

/// Magnitudes of numbers that are written without a power of ten.
const PLAIN_RANGE: std::ops::Range<f64> = 1e-6..1e16;

/// A configuration value that is not accepted.
#[derive(Clone, Debug, Error, PartialEq, Eq)]
#[error("{key} = {value}: expected {expected}")]
pub struct InvalidValue {
    /// Full key, with its sections and, in lists, its index from 0.
    pub key: String,
    /// The value that was found.
    pub value: String,
    /// What is accepted.
    pub expected: Cow<'static, str>,
}

/// Checks the values of one section and collects those that are not accepted.
#[derive(Debug)]
pub struct Checks {
    section: &'static str,
    found: Vec<InvalidValue>,
}

impl Checks {
    /// Checks for the section with this full name; the name is empty for keys outside any section.
    #[must_use]
    pub fn new(section: &'static str) -> Self {
        Self { section, found: Vec::new() }
    }

    /// Records the value of `key` as invalid unless it is `ok`; `expected` says what is accepted.
    pub fn require(
        &mut self,
        key: impl fmt::Display,
        value: impl fmt::Display,
        ok: bool,
        expected: impl Into<Cow<'static, str>>,
    ) {
        if ok {
            return;
        }
        let key = match self.section {
            "" => key.to_string(),
            section => format!("{section}.{key}"),
        };
        self.found.push(InvalidValue {
            key,
            value: shortened(&value.to_string(), SHOWN_MAX),
            expected: expected.into(),
        });
    }

    /// Records a number as invalid unless it is finite and `ok`, as [`Checks::require`] does.
    pub fn number(
        &mut self,
        key: impl fmt::Display,
        value: f64,
        ok: bool,
        expected: impl Into<Cow<'static, str>>,
    ) {
        let ok = ok && value.is_finite();
        match PLAIN_RANGE.contains(&value.abs()) || value == 0.0 {
            true => self.require(key, value, ok, expected),
            false => self.require(key, format_args!("{value:e}"), ok, expected),
        }
    }

    /// Records a list as invalid unless all its values are finite and `ok`. The message names the first invalid value and the number of
    /// further ones, so that it stays short for a list of any length.
    pub fn numbers(
        &mut self,
        key: impl fmt::Display,
        values: &[f64],
        ok: impl Fn(f64) -> bool,
        expected: impl fmt::Display,
    ) {
        let mut bad = values.iter().enumerate().filter(|(_, value)| !(value.is_finite() && ok(**value)));
        let Some((index, &value)) = bad.next() else { return };
        let position = if values.len() == 1 { String::new() } else { format!("[{index}]") };
        match bad.count() {
            0 => self.number(format_args!("{key}{position}"), value, false, expected.to_string()),
            more => {
                let expected = format!("{expected}, as of {more} more of its values");
                self.number(format_args!("{key}{position}"), value, false, expected);
            }
        }
    }

    /// The values that are not accepted, in the order of the checks.
    #[must_use]
    pub fn finish(self) -> Vec<InvalidValue> {
        self.found
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn all_invalid_values_are_reported_with_their_full_keys() {
        let mut checks = Checks::new("map");
        checks.require("nside", 3, false, "a power of two");
        checks.require("engine", "pixel", true, "pixel or harmonic");
        checks.number("weight_max", f64::INFINITY, true, "a number");
        checks.number("epsilon", 0.5, true, "above 0");
        let mut outside = Checks::new("");
        outside.require("seed", "-1", false, format!("0 to {}", u64::MAX));
        let messages: Vec<String> =
            checks.finish().iter().chain(&outside.finish()).map(ToString::to_string).collect();
        let expected = [
            "map.nside = 3: expected a power of two",
            "map.weight_max = inf: expected a number",
            "seed = -1: expected 0 to 18446744073709551615",
        ];
        assert_eq!(messages, expected);
    }

    #[test]
    fn long_values_and_lists_are_shortened() {
        let mut checks = Checks::new("map");
        checks.require("name", "m".repeat(1000), false, "a name");
        checks.number("large", 1e300, false, "a number");
        checks.number("small", -1e-300, false, "a number");
        let list = vec![-1.0; 1_000_000];
        checks.numbers("epsilon", &list, |x| x > 0.0, "above 0");
        checks.numbers("one", &[f64::NAN], |_| true, "a number");
        checks.numbers("pair", &[1.0, 0.0], |x| x > 0.0, "above 0");
        checks.numbers("good", &[1.0, 2.0], |x| x > 0.0, "above 0");
        let messages: Vec<String> = checks.finish().iter().map(ToString::to_string).collect();
        let expected = [
            format!("map.name = {}... (1000 bytes): expected a name", "m".repeat(80)),
            "map.large = 1e300: expected a number".to_owned(),
            "map.small = -1e-300: expected a number".to_owned(),
            "map.epsilon[0] = -1: expected above 0, as of 999999 more of its values".to_owned(),
            "map.one = NaN: expected a number".to_owned(),
            "map.pair[1] = 0: expected above 0".to_owned(),
        ];
        assert_eq!(messages, expected);
    }
}
