//! The contents of a downlink file, for `lunarray inspect`.
//!
//! [`Contents::read`] streams the file and keeps counts only: one row per pair and channel, and at most
//! [`LISTED_MAX`](super::LISTED_MAX) entries per list. `Display` renders the contents as tables.

mod contents;
mod inspector;
mod table;

pub use contents::{
    ChannelContents, Contents, DamagedEntry, EphemerisSummary, FaultEntry, GapEntry, GarbageEntry,
    HousekeepingSummary, InstrumentSummary, KindSummary, PairSummary, TimeSpan, VisibilityCounts,
};
