//! A list of bounded length.

use serde::Serialize;

/// Maximum number of entries that a listing keeps; further entries are only counted.
pub const LISTED_MAX: usize = 1_000;

/// The first entries of a list, and the total number of entries.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Listing<T> {
    /// Total number of entries.
    pub count: u64,
    /// The first [`LISTED_MAX`] entries.
    pub listed: Vec<T>,
}

impl<T> Default for Listing<T> {
    fn default() -> Self {
        Self { count: 0, listed: Vec::new() }
    }
}

impl<T> Listing<T> {
    pub(in crate::downlink) fn push(&mut self, entry: T) {
        self.count += 1;
        if self.listed.len() < LISTED_MAX {
            self.listed.push(entry);
        }
    }
}
