//! What messages of the kinds that are read have in common, whatever form they are written in.

use crate::units::shortened;

/// Longest value of a file that a message repeats, characters.
const FOUND_CHARS_MAX: usize = 200;

/// A fault of a file: its line, from 1, what was found, and what was expected there.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(in crate::array) struct Fault {
    pub(in crate::array) line: usize,
    pub(in crate::array) found: String,
    pub(in crate::array) expected: String,
}

impl Fault {
    pub(in crate::array) fn new(line: usize, found: impl Into<String>, expected: impl Into<String>) -> Self {
        Self { line, found: shortened(&found.into(), FOUND_CHARS_MAX), expected: expected.into() }
    }
}

/// A message that is gathered as its form, KVN or XML, is read.
pub(in crate::array) trait Message: Default {
    /// The name of its kind, in capitals.
    const NAME: &'static str;
    /// Versions that are read, the usual one first.
    const VERSIONS: &'static [&'static str];
    /// What a line of data has.
    const LINE: &'static str;
    /// How many numbers a line of data may have.
    const COUNTS: &'static [usize];
    /// Element of a state in XML.
    const STATE: &'static str;
    /// Elements of its numbers, in their order.
    const NUMBERS: &'static [&'static str];

    /// The unit of a number in XML, if it has to have one.
    fn unit(_number: usize) -> Option<&'static str> {
        None
    }

    fn begin_metadata(&mut self);

    /// Takes a value of the metadata.
    fn set(&mut self, key: &str, value: &str, line: usize) -> Result<(), Fault>;

    /// Begins a segment with the metadata that end in a line.
    fn end_metadata(&mut self, line: usize) -> Result<(), Fault>;

    /// Adds a state of the latest segment.
    fn state(&mut self, epoch: &str, numbers: &[f64], line: usize) -> Result<(), Fault>;

    /// Adds a state whose numbers have names, in their order.
    fn named_state(&mut self, epoch: &str, numbers: &[f64], line: usize) -> Result<(), Fault> {
        self.state(epoch, numbers, line)
    }

    /// Ends the latest segment, if there is one.
    fn end_segment(&mut self, line: usize) -> Result<(), Fault>;

    /// Counts a matrix of covariance, which is passed over.
    fn covariance(&mut self) {}
}

/// The beginning of a line, for messages.
pub(in crate::array) fn short(content: &str) -> String {
    let mut text: String = content.chars().take(60).filter(|c| !c.is_control()).collect();
    if text.len() < content.len() {
        text.push_str("..");
    }
    format!("{text:?}")
}
