//! The source of the space segment when its channels were simulated group by group.

use std::sync::Arc;

use super::integrator::{describe, send_window};
use super::spool::{SpoolError, SpoolReader};
use crate::array::Array;
use crate::daughters::InstrumentErrors;
use crate::frames::{GroundFrame, Instrument, ObservingWindow, VisibilityBlock};
use crate::runtime::{Flow, Outlet, Source, Units};

/// Emits the frames that an [`Integrator`](super::Integrator) of all channels would emit, from the visibilities that integrators of
/// groups of them left on disk.
#[derive(Debug)]
pub struct Merger {
    array: Arc<Array>,
    instrument: Instrument,
    windows: std::vec::IntoIter<ObservingWindow>,
    /// In the order of their channels.
    groups: Vec<SpoolReader>,
    errors: Option<Arc<InstrumentErrors>>,
    sampled: u64,
}

impl Merger {
    /// A source of these windows from groups of channels in the order of their channels.
    #[must_use]
    pub fn new(
        array: Arc<Array>,
        instrument: Instrument,
        windows: Vec<ObservingWindow>,
        groups: Vec<SpoolReader>,
        errors: Option<Arc<InstrumentErrors>>,
    ) -> Self {
        Self { array, instrument, windows: windows.into_iter(), groups, errors, sampled: 0 }
    }
}

impl Source for Merger {
    type Out = GroundFrame;
    type Error = SpoolError;

    fn next(&mut self, out: &mut Outlet<GroundFrame>) -> Result<Flow, SpoolError> {
        let Some(window) = self.windows.next() else { return Ok(Flow::Done) };
        let parts: Vec<Vec<VisibilityBlock>> =
            self.groups.iter_mut().map(SpoolReader::next_window).collect::<Result<_, _>>()?;
        // Auto-correlations of all channels follow the visibilities of all.
        let (mut autos, mut visibilities): (Vec<_>, Vec<_>) =
            parts.into_iter().flatten().partition(|block| block.pair.i == block.pair.j);
        for blocks in [&mut visibilities, &mut autos] {
            // Stable: the order within a channel stays.
            blocks.sort_by_key(|block| block.channel);
        }
        let pass = self.errors.as_ref().map(|errors| errors.pass(window));
        describe(&self.array, &self.instrument, window, pass.as_ref(), out);
        self.sampled += send_window(visibilities.into_iter().chain(autos), window, self.sampled, out);
        Ok(Flow::Continue)
    }

    fn units(&self) -> Units {
        Units::of(self.sampled, "visibilities")
    }
}
