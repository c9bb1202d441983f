//! Collection of the problems of a pipeline, from all sections.

use std::error::Error;
use std::fmt;

use crate::units::InvalidValue;

/// A problem of any type.
pub type Problem = Box<dyn Error + Send + Sync>;

/// Maximum number of problems that are kept and shown; the others are only counted.
const KEPT_MAX: usize = 20;

/// Problems of a pipeline: the first ones, and the number of all.
#[derive(Debug, Default)]
pub struct Problems {
    kept: Vec<Problem>,
    count: usize,
}

impl Problems {
    /// Adds a problem; `problem` is called only if it is kept.
    pub fn push<P: Into<Problem>>(&mut self, problem: impl FnOnce() -> P) {
        self.count += 1;
        if self.kept.len() < KEPT_MAX {
            self.kept.push(problem().into());
        }
    }

    /// Adds the problems of another collection.
    pub fn append(&mut self, others: Self) {
        self.count += others.count - others.kept.len();
        others.kept.into_iter().for_each(|problem| self.push(|| problem));
    }

    /// Removes the kept problems whose text matches `is_excluded`.
    pub(in crate::pipeline) fn without(self, is_excluded: impl Fn(&str) -> bool) -> Self {
        let mut remaining = Self { kept: Vec::new(), count: self.count - self.kept.len() };
        for problem in self.kept.into_iter().filter(|problem| !is_excluded(&problem.to_string())) {
            remaining.push(|| problem);
        }
        remaining
    }

    /// Number of all problems, kept or only counted.
    #[must_use]
    pub fn len(&self) -> usize {
        self.count
    }

    /// Whether there are no problems.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.count == 0
    }

    /// The problems that are kept.
    pub fn iter(&self) -> std::slice::Iter<'_, Problem> {
        self.kept.iter()
    }
}

impl<'a> IntoIterator for &'a Problems {
    type Item = &'a Problem;
    type IntoIter = std::slice::Iter<'a, Problem>;

    fn into_iter(self) -> Self::IntoIter {
        self.iter()
    }
}

impl Extend<InvalidValue> for Problems {
    fn extend<T: IntoIterator<Item = InvalidValue>>(&mut self, found: T) {
        for problem in found {
            self.push(|| problem);
        }
    }
}

impl fmt::Display for Problems {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{} problem(s)", self.count)?;
        for problem in &self.kept {
            write!(f, "\n  - {problem}")?;
        }
        match self.count - self.kept.len() {
            0 => Ok(()),
            more => write!(f, "\n  and {more} more"),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_first_problems_are_shown_and_the_others_are_counted() {
        let mut problems = Problems::default();
        let mut made = 0;
        for index in 0..1000 {
            problems.push(|| {
                made += 1;
                format!("number {index}")
            });
        }
        assert_eq!((problems.len(), problems.iter().count(), made), (1000, 20, 20));
        let told = problems.to_string();
        assert!(told.starts_with("1000 problem(s)\n  - number 0\n"), "{told}");
        assert!(told.ends_with("  - number 19\n  and 980 more"), "{told}");
    }
}
