//! State of the calibration in a checkpoint.

use bincode::de::Decoder;
use bincode::enc::Encoder;
use bincode::error::{DecodeError, EncodeError};
use bincode::{Decode, Encode};

use crate::calibration::{FoundBurst, SearchedPasses};
use crate::ground::PassGateState;

#[derive(Clone, Debug, PartialEq)]
pub(in crate::ground) struct CalibrationState {
    /// Number of the calibration that the sums were made with, from 1.
    pub(in crate::ground) version: u32,
    pub(in crate::ground) passes: PassGateState,
    /// The bursts found.
    pub(in crate::ground) bursts: Vec<FoundBurst>,
    /// The passes searched for them. A checkpoint holds both last, and ends before them if there are none; earlier ones lack the passes.
    pub(in crate::ground) searched: Vec<SearchedPasses>,
}

impl Default for CalibrationState {
    fn default() -> Self {
        Self { version: 1, passes: PassGateState::default(), bursts: Vec::new(), searched: Vec::new() }
    }
}

impl CalibrationState {
    pub(in crate::ground) fn is_solved(&self) -> bool {
        self.passes != PassGateState::default()
    }
}

/// Writes nothing for the first calibration without passes and bursts, so that such checkpoints keep the format from before recalibration.
impl Encode for CalibrationState {
    fn encode<E: Encoder>(&self, encoder: &mut E) -> Result<(), EncodeError> {
        if *self == Self::default() {
            return Ok(());
        }
        (self.version, &self.passes).encode(encoder)?;
        match (self.bursts.is_empty(), self.searched.is_empty()) {
            (true, true) => Ok(()),
            (false, true) => self.bursts.encode(encoder),
            (_, false) => (&self.bursts, &self.searched).encode(encoder),
        }
    }
}

/// Reads all but the bursts and their passes, as only the reader of the checkpoint knows whether bytes are left.
impl<Context> Decode<Context> for CalibrationState {
    fn decode<D: Decoder<Context = Context>>(decoder: &mut D) -> Result<Self, DecodeError> {
        let (version, passes) = Decode::decode(decoder)?;
        Ok(Self { version, passes, ..Self::default() })
    }
}

bincode::impl_borrow_decode!(CalibrationState);
