//! State of a collector in a checkpoint.

use std::collections::VecDeque;

use bincode::{Decode, Encode};

use crate::downlink::error::DownlinkError;
use crate::downlink::receive::{DecoderState, HoldBuffer};
use crate::downlink::wire::PacketHeader;
use crate::frames::Instrument;

/// State of a collector in a checkpoint: the held packets and the instrument. Delivered packets are in the journal.
#[derive(Clone, Debug, Default, PartialEq, Encode, Decode)]
pub struct CollectorState {
    pub(super) held: HoldBuffer,
    pub(super) decoder: DecoderState,
}

/// A [`CollectorState`] to be written, without a copy of the held packets.
#[derive(Clone, Debug, PartialEq, Encode)]
pub struct CollectorView<'a> {
    pub(super) held: &'a HoldBuffer,
    pub(super) decoder: DecoderState,
}

impl CollectorState {
    #[must_use]
    pub(super) fn new(wait_bytes: u64) -> Self {
        Self { held: HoldBuffer::new(wait_bytes), decoder: DecoderState::default() }
    }

    /// The instrument; `None` if its description has not arrived.
    pub(super) fn instrument(&self) -> Option<&Instrument> {
        self.decoder.instrument()
    }

    /// Adds the packets held by another collector, except delivered ones.
    pub(super) fn merge(
        &mut self,
        other: Self,
        is_delivered: impl Fn(&PacketHeader) -> bool,
    ) -> Result<(), DownlinkError> {
        if !self.decoder.merge(other.decoder) {
            return Err(DownlinkError::OtherInstrument { offset: 0 });
        }
        for packet in other.held.packets() {
            if self.held.get(&packet.header).is_none() {
                self.held.insert(packet.clone());
            }
        }
        for header in headers(&self.held).iter().filter(|header| is_delivered(header)) {
            self.held.remove(header);
        }
        Ok(())
    }

    /// Whether a collector could have produced this state. Checkpoints are untrusted.
    #[must_use]
    pub fn is_sound(&self) -> bool {
        self.held.is_sound()
    }
}

pub(super) fn headers(held: &HoldBuffer) -> VecDeque<PacketHeader> {
    held.packets().map(|packet| packet.header).collect()
}
