//! What a running graph shows: the one view behind progress, events, log, page, notifications and Python.

use std::sync::{Arc, PoisonError};

use crate::calibration::solver::InstrumentEvent;
use crate::calibration::{BurstAlert, FoundBurst};
use crate::downlink::ReceptionCounters;
use crate::downlink::transport::packet_archive::{ArchiveReport, PacketArchive};
use crate::downlink::transport::socket::Listening;
use crate::ground::{GroundOutcome, SavingReport};
use crate::imaging::SolveWatch;
use crate::products::{MapWatch, ProductsWatch};
use crate::runtime::{Graph, Metrics, StageProgress};

/// View of a running graph.
#[derive(Clone, Debug)]
pub struct RunView {
    /// Counters and times of the stages.
    pub metrics: Arc<Metrics>,
    /// Progress of the solution.
    pub solving: SolveWatch,
    /// The senders, if the ground segment listens.
    pub listening: Option<Listening>,
    /// Ledger, reception and checkpoints of the ground segment, if there is one.
    pub ground: Option<GroundOutcome>,
    /// The maps, for display.
    pub maps: MapWatch,
    /// State of the product files; `Some` if a failure to write them does not end the run.
    pub products: Option<ProductsWatch>,
}

impl RunView {
    pub(in crate::pipeline) fn without_ground(graph: &Graph) -> Self {
        let (solving, maps) = (SolveWatch::default(), MapWatch::default());
        Self { metrics: graph.metrics(), solving, listening: None, ground: None, maps, products: None }
    }

    /// What each stage has done so far.
    pub(crate) fn stages(&self) -> Vec<StageProgress> {
        self.metrics.snapshot()
    }

    /// The report on checkpoints.
    pub(crate) fn saving(&self) -> Option<SavingReport> {
        self.ground.as_ref().and_then(|ground| ground.saving.report())
    }

    /// Counters of what was received.
    pub(crate) fn reception(&self) -> Option<ReceptionCounters> {
        let reception = &self.ground.as_ref()?.reception;
        Some(reception.lock().unwrap_or_else(PoisonError::into_inner).clone())
    }

    /// The report on the raw archive.
    pub(crate) fn archive(&self) -> Option<ArchiveReport> {
        self.listening.as_ref()?.archive.as_ref().map(PacketArchive::report)
    }
}

/// A change of a running graph.
#[derive(Clone, Debug)]
pub(crate) enum Change {
    /// A stage has ended.
    StageEnded(String),
    /// A checkpoint was written, or could not be.
    Saving { before: SavingReport, now: SavingReport },
    /// The solver found a change of the instrument.
    Instrument(InstrumentEvent),
    /// A burst was found.
    Burst(Box<FoundBurst>),
    /// There may be a burst in a pass that goes on.
    BurstAlert(BurstAlert),
    /// Products begin to fail to be written, or are written again.
    Products(Option<String>),
    /// The raw archive begins to fail to be written, or is written again.
    Archive(Option<String>),
}

/// What was told of a running graph, to find what has changed since.
#[derive(Debug, Default)]
pub(crate) struct RunChanges {
    ended: Vec<bool>,
    saving: SavingReport,
    instrument: usize,
    bursts: usize,
    alerts: usize,
    products: Option<String>,
    archive: Option<String>,
}

impl RunChanges {
    /// The changes since the last call. `stages` are those of the view now.
    pub(crate) fn next(&mut self, view: &RunView, stages: &[StageProgress]) -> Vec<Change> {
        let mut found = Vec::new();
        self.ended.resize(stages.len(), false);
        for (had_ended, stage) in self.ended.iter_mut().zip(stages) {
            if stage.ended && !std::mem::replace(had_ended, true) {
                found.push(Change::StageEnded(stage.name.clone()));
            }
        }
        if let Some(now) = view.saving() {
            let before = std::mem::replace(&mut self.saving, now.clone());
            if (before.written, before.failed) != (now.written, now.failed) {
                found.push(Change::Saving { before, now });
            }
        }
        if let Some(ground) = &view.ground {
            let gains = ground.gains.as_ref();
            let events = gains.map(|gains| gains.events_since(self.instrument)).unwrap_or_default();
            let bursts = ground.bursts.since(self.bursts);
            (self.instrument, self.bursts) = (self.instrument + events.len(), self.bursts + bursts.len());
            found.extend(events.into_iter().map(Change::Instrument));
            let alerts = ground.bursts.alerts_since(self.alerts);
            self.alerts += alerts.len();
            found.extend(alerts.into_iter().map(Change::BurstAlert));
            found.extend(bursts.into_iter().map(Box::new).map(Change::Burst));
        }
        let products = view.products.as_ref().and_then(|products| products.report().unwritten);
        if fails_or_recovers(&mut self.products, &products) {
            found.push(Change::Products(products));
        }
        let archive = view.archive().and_then(|archive| archive.unwritten);
        if fails_or_recovers(&mut self.archive, &archive) {
            found.push(Change::Archive(archive));
        }
        found
    }
}

/// Whether writing begins to fail, or works again.
fn fails_or_recovers(before: &mut Option<String>, now: &Option<String>) -> bool {
    std::mem::replace(before, now.clone()).is_some() != now.is_some()
}
