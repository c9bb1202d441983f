//! Samples of the daughters, between them and the mother.

use super::ObservingWindow;
use crate::units::{ChannelId, MissionTime};

/// Complex baseband samples as planes of real and imaginary parts of equal length.
#[derive(Clone, Debug, PartialEq)]
pub enum Samples {
    /// Floats, sqrt(K sr).
    Float {
        /// Real parts.
        re: Vec<f32>,
        /// Imaginary parts.
        im: Vec<f32>,
    },
    /// Levels of a quantiser: a code `c` stands for `(c + 1/2) step`.
    Codes {
        /// Bits of a code, 1 to 8, of each of the two parts.
        bits: u8,
        /// Gain state: distance of two levels, sqrt(K sr).
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

    /// Whether there are none.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Size of the samples on a link, bits.
    #[must_use]
    pub fn bits(&self) -> u64 {
        let each = match self {
            Self::Float { .. } => 32,
            Self::Codes { bits, .. } => u64::from(*bits),
        };
        2 * each * self.len() as u64
    }
}

/// Consecutive samples of one channel of one daughter.
#[derive(Clone, Debug, PartialEq)]
pub struct SampleBlock {
    /// Channel.
    pub channel: ChannelId,
    /// Daughter, from 0.
    pub daughter: u8,
    /// Number of the block since the start of the window; all blocks but the last of a window are equally long.
    pub number: u64,
    /// Time tag of the first sample, by the mission's time.
    pub time: MissionTime,
    /// Real and imaginary parts beyond the quantiser's range.
    pub saturated: u32,
    /// The samples.
    pub samples: Samples,
}

/// Frames from the daughters to the mother, in order except for what the link drops or delays.
#[derive(Clone, Debug, PartialEq)]
pub enum SpaceFrame {
    /// A window begins; before its first block.
    WindowStart(ObservingWindow),
    /// Samples of the window: blocks that travel together, any number of them and from any daughter.
    Samples(Vec<SampleBlock>),
    /// The window has ended; after its last block.
    WindowEnd(ObservingWindow),
}
