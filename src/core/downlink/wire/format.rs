//! The two formats of a downlink.

use serde::{Deserialize, Serialize};

/// The format of a downlink.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Format {
    /// Space packets, one after the other.
    #[default]
    Packets,
    /// Packets in coded transfer frames (CADU).
    Cadu,
}
