//! Checks of configuration values: all that is wrong with a section, collected at once.

use std::borrow::Cow;
use std::fmt;

use thiserror::Error;

use super::shortened;

/// Most characters of a value in a message.
const SHOWN_MAX: usize = 80;

/// Sizes of numbers that are written without a power of ten.
const PLAIN: std::ops::Range<f64> = 1e-6..1e16;

/// A configuration value that is not accepted.
#[derive(Clone, Debug, Error, PartialEq, Eq)]
#[error("{key} = {value}: expected {expected}")]
pub struct InvalidValue {
    /// Full key, with its sections and its place in lists counted from 0.
    pub key: String,
    /// Value found.
    pub value: String,
    /// What is accepted.
    pub expected: Cow<'static, str>,
}

/// Checks the values of one section and keeps those that are not accepted.
#[derive(Debug)]
pub struct Checks {
    section: &'static str,
    found: Vec<InvalidValue>,
}

impl Checks {
    /// Checks of the section with this full name; empty for keys outside any section.
    #[must_use]
    pub fn of(section: &'static str) -> Self {
        Self { section, found: Vec::new() }
    }

    /// Requires that the value of `key` is `ok`; otherwise keeps it with what is `expected`.
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

    /// As [`Checks::require`], and requires that the value is finite.
    pub fn number(
        &mut self,
        key: impl fmt::Display,
        value: f64,
        ok: bool,
        expected: impl Into<Cow<'static, str>>,
    ) {
        let ok = ok && value.is_finite();
        match PLAIN.contains(&value.abs()) || value == 0.0 {
            true => self.require(key, value, ok, expected),
            false => self.require(key, format_args!("{value:e}"), ok, expected),
        }
    }

    /// Requires that every value of a list is finite and `ok`. A list of any length is one problem: its first bad value,
    /// and the number of the others.
    pub fn numbers(
        &mut self,
        key: impl fmt::Display,
        values: &[f64],
        ok: impl Fn(f64) -> bool,
        expected: impl fmt::Display,
    ) {
        let mut bad = values.iter().enumerate().filter(|(_, value)| !(value.is_finite() && ok(**value)));
        let Some((index, &value)) = bad.next() else { return };
        let place = if values.len() == 1 { String::new() } else { format!("[{index}]") };
        match bad.count() {
            0 => self.number(format_args!("{key}{place}"), value, false, expected.to_string()),
            more => {
                let expected = format!("{expected}, as of {more} more of its values");
                self.number(format_args!("{key}{place}"), value, false, expected);
            }
        }
    }

    /// The values that are not accepted, in the order of the checks; empty if all are good.
    #[must_use]
    pub fn finish(self) -> Vec<InvalidValue> {
        self.found
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn all_that_is_wrong_is_told_with_its_full_key() {
        let mut checks = Checks::of("map");
        checks.require("nside", 3, false, "a power of two");
        checks.require("engine", "pixel", true, "pixel or harmonic");
        checks.number("weight_max", f64::INFINITY, true, "a number");
        checks.number("epsilon", 0.5, true, "above 0");
        let mut outside = Checks::of("");
        outside.require("seed", "-1", false, format!("0 to {}", u64::MAX));
        let told: Vec<String> =
            checks.finish().iter().chain(&outside.finish()).map(ToString::to_string).collect();
        let expected = [
            "map.nside = 3: expected a power of two",
            "map.weight_max = inf: expected a number",
            "seed = -1: expected 0 to 18446744073709551615",
        ];
        assert_eq!(told, expected);
    }

    #[test]
    fn long_values_and_lists_are_told_in_short() {
        let mut checks = Checks::of("map");
        checks.require("name", "m".repeat(1000), false, "a name");
        checks.number("large", 1e300, false, "a number");
        checks.number("small", -1e-300, false, "a number");
        let list = vec![-1.0; 1_000_000];
        checks.numbers("epsilon", &list, |x| x > 0.0, "above 0");
        checks.numbers("one", &[f64::NAN], |_| true, "a number");
        checks.numbers("pair", &[1.0, 0.0], |x| x > 0.0, "above 0");
        checks.numbers("good", &[1.0, 2.0], |x| x > 0.0, "above 0");
        let told: Vec<String> = checks.finish().iter().map(ToString::to_string).collect();
        let expected = [
            format!("map.name = {}... (1000 bytes): expected a name", "m".repeat(80)),
            "map.large = 1e300: expected a number".to_owned(),
            "map.small = -1e-300: expected a number".to_owned(),
            "map.epsilon[0] = -1: expected above 0, as of 999999 more of its values".to_owned(),
            "map.one = NaN: expected a number".to_owned(),
            "map.pair[1] = 0: expected above 0".to_owned(),
        ];
        assert_eq!(told, expected);
    }
}
