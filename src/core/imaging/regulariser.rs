//! The regulariser R: a multiple of the identity, or a diagonal matrix that depends on the degree.

use std::path::Path;

use crate::files::{Separator, numbered_lines, read_text};
use crate::imaging::solve_error::SolveError;
use crate::imaging::unknowns::degrees;

/// Maximum size of a table, bytes; a table up to the maximum degree is smaller.
pub(in crate::imaging) const POWER_FILE_BYTES_MAX: u64 = 1 << 20;

/// Maximum degree of a table, far beyond that of any map or baseline.
const DEGREE_MAX: usize = 1 << 20;

/// The dependence of R on the degree.
#[derive(Clone, Debug, PartialEq)]
pub enum Regulariser {
    /// `R_l = 1 / C_l` with the maximum-likelihood C_l of the data ([`crate::imaging::SkyPower`]).
    Data,
    /// `R_l = epsilon W_max (l + 1)^exponent`; the identity with an exponent of 0.
    Power(f64),
    /// `R_l = epsilon / C_l` for a sky (without the prior) of angular power C_l, K^2, from l = 0; with epsilon = 1 the Wiener filter.
    Wiener(Vec<f64>),
}

impl Default for Regulariser {
    fn default() -> Self {
        Self::Power(0.0)
    }
}

/// The diagonal of R over the unknowns.
#[derive(Clone, Debug, PartialEq)]
pub(in crate::imaging) enum Diagonal {
    /// One value for all unknowns.
    Uniform(f64),
    /// Values for harmonics by degree, from l = 0.
    ByDegree(Vec<f64>),
}

impl Diagonal {
    /// Computes `y += R x`.
    pub(in crate::imaging) fn add_product(&self, x: &[f64], y: &mut [f64]) {
        match self {
            Self::Uniform(level) => y.iter_mut().zip(x).for_each(|(y, x)| *y += level * x),
            Self::ByDegree(by_degree) => {
                let levels = degrees(by_degree.len().saturating_sub(1)).map(|l| by_degree[l]);
                y.iter_mut().zip(x).zip(levels).for_each(|((y, x), level)| *y += level * x);
            }
        }
    }

    /// The matrix `factor R`.
    pub(in crate::imaging) fn times(&self, factor: f64) -> Self {
        match self {
            Self::Uniform(level) => Self::Uniform(factor * level),
            Self::ByDegree(by_degree) => {
                Self::ByDegree(by_degree.iter().map(|level| factor * level).collect())
            }
        }
    }

    /// The element of degree `l`.
    pub(in crate::imaging) fn at(&self, l: usize) -> f64 {
        match self {
            Self::Uniform(level) => *level,
            Self::ByDegree(by_degree) => by_degree[l],
        }
    }
}

impl Regulariser {
    /// Reads the angular power of a sky from a table of l and C_l, K^2, separated by a comma or blanks, from l = 0 without gaps.
    ///
    /// # Errors
    /// The file cannot be read or is no such table, or a power is not positive.
    pub fn read(path: &Path) -> Result<Self, SolveError> {
        let failed = |found: String| SolveError::Power { path: path.to_owned(), found };
        let text = read_text(path, POWER_FILE_BYTES_MAX).map_err(|error| failed(error.to_string()))?;
        match parse_power(&text).map_err(failed)? {
            (0, power_k2) => Ok(Self::Wiener(power_k2)),
            (first, _) => Err(failed(format!("l = {first} first"))),
        }
    }

    /// The diagonal of R for a solution up to `l_max`.
    pub(in crate::imaging) fn diagonal(
        &self,
        epsilon: f64,
        w_max: f64,
        l_max: usize,
    ) -> Result<Diagonal, SolveError> {
        let level = epsilon * w_max;
        Ok(match self {
            // The solution itself finds this one.
            Self::Data => return Err(SolveError::NoPower),
            Self::Power(0.0) => Diagonal::Uniform(level),
            Self::Power(exponent) => {
                Diagonal::ByDegree((0..=l_max).map(|l| level * ((l + 1) as f64).powf(*exponent)).collect())
            }
            Self::Wiener(power_k2) => {
                let power_k2 = power_k2
                    .get(..=l_max)
                    .ok_or(SolveError::PowerLength { found: power_k2.len(), expected: l_max + 1 })?;
                Diagonal::ByDegree(power_k2.iter().map(|power| epsilon / power).collect())
            }
        })
    }
}

