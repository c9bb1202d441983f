//! Encodes ground frames as the bytes of a downlink, in either format, on the spacecraft.

use super::Packetizer;
use super::cadu::CaduEncoder;
use crate::downlink::config::DownlinkConfig;
use crate::downlink::error::DownlinkError;
use crate::frames::GroundFrame;

/// Encodes ground frames as packets, and packets as CADUs if configured.
#[derive(Debug)]
pub struct Transmission {
    packetizer: Packetizer,
    encoder: Option<CaduEncoder>,
    packets: Vec<u8>,
}

impl Transmission {
    /// A transmission at the start of a mission.
    ///
    /// # Errors
    /// The first of [`DownlinkConfig::problems`].
    pub fn new(config: &DownlinkConfig) -> Result<Self, DownlinkError> {
        Ok(Self { packetizer: Packetizer::new(config)?, encoder: config.encoder(), packets: Vec::new() })
    }

    /// Appends the bytes that a frame adds to the downlink. A housekeeping frame ends the pass if data were sent in it, and
    /// begins one otherwise.
    ///
    /// # Errors
    /// The errors of [`Packetizer::encode`].
    pub fn send(&mut self, frame: &GroundFrame, out: &mut Vec<u8>) -> Result<(), DownlinkError> {
        let Some(encoder) = &mut self.encoder else { return self.packetizer.encode(frame, out) };
        self.packets.clear();
        let was_in_pass = self.packetizer.is_in_pass();
        self.packetizer.encode(frame, &mut self.packets)?;
        encoder.encode(&self.packets, out);
        match (matches!(frame, GroundFrame::Housekeeping(_)), was_in_pass) {
            (true, true) => encoder.end_pass(out),
            (true, false) => encoder.flush(out),
            (false, _) => {}
        }
        Ok(())
    }

    /// Appends the bytes that are still buffered.
    pub fn finish(&mut self, out: &mut Vec<u8>) {
        if let Some(encoder) = &mut self.encoder {
            encoder.end_pass(out);
        }
    }
}
