//! A stage that turns bytes into frames, without sums.

use std::sync::{Arc, Mutex, PoisonError};

use super::collector::{Collector, Delivery};
use crate::array::Ephemeris;
use crate::downlink::DownlinkError;
use crate::downlink::receive::ReceptionCounters;
use crate::frames::GroundFrame;
use crate::runtime::{Outlet, Stage, Units};

/// Finds packets in the bytes of one or more senders, and emits each frame once, after the description of the instrument.
/// Visibilities follow their ephemeris unless the hold buffer is full.
///
/// [`super::Ground`] does the same before it accumulates sums.
#[derive(Debug)]
pub struct Reception {
    collector: Collector,
    /// Ephemeris segments that were emitted.
    ephemeris: Ephemeris,
    counters: Arc<Mutex<ReceptionCounters>>,
}

impl Reception {
    /// A stage with a hold buffer of `wait_bytes` and an ephemeris of at most `segments_max` segments. It writes `counters`
    /// at the end.
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
