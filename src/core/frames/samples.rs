//! Samples that the daughters send to the mother.

use super::ObservingWindow;
use crate::units::{ChannelId, MissionTime};

/// Complex baseband samples, as separate arrays of real and imaginary parts of equal length.
#[derive(Clone, Debug, PartialEq)]
pub enum Samples {
    /// Floating-point values, sqrt(K sr).
    Float {
        /// Real parts.
        re: Vec<f32>,
        /// Imaginary parts.
        im: Vec<f32>,
    },
    /// Codes of a quantiser: code `c` means `(c + 1/2) step`.
    Codes {
        /// Bits of a code for each of the two parts, 1 to 8.
        bits: u8,
        /// Quantiser step, which is set by the gain, sqrt(K sr).
        step: f32,
        /// Real parts.
        re: Vec<i8>,
        /// Imaginary parts.
        im: Vec<i8>,
    },
}

impl Samples {
    /// Number of complex samples.
    #[must_use]
    pub fn len(&self) -> usize {
        match self {
            Self::Float { re, .. } => re.len(),
            Self::Codes { re, .. } => re.len(),
        }
    }

    /// Whether there are no samples.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Size of the samples on a link, bits.
    #[must_use]
    pub fn bits(&self) -> u64 {
        let bits_per_part = match self {
            Self::Float { .. } => 32,
            Self::Codes { bits, .. } => u64::from(*bits),
        };
        2 * bits_per_part * self.len() as u64
    }
}

/// Consecutive samples of one channel of one daughter.
#[derive(Clone, Debug, PartialEq)]
pub struct SampleBlock {
    /// Channel.
    pub channel: ChannelId,
    /// Daughter, from 0.
    pub daughter: u8,
    /// Number of the block since the start of the window. All blocks of a window except the last have the same length.
    pub number: u64,
    /// Time tag of the first sample, mission time.
    pub time: MissionTime,
    /// Number of real and imaginary parts beyond the quantiser's range.
    pub saturated: u32,
    /// The samples.
    pub samples: Samples,
}

/// A frame from the daughters to the mother. Frames come in order, unless the link drops or delays them.
#[derive(Clone, Debug, PartialEq)]
pub enum SpaceFrame {
    /// The start of a window, before its first block.
    WindowStart(ObservingWindow),
    /// Any number of sample blocks of the window, from any daughters.
    Samples(Vec<SampleBlock>),
    /// The end of a window, after its last block.
    WindowEnd(ObservingWindow),
}
