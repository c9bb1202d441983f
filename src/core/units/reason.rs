//! Reasons why data does not reach a result.

use std::fmt::Debug;

/// A closed set of reasons why a sample or a visibility does not reach the result.
///
/// The ledger of a run counts data by reason; users see the texts.
pub trait Reason: Copy + Debug + Ord + Send + 'static {
    /// The text that users see wherever the reason is shown.
    fn text(self) -> &'static str;

    /// The stage that lost the data; `None` for data that was left out on purpose (flagged).
    fn lost_in(self) -> Option<&'static str>;
}
