//! Bytes to frames, without sums.

use std::sync::{Arc, Mutex, PoisonError};

use super::collector::{Collector, Delivery};
use crate::array::Ephemeris;
use crate::downlink::DownlinkError;
use crate::downlink::receive::ReceptionCounters;
use crate::frames::GroundFrame;
use crate::runtime::{Outlet, Stage, Units};

/// Finds packets in what arrives, from one sender or several, and emits their frames: each once, after the
/// instrument's description, visibilities after their positions as far as the hold buffer reaches.
///
/// [`super::Ground`] does the same on the way to its sums.
#[derive(Debug)]
pub struct Reception {
    collector: Collector,
    /// Positions that were emitted.
    ephemeris: Ephemeris,
    counters: Arc<Mutex<ReceptionCounters>>,
}

impl Reception {
    /// At most `wait_bytes` of visibilities wait for their positions; positions of `segments_max` segments are known.
    /// Leaves its counters in `counters` at the end.
    #[must_use]
    pub fn new(wait_bytes: u64, segments_max: usize, counters: Arc<Mutex<ReceptionCounters>>) -> Self {
        Self { collector: Collector::new(wait_bytes), ephemeris: Ephemeris::new(segments_max), counters }
    }

    fn advance(&mut self, out: &mut Outlet<GroundFrame>) -> Result<(), DownlinkError> {
        loop {
            let ephemeris = &self.ephemeris;
            let Some(delivery) = self.collector.next_delivery(&|outline| ephemeris.covers(outline.span))?
            else {
                return Ok(());
            };
            self.emit(delivery, out);
        }
    }

    fn emit(&mut self, delivery: Delivery, out: &mut Outlet<GroundFrame>) {
        if let Some(GroundFrame::Ephemeris(segment)) = &delivery.frame {
            self.ephemeris.insert(segment.clone());
        }
        if let Some(frame) = delivery.frame {
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
        self.advance(out)
    }

    fn finish(&mut self, out: &mut Outlet<GroundFrame>) -> Result<(), DownlinkError> {
        self.collector.finish();
        self.advance(out)?;
        while let Some(delivery) = self.collector.flush_next() {
            self.emit(delivery, out);
        }
        *self.counters.lock().unwrap_or_else(PoisonError::into_inner) = self.collector.counters();
        Ok(())
    }

    fn units(&self) -> Units {
        Units::of(self.collector.bytes(), "bytes")
    }
}