/// Parses a table to its first degree and C_l from there on, or says which line is wrong.
pub(in crate::imaging) fn parse_power(text: &str) -> Result<(usize, Vec<f64>), String> {
    let (mut first, mut power_k2) = (0, Vec::new());
    for (number, line) in numbered_lines(text) {
        Separator::CommasOrBlanks.require_closed(number, line).map_err(|fault| fault.to_string())?;
        let mut cells = Separator::CommasOrBlanks.cells(line);
        let [degree, power] = [cells.next(), cells.next()].map(Option::unwrap_or_default);
        let is_header = power_k2.is_empty() && degree.parse::<f64>().is_err();
        if is_header {
            continue;
        }
        match (degree.parse::<usize>().ok(), Separator::CommasOrBlanks.number(&power)) {
            (Some(l), Some(power))
                if (power_k2.is_empty() || l == first + power_k2.len()) && l <= DEGREE_MAX && power > 0.0 =>
            {
                first = l - power_k2.len();
                power_k2.push(power);
            }
            _ => return Err(format!("line {number}: {}", line.chars().take(60).collect::<String>())),
        }
    }
    if power_k2.is_empty() { Err("no degrees".to_owned()) } else { Ok((first, power_k2)) }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn r_follows_its_exponent_or_the_power() {
        let diagonal = |regulariser: Regulariser| regulariser.diagonal(0.5, 4.0, 2);
        assert_eq!(diagonal(Regulariser::default()), Ok(Diagonal::Uniform(2.0)));
        assert_eq!(diagonal(Regulariser::Power(2.0)), Ok(Diagonal::ByDegree(vec![2.0, 8.0, 18.0])));
        let power_k2 = vec![1.0, 0.25, 0.125, 9.0];
        assert_eq!(diagonal(Regulariser::Wiener(power_k2)), Ok(Diagonal::ByDegree(vec![0.5, 2.0, 4.0])));
        let short = SolveError::PowerLength { found: 2, expected: 3 };
        assert_eq!(diagonal(Regulariser::Wiener(vec![1.0; 2])), Err(short));
    }

    #[test]
    fn tables_are_parsed_or_the_bad_line_is_named() {
        assert_eq!(parse_power("l,power_k2\n0,3e9\n1, 2.5\n\n2\t1\n"), Ok((0, vec![3e9, 2.5, 1.0])));
        // As spreadsheets leave it.
        assert_eq!(parse_power("\u{feff}0,1\r\n1,2\r\n,\r\n , ,\r\n"), Ok((0, vec![1.0, 2.0])));
        assert_eq!(parse_power("\u{feff}l,power_k2\n\"0\",1\n"), Ok((0, vec![1.0])));
        assert_eq!(parse_power("# from elsewhere\n0 1\n"), Ok((0, vec![1.0])));
        // As a map leaves it.
        assert_eq!(parse_power("# C_l\nl,power_k2,low_k2\n2,4,3\n3,2,1\n"), Ok((2, vec![4.0, 2.0])));
        for (text, found) in [
            ("", "no degrees"),
            ("0,1\n2,1", "line 2: 2,1"),
            ("0,1\n1,0", "line 2: 1,0"),
            ("0,1\n1,-1", "line 2: 1,-1"),
            ("0,inf", "line 1: 0,inf"),
            ("0,1\n1", "line 2: 1"),
            ("\"0,1\n1,2", "line 1: found a quote that is not closed; expected its end on the same line"),
            ("0,1\none,1", "line 2: one,1"),
            ("2,1\n4,1", "line 2: 4,1"),
            // A degree after which there is no other number.
            ("18446744073709551615,1\n", "line 1: 18446744073709551615,1"),
        ] {
            assert_eq!(parse_power(text), Err(found.to_owned()), "{text}");
        }
        let gone = Regulariser::read(Path::new("no such table")).unwrap_err().to_string();
        assert!(gone.contains("no such table"), "{gone}");
    }
}
