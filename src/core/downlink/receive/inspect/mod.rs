//! The contents of a downlink file, for `lunarray inspect`.
//!
//! [`Contents::read`] streams the file and keeps counts only: one row per pair and channel, and at most
//! [`LISTED_MAX`](super::LISTED_MAX) entries per list. As on the ground, the order of the packets does not matter. `Display` renders the contents as tables.

mod any_order;
mod contents;
mod inspector;
mod packet_gaps;
mod table;

pub use contents::{
    ChannelContents, Contents, DamagedEntry, EphemerisSummary, FaultEntry, GapEntry, GarbageEntry,
    HousekeepingSummary, InstrumentSummary, KindSummary, PairSummary, TimeSpan, VisibilityCounts,
};
