//! Source of the space segment for channels that were simulated in groups.

use std::sync::Arc;

use super::integrator::{send_window, send_window_header};
use super::spool::{SpoolError, SpoolReader};
use crate::array::Array;
use crate::daughters::InstrumentErrors;
use crate::frames::{GroundFrame, Instrument, ObservingWindow, VisibilityBlock};
use crate::runtime::{Flow, Outlet, Source, Units};

/// Emits the frames that an [`Integrator`](super::Integrator) of all channels would emit, from the visibilities of
/// groups of channels on disk.
#[derive(Debug)]
pub struct Merger {
    array: Arc<Array>,
    instrument: Instrument,
    windows: std::vec::IntoIter<ObservingWindow>,
    /// Groups, in the order of their channels.
    groups: Vec<SpoolReader>,
    errors: Option<Arc<InstrumentErrors>>,
    sampled: u64,
}

impl Merger {
    /// Creates a source of these windows from groups, in the order of their channels.
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
        // Auto-correlations of all channels follow their visibilities.
        let (mut autos, mut visibilities): (Vec<_>, Vec<_>) =
            parts.into_iter().flatten().partition(|block| block.pair.i == block.pair.j);
        for blocks in [&mut visibilities, &mut autos] {
            // The sort is stable: it keeps the order within a channel.
            blocks.sort_by_key(|block| block.channel);
        }
        let pass = self.errors.as_ref().map(|errors| errors.pass(window));
        send_window_header(&self.array, &self.instrument, window, pass.as_ref(), out);
        self.sampled += send_window(visibilities.into_iter().chain(autos), window, self.sampled, out);
        Ok(Flow::Continue)
    }

    fn units(&self) -> Units {
        Units::of(self.sampled, "visibilities")
    }
}
