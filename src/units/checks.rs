//! Checks of configuration values: all that is wrong with a section, collected at once.

use std::borrow::Cow;
use std::fmt;

use thiserror::Error;

use super::echo;

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
        self.found.push(InvalidValue { key, value: echo(value), expected: expected.into() });
    }

    /// As [`Checks::require`], and requires that the value is finite.
    pub fn number(
        &mut self,
        key: impl fmt::Display,
        value: f64,
        ok: bool,
        expected: impl Into<Cow<'static, str>>,
    ) {
        self.require(key, value, ok && value.is_finite(), expected);
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
        checks.number("weight_max", 1e300, false, "less");
        checks.number("epsilon", 0.5, true, "above 0");
        let mut outside = Checks::of("");
        outside.require("seed", "-1", false, format!("0 to {}", u64::MAX));
        let told: Vec<String> =
            checks.finish().iter().chain(&outside.finish()).map(ToString::to_string).collect();
        let expected = [
            "map.nside = 3: expected a power of two",
            "map.weight_max = inf: expected a number",
            "map.weight_max = 1e300: expected less",
            "seed = -1: expected 0 to 18446744073709551615",
        ];
        assert_eq!(told, expected);
    }
}
