//! Change of antenna patterns with frequency.

use serde::{Deserialize, Serialize};

use crate::units::Checks;

/// Maximum number of rows of a table.
const ROWS_MAX: usize = 1000;

/// Maximum |q| of a pattern.
const Q_MAX: f64 = 2.0;

/// Table over frequency of q in the factor `1 + q (3 cos^2 - 1) / 2` of the voltage pattern.
///
/// Rows are `[frequency_hz, q]`, or `[frequency_hz, q_1, q_2, ...]` with one q per daughter, at rising frequencies. q is linear between
/// rows, and constant beyond the first and the last.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(transparent)]
pub struct PatternsByFrequency(Vec<Vec<f64>>);

impl PatternsByFrequency {
    /// Whether all patterns are ideal.
    #[must_use]
    pub fn is_ideal(&self) -> bool {
        self.0.iter().all(|row| row.iter().skip(1).all(|q| *q == 0.0))
    }

    /// q of a daughter (counted from 0) at a frequency; 0 for a daughter without a column.
    #[must_use]
    pub fn q(&self, daughter: usize, frequency_hz: f64) -> f64 {
        let q = |row: &[f64]| match row {
            [_, common] => *common,
            _ => row.get(1 + daughter).copied().unwrap_or(0.0),
        };
        let row_hz = |row: &[f64]| row.first().copied().unwrap_or(f64::NAN);
        let above = self.0.iter().position(|row| row_hz(row) > frequency_hz).unwrap_or(self.0.len());
        match (above.checked_sub(1).map(|below| &self.0[below]), self.0.get(above)) {
            (Some(low), Some(high)) => {
                let fraction = (frequency_hz - row_hz(low)) / (row_hz(high) - row_hz(low));
                q(low) + fraction * (q(high) - q(low))
            }
            (Some(end), None) | (None, Some(end)) => q(end),
            (None, None) => 0.0,
        }
    }

    /// Requires rising frequencies, |q| of at most 2, and a column for each of `satellites`, if their number is known.
    pub fn check(&self, key: &str, satellites: Option<usize>, checks: &mut Checks) {
        let count = self.0.len();
        checks.require(key, format!("({count} rows)"), count <= ROWS_MAX, format!("at most {ROWS_MAX} rows"));
        let width = self.0.first().map_or(2, Vec::len);
        let mut previous_hz = 0.0;
        for (k, row) in self.0.iter().enumerate() {
            let (key, found) = (format!("{key}[{k}]"), format!("({} numbers)", row.len()));
            let is_rectangular = row.len() == width && row.len() >= 2;
            let fits_array =
                row.len() == 2 || satellites.is_none_or(|satellites| row.len() == satellites + 1);
            if !is_rectangular || !fits_array {
                let expected = match satellites {
                    Some(satellites) => format!(
                        "[frequency_hz, q], or a frequency and {satellites} values, one per daughter, in every row"
                    ),
                    None => "[frequency_hz, q], or a frequency and one value per daughter, in every row"
                        .to_owned(),
                };
                checks.require(key, found, false, expected);
                return;
            }
            if row[0] <= previous_hz || !row[0].is_finite() {
                let expected =
                    format!("a frequency above {previous_hz} Hz, the frequency of the previous row");
                checks.require(key, row[0], false, expected);
                return;
            }
            previous_hz = row[0];
            checks.numbers(key, &row[1..], |q| q.abs() <= Q_MAX, "patterns of -2 to 2 after the frequency");
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn table(text: &str) -> PatternsByFrequency {
        #[derive(Deserialize)]
        struct Holder {
            table: PatternsByFrequency,
        }
        toml::from_str::<Holder>(&format!("table = {text}")).unwrap().table
    }

    #[test]
    fn patterns_are_linear_between_rows_and_end_with_them() {
        let alike = table("[[1e6, 0.1], [10e6, 0.4], [30e6, -0.2]]");
        for (hz, expected) in [(5e5, 0.1), (1e6, 0.1), (4e6, 0.2), (10e6, 0.4), (20e6, 0.1), (40e6, -0.2)] {
            for daughter in [0, 7, 63] {
                assert!((alike.q(daughter, hz) - expected).abs() < 1e-15, "{hz}");
            }
        }
        let own = table("[[1e6, 0.1, 0.0], [3e6, 0.3, -0.2]]");
        let found = [0, 1, 2].map(|daughter| own.q(daughter, 2e6));
        assert!(
            (found[0] - 0.2).abs() < 1e-15 && (found[1] + 0.1).abs() < 1e-15 && found[2] == 0.0,
            "{found:?}"
        );
        assert!(
            !own.is_ideal() && table("[[1e6, 0.0]]").is_ideal() && PatternsByFrequency::default().is_ideal()
        );
        assert_eq!(PatternsByFrequency::default().q(3, 1e6), 0.0);
    }

    #[test]
    fn odd_tables_are_refused_by_row() {
        for (text, expected) in [
            ("[[1e6]]", "pattern[0] = (1 numbers): expected [frequency_hz, q], or a frequency and 3 values"),
            ("[[1e6, 0.1], [2e6, 0.1, 0.2, 0.3]]", "pattern[1] = (4 numbers)"),
            ("[[1e6, 0.1, 0.2]]", "pattern[0] = (3 numbers)"),
            ("[[2e6, 0.1], [1e6, 0.1]]", "pattern[1] = 1000000: expected a frequency above 2000000 Hz"),
            ("[[-1.0, 0.1]]", "pattern[0] = -1"),
            ("[[nan, 0.1]]", "pattern[0] = NaN"),
            ("[[1e6, 2.5]]", "patterns of -2 to 2"),
            ("[[1e6, nan]]", "patterns of -2 to 2"),
        ] {
            let mut checks = Checks::new("instrument");
            table(text).check("pattern", Some(3), &mut checks);
            let said: Vec<String> = checks.finish().iter().map(ToString::to_string).collect();
            assert!(said.len() == 1 && said[0].contains(expected), "{text}: {said:?}");
        }
        let mut checks = Checks::new("map");
        table("[[1e6, 0.1, 0.2], [2e6, 0.0, 0.1]]").check("antennas.pattern", None, &mut checks);
        assert!(checks.finish().is_empty());
    }
}
