//! The onboard store: holds a window's data until the Earth is in sight.

use std::collections::VecDeque;
use std::convert::Infallible;

use crate::frames::{GroundFrame, Housekeeping};
use crate::runtime::{Outlet, Stage, Units};

/// Bytes that one visibility takes in the store and on the link.
pub const VISIBILITY_BYTES: u64 = 21;

/// Holds frames while the Earth is hidden, and releases them in the pass that follows the window.
///
/// A housekeeping frame closes a window: the Earth is in sight from then on. A block that does not fit
/// is dropped and counted in the housekeeping frame; nothing else is ever dropped.
#[derive(Debug)]
pub struct Store {
    capacity_bytes: u64,
    held: VecDeque<GroundFrame>,
    held_bytes: u64,
    kept: u64,
    dropped: u64,
}

impl Store {
    /// An empty store of `capacity_bytes` for visibilities.
    #[must_use]
    pub fn new(capacity_bytes: u64) -> Self {
        Self { capacity_bytes, held: VecDeque::new(), held_bytes: 0, kept: 0, dropped: 0 }
    }

    fn release(&mut self, out: &mut Outlet<GroundFrame>) {
        for frame in self.held.drain(..) {
            out.push(frame);
        }
        self.held_bytes = 0;
    }
}

impl Stage for Store {
    type In = GroundFrame;
    type Out = GroundFrame;
    type Error = Infallible;

    fn step(&mut self, frame: GroundFrame, out: &mut Outlet<GroundFrame>) -> Result<(), Infallible> {
        match frame {
            GroundFrame::Visibilities(block) => {
                let count = block.len() as u64;
                let bytes = count * VISIBILITY_BYTES;
                if self.held_bytes + bytes > self.capacity_bytes {
                    self.dropped += count;
                } else {
                    self.held_bytes += bytes;
                    self.kept += count;
                    self.held.push_back(GroundFrame::Visibilities(block));
                }
            }
            GroundFrame::Housekeeping(report) => {
                self.release(out);
                let dropped = report.dropped + self.dropped;
                out.push(GroundFrame::Housekeeping(Housekeeping { dropped, ..report }));
            }
            other => self.held.push_back(other),
        }
        Ok(())
    }

    /// A window that was cut short is sent down as far as it went.
    fn finish(&mut self, out: &mut Outlet<GroundFrame>) -> Result<(), Infallible> {
        self.release(out);
        Ok(())
    }

    fn units(&self) -> Units {
        Units::of(self.kept, "visibilities")
    }
}
