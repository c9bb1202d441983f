//! The ground's receiving stage where nothing is kept for later sessions.

use std::sync::{Arc, Mutex, PoisonError};

use super::collector::{Collector, Delivery};
use crate::array::Ephemeris;
use crate::downlink::DownlinkError;
use crate::downlink::receive::ReceptionCounters;
use crate::frames::GroundFrame;
use crate::runtime::{Outlet, Stage, Units};

/// Finds packets in what arrives, from one sender or several, and makes frames of them: each once, behind the
/// instrument's description, visibilities behind their positions as far as its reach goes.
#[derive(Debug)]
pub struct Reception {
    collector: Collector,
    /// What has been passed on, to know which visibilities can be placed.
    ephemeris: Ephemeris,
    account: Arc<Mutex<ReceptionCounters>>,
}

impl Reception {
    /// Visibilities wait for positions until `wait_bytes` do; positions of `segments_max` segments are known, as whoever
    /// places them should. Leaves its account in `account` at the end.
    #[must_use]
    pub fn new(wait_bytes: u64, segments_max: usize, account: Arc<Mutex<ReceptionCounters>>) -> Self {
        Self { collector: Collector::new(wait_bytes), ephemeris: Ephemeris::new(segments_max), account }
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

impl Stage for Reception {
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
