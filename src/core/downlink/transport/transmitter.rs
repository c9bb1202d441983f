//! The stage that encodes ground frames, on the spacecraft.

use crate::downlink::config::DownlinkConfig;
use crate::downlink::error::DownlinkError;
use crate::downlink::wire::Transmission;
use crate::frames::GroundFrame;
use crate::runtime::{Outlet, Stage, Units};

/// Encodes ground frames as packets or as CADUs, depending on the configuration.
#[derive(Debug)]
pub struct Transmitter {
    transmission: Transmission,
    bytes: u64,
}

impl Transmitter {
    /// A transmitter at the start of a mission.
    ///
    /// # Errors
    /// The first invalid configuration value.
    pub fn new(config: &DownlinkConfig) -> Result<Self, DownlinkError> {
        Ok(Self { transmission: Transmission::new(config)?, bytes: 0 })
    }
}

impl Stage for Transmitter {
    type In = GroundFrame;
    type Out = Vec<u8>;
    type Error = DownlinkError;

    fn step(&mut self, frame: GroundFrame, out: &mut Outlet<Vec<u8>>) -> Result<(), DownlinkError> {
        let mut bytes = Vec::new();
        self.transmission.send(&frame, &mut bytes)?;
        self.bytes += bytes.len() as u64;
        if !bytes.is_empty() {
            out.push(bytes);
        }
        Ok(())
    }

    fn finish(&mut self, out: &mut Outlet<Vec<u8>>) -> Result<(), DownlinkError> {
        let mut bytes = Vec::new();
        self.transmission.finish(&mut bytes);
        self.bytes += bytes.len() as u64;
        if !bytes.is_empty() {
            out.push(bytes);
        }
        Ok(())
    }

    fn units(&self) -> Units {
        Units::of(self.bytes, "bytes")
    }
}
