//! Reasons for which data does not reach a result.

use std::fmt::Debug;

/// Why a sample or a visibility does not reach the result: a closed set of values, each with one text.
///
/// The ledger of a run counts by these values. Users see the texts.
pub trait Reason: Copy + Debug + Ord + Send + 'static {
    /// The text, the same wherever the reason is shown.
    fn text(self) -> &'static str;

    /// The stage that lost the data; `None` if the data was left out on purpose, that is flagged.
    fn lost_in(self) -> Option<&'static str>;
}
