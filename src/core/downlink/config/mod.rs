//! Configuration of the downlink.

mod link;
mod listen;

pub use link::LinkConfig;
pub use listen::ListenConfig;
use serde::{Deserialize, Serialize};

use crate::units::{Checks, InvalidValue, keys};

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

/// Longest packet that the 16-bit length field allows.
pub const PACKET_BYTES_MAX: usize = 65_542;

/// Permitted depths of interleaving.
pub const INTERLEAVES: [usize; 6] = [1, 2, 3, 4, 5, 8];

/// Smallest packet that holds headers and more than one record of any kind.
const PACKET_BYTES_MIN: usize = 256;

/// Maximum number of idle frames before a pass: about a megabyte.
const IDLE_FRAMES_MAX: u32 = 1_000;

keys! {
    /// The `[downlink]` section.
    pub struct DownlinkConfig {
        /// Format: "packets", or "cadu": packets in coded transfer frames.
        everyday format: Format = Format::Packets;
        /// Maximum packet length. A lost packet loses only its own visibilities (21 bytes each).
        expert packet_bytes_max: usize = 8_192;
        /// Bytes after which the instrument description and the current ephemeris are repeated: bounds what one damaged packet
        /// can cost.
        expert repeat_bytes: u64 = 1 << 20;
        /// Reed-Solomon codewords interleaved in a block of "cadu": 1, 2, 3, 4, 5 or 8. Each adds 223 bytes to a frame.
        #[only_with(r#"downlink.format = "cadu""#)]
        expert interleave: usize = 5;
        /// Spacecraft identifier of "cadu" frames.
        #[only_with(r#"downlink.format = "cadu""#)]
        expert spacecraft_id: u8 = 0x4C;
        /// Idle "cadu" frames at the start of each pass: the ground needs one to synchronise.
        #[only_with(r#"downlink.format = "cadu""#)]
        expert idle_frames: u32 = 2;
        /// Maximum rate of the link including coding; 0 for no limit. What exceeds a pass stays on board for later ones; the last
        /// pass sends everything that is left.
        everyday rate_bits_per_s_max: f64 = 0.0;
        /// Faults between spacecraft and ground. A list of them is written beside the file.
        section link: LinkConfig = LinkConfig::default();
        /// Limits of a ground that listens.
        section listen: ListenConfig = ListenConfig::default();
    }
}

impl DownlinkConfig {
    /// The invalid values; empty for a valid configuration.
    #[must_use]
    #[doc(hidden)]
    pub fn problems(&self) -> Vec<InvalidValue> {
        let mut checks = Checks::new("downlink");
        let bytes = self.packet_bytes_max;
        let is_valid = (PACKET_BYTES_MIN..=PACKET_BYTES_MAX).contains(&bytes);
        checks.require("packet_bytes_max", bytes, is_valid, "256 to 65542");
        checks.require("repeat_bytes", self.repeat_bytes, self.repeat_bytes >= 1 << 16, "at least 65536");
        let interleave = self.interleave;
        checks.require("interleave", interleave, INTERLEAVES.contains(&interleave), "1, 2, 3, 4, 5 or 8");
        checks.require("idle_frames", self.idle_frames, self.idle_frames <= IDLE_FRAMES_MAX, "at most 1000");
        let rate = self.rate_bits_per_s_max;
        let expected = "at least 1 bit per second, or 0 for no limit";
        checks.number("rate_bits_per_s_max", rate, rate == 0.0 || rate >= 1.0, expected);
        let mut problems = checks.finish();
        problems.extend(self.link.problems(self.format));
        problems
    }

    /// Bytes sent for each byte of packets: 1279 for 1107 with five codewords a frame.
    #[must_use]
    #[doc(hidden)]
    pub fn expansion(&self) -> f64 {
        match self.format {
            Format::Packets => 1.0,
            Format::Cadu => (4 + 255 * self.interleave) as f64 / (223 * self.interleave - 8) as f64,
        }
    }
}
