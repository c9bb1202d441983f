//! The ground's receiving stage where packets come from several senders at once.

use std::sync::{Arc, Mutex, PoisonError};

use super::collector::Collector;
use super::counters::ReceptionCounters;
use super::error::DownlinkError;
use crate::frames::GroundFrame;
use crate::runtime::{Outlet, Stage, Units};

/// Gives every frame once, in the order in which it was sent as far as its reach goes, however many send it.
#[derive(Debug)]
pub struct Gathering {
    collector: Collector,
    account: Arc<Mutex<ReceptionCounters>>,
}

impl Gathering {
    /// Packets wait for those before them until others of `wait_bytes` have come. Leaves its account in `account` at
    /// the end.
    #[must_use]
    pub fn new(wait_bytes: u64, account: Arc<Mutex<ReceptionCounters>>) -> Self {
        Self { collector: Collector::new(wait_bytes), account }
    }

    fn pass_on(&mut self, out: &mut Outlet<GroundFrame>) -> Result<(), DownlinkError> {
        while let Some((_, frame)) = self.collector.next_frame()? {
            out.push(frame);
        }
        Ok(())
    }
}

impl Stage for Gathering {
    type In = Vec<u8>;
    type Out = GroundFrame;
    type Error = DownlinkError;

    fn step(&mut self, bytes: Vec<u8>, out: &mut Outlet<GroundFrame>) -> Result<(), DownlinkError> {
        self.collector.push(&bytes);
        self.pass_on(out)
    }

    fn finish(&mut self, out: &mut Outlet<GroundFrame>) -> Result<(), DownlinkError> {
        self.collector.finish();
        self.pass_on(out)?;
        while let Some((_, frame)) = self.collector.next_waiting() {
            out.push(frame);
        }
        *self.account.lock().unwrap_or_else(PoisonError::into_inner) = self.collector.counters();
        Ok(())
    }

    fn units(&self) -> Units {
        Units::of(self.collector.bytes(), "bytes")
    }
}
