//! Identifiers of channels and satellite pairs.

use std::fmt;
use std::str::FromStr;

use thiserror::Error;

/// Maximum number of daughters of an array; it bounds every table that is indexed by satellite.
pub const MAX_SATELLITES: usize = 64;

/// Index of a frequency channel in the instrument description.
#[derive(
    Clone,
    Copy,
    Debug,
    Default,
    PartialEq,
    Eq,
    PartialOrd,
    Ord,
    Hash,
    serde::Serialize,
    bincode::Encode,
    bincode::Decode,
)]
pub struct ChannelId(pub u16);

impl fmt::Display for ChannelId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}", self.0)
    }
}

/// Two daughters `i < j`, numbered from 0; displayed and parsed with numbers from 1, as in "1-2".
#[derive(
    Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash, bincode::Encode, bincode::Decode,
)]
pub struct Pair {
    /// The leading daughter.
    pub i: u8,
    /// The trailing daughter.
    pub j: u8,
}

/// Why a text is not a pair.
#[derive(Debug, Error, PartialEq, Eq)]
#[non_exhaustive]
pub enum PairError {
    /// The text is not of the form `i-j`.
    #[error("`{0}` is not a pair; expected two satellite numbers such as 1-2")]
    Form(String),
    /// The numbers are out of range or not increasing.
    #[error("pair {i}-{j}: expected 1 <= i < j <= {MAX_SATELLITES}")]
    Range {
        /// First number, counted from 1.
        i: usize,
        /// Second number, counted from 1.
        j: usize,
    },
}

impl Pair {
    /// The pair of daughters `i < j`, numbered from 1.
    ///
    /// # Errors
    /// [`PairError::Range`] unless `1 <= i < j <= MAX_SATELLITES`.
    pub fn from_one_based(i: usize, j: usize) -> Result<Self, PairError> {
        if i >= 1 && i < j && j <= MAX_SATELLITES {
            Ok(Self { i: (i - 1) as u8, j: (j - 1) as u8 })
        } else {
            Err(PairError::Range { i, j })
        }
    }
}

impl fmt::Display for Pair {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}-{}", u32::from(self.i) + 1, u32::from(self.j) + 1)
    }
}

impl FromStr for Pair {
    type Err = PairError;

    fn from_str(s: &str) -> Result<Self, PairError> {
        let malformed = || PairError::Form(s.to_owned());
        let (i, j) = s.split_once('-').ok_or_else(malformed)?;
        let i = i.trim().parse().map_err(|_| malformed())?;
        let j = j.trim().parse().map_err(|_| malformed())?;
        Self::from_one_based(i, j)
    }
}

/// All pairs of `satellites` daughters, in the order 1-2, 1-3, .. , 2-3, ..
#[must_use]
pub fn all_pairs(satellites: usize) -> Vec<Pair> {
    let count = satellites.min(MAX_SATELLITES) as u8;
    (0..count).flat_map(|i| (i + 1..count).map(move |j| Pair { i, j })).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pairs_are_displayed_as_they_are_parsed() {
        let pairs = all_pairs(8);
        assert_eq!(pairs.len(), 28);
        for pair in pairs {
            assert_eq!(pair.to_string().parse::<Pair>(), Ok(pair));
        }
    }

    #[test]
    fn bad_pairs_are_refused() {
        for text in ["", "1", "2-1", "1-1", "0-3", "1-65", "a-b", "1-2-3"] {
            assert!(text.parse::<Pair>().is_err(), "{text}");
        }
    }
}
