//! The ground's receiving stage where packets come from several senders at once.

use std::sync::{Arc, Mutex, PoisonError};

use crate::array::Ephemeris;
use crate::downlink::{Collector, Delivery, DownlinkError, ReceptionCounters};
use crate::frames::GroundFrame;
use crate::runtime::{Outlet, Stage, Units};

/// Gives every frame once, visibilities behind their positions as far as its reach goes, however many send it.
#[derive(Debug)]
pub struct Gathering {
    collector: Collector,
    /// What has been passed on, to know which visibilities can be placed.
    ephemeris: Ephemeris,
    account: Arc<Mutex<ReceptionCounters>>,
}

impl Gathering {
    /// Visibilities wait for positions until `wait_bytes` do. Leaves its account in
    /// `account` at the end.
    #[must_use]
    pub fn new(wait_bytes: u64, account: Arc<Mutex<ReceptionCounters>>) -> Self {
        Self { collector: Collector::new(wait_bytes), ephemeris: Ephemeris::default(), account }
    }

    fn pass_on(&mut self, out: &mut Outlet<GroundFrame>) -> Result<(), DownlinkError> {
        loop {
            let ephemeris = &self.ephemeris;
            let Some(found) = self.collector.next_delivery(&|stretch| ephemeris.covers(stretch))? else {
                return Ok(());
            };
            self.give(found, out);
        }
    }

    fn give(&mut self, found: Delivery, out: &mut Outlet<GroundFrame>) {
        if let Some(GroundFrame::Ephemeris(segment)) = &found.frame {
            self.ephemeris.insert(segment.clone());
        }
        if let Some(frame) = found.frame {
            out.push(frame);
        }
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
        while let Some(found) = self.collector.next_waiting() {
            self.give(found, out);
        }
        *self.account.lock().unwrap_or_else(PoisonError::into_inner) = self.collector.counters();
        Ok(())
    }

    fn units(&self) -> Units {
        Units::of(self.collector.bytes(), "bytes")
    }
}
