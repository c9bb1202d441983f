//! What can be chosen about the downlink.

use serde::{Deserialize, Serialize};

use super::error::DownlinkError;
use super::header::PACKET_BYTES_MAX;

/// Least packet that holds headers and more than one record of any kind.
const PACKET_BYTES_MIN: usize = 256;

/// The `[downlink]` section.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct DownlinkConfig {
    /// Greatest packet, bytes. A lost packet loses its own visibilities only (21 bytes each).
    pub packet_bytes_max: usize,
    /// After so many bytes the instrument description and the present ephemeris are sent again, so that
    /// no single damaged packet costs more than this.
    pub repeat_bytes: u64,
}

impl Default for DownlinkConfig {
    /// Packets of 8 KiB (about eight transfer frames of 1115 bytes), repeats once a MiB (about 1 %).
    fn default() -> Self {
        Self { packet_bytes_max: 8_192, repeat_bytes: 1 << 20 }
    }
}

impl DownlinkConfig {
    /// Everything that is wrong with the configuration; empty if it is good.
    #[must_use]
    pub fn problems(&self) -> Vec<DownlinkError> {
        let mut found = Vec::new();
        if !(PACKET_BYTES_MIN..=PACKET_BYTES_MAX).contains(&self.packet_bytes_max) {
            found.push(DownlinkError::Parameter {
                key: "packet_bytes_max",
                value: self.packet_bytes_max as u64,
                expected: "256 to 65542",
            });
        }
        if self.repeat_bytes < 1 << 16 {
            found.push(DownlinkError::Parameter {
                key: "repeat_bytes",
                value: self.repeat_bytes,
                expected: "at least 65536",
            });
        }
        found
    }
}
