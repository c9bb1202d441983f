//! What can be chosen about the downlink.

use serde::{Deserialize, Serialize};

use super::error::DownlinkError;
use super::header::PACKET_OCTETS_MAX;

/// Least packet that holds headers and more than one record of any kind.
const PACKET_OCTETS_MIN: usize = 256;

/// The `[downlink]` section.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct DownlinkConfig {
    /// Greatest packet, octets. A lost packet loses its own visibilities only (21 octets each).
    pub packet_octets_max: usize,
    /// After so many octets the instrument description and the present ephemeris are sent again, so that
    /// no single damaged packet costs more than this.
    pub repeat_octets: u64,
}

impl Default for DownlinkConfig {
    /// Packets of 8 KiB (about eight transfer frames of 1115 octets), repeats once a MiB (about 1 %).
    fn default() -> Self {
        Self { packet_octets_max: 8_192, repeat_octets: 1 << 20 }
    }
}

impl DownlinkConfig {
    /// Everything that is wrong with the configuration; empty if it is good.
    #[must_use]
    pub fn problems(&self) -> Vec<DownlinkError> {
        let mut found = Vec::new();
        if !(PACKET_OCTETS_MIN..=PACKET_OCTETS_MAX).contains(&self.packet_octets_max) {
            found.push(DownlinkError::Parameter {
                key: "packet_octets_max",
                value: self.packet_octets_max as u64,
                expected: "256 to 65542",
            });
        }
        if self.repeat_octets < 1 << 16 {
            found.push(DownlinkError::Parameter {
                key: "repeat_octets",
                value: self.repeat_octets,
                expected: "at least 65536",
            });
        }
        found
    }
}
