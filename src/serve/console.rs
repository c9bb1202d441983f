//! What all connections read: the run, its maps and its log.

use std::path::PathBuf;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, OnceLock, PoisonError};
use std::time::Instant;

use axum::body::Bytes;

use super::event_log::EventLog;
use super::geometry::Geometry;
use super::pulse::{Pulse, whole_run};
use super::shelf::Shelf;
use super::status::{LedgerStatus, ListenerStatus, Phase, SolverStatus, Status, VisitorStatus, stages_of};
use super::subject::Subject;
use crate::array::EarthModel;
use crate::downlink::transport::packet_archive::{ArchiveReport, PacketArchive};
use crate::ground::{GroundOutcome, HitsMap, PassLine, PowerWaterfall, SavingReport, UvwDensity};
use crate::imaging::Solving;
use crate::pipeline::Watched;
use crate::products::{MapViewer, ProductsReport, ProductsWatch, PublishedMap};
use crate::runtime::{Metrics, StageProgress};
use crate::units::ChannelId;

/// Most senders in a status; it goes out twice a second.
const SENDERS_SHOWN: usize = 20;

/// Numbers of connections and requests.
#[derive(Debug, Default)]
pub(super) struct VisitorCounts {
    pub(super) open: AtomicU64,
    pub(super) refused: AtomicU64,
    pub(super) cut: AtomicU64,
    pub(super) requests: AtomicU64,
}

impl VisitorCounts {
    fn status(&self) -> VisitorStatus {
        VisitorStatus {
            open: self.open.load(Ordering::Relaxed),
            refused: self.refused.load(Ordering::Relaxed),
            cut: self.cut.load(Ordering::Relaxed),
            requests: self.requests.load(Ordering::Relaxed),
        }
    }
}

/// How a run ended.
#[derive(Clone, Debug)]
struct RunEnd {
    error: Option<String>,
    cancelled: bool,
    /// When, since the server's start, s.
    up_s: f64,
}

/// State of the last update, to tell what has changed.
#[derive(Debug, Default)]
struct Memory {
    pulse: Pulse,
    /// The solution being shown: its number, when it was first seen, and its residual then.
    solution: Option<(u64, Instant, f64)>,
    ended: Vec<bool>,
    senders: u64,
    saving: SavingReport,
    products: ProductsReport,
    archive: ArchiveReport,
    status: Option<Status>,
}

/// The run as its visitors see it.
#[derive(Debug)]
pub(super) struct Console {
    pub(super) name: String,
    pub(super) segment: &'static str,
    /// The configuration in JSON.
    pub(super) config: Bytes,
    /// Folder of the state, if there is one.
    pub(super) state: Option<PathBuf>,
    /// Says where the Earth is.
    earth: EarthModel,
    /// Folders on whose disks there has to be room, by what they hold.
    pub(super) folders: Vec<(&'static str, PathBuf)>,
    pub(super) started: Instant,
    pub(super) shelf: Arc<Shelf>,
    pub(super) log: Arc<EventLog>,
    pub(super) visitors: VisitorCounts,
    pub(super) watched: OnceLock<Watched>,
    ending: Mutex<Option<RunEnd>>,
    /// Metrics were read since the run failed.
    pub(super) failure_told: AtomicBool,
    memory: Mutex<Memory>,
}

impl Console {
    pub(super) fn new(subject: Subject) -> Self {
        let Subject { name, segment, config, state, earth, folders } = subject;
        Self {
            name,
            segment,
            config: config.into(),
            state,
            earth,
            folders,
            started: Instant::now(),
            shelf: Arc::default(),
            log: Arc::default(),
            visitors: VisitorCounts::default(),
            watched: OnceLock::new(),
            ending: Mutex::default(),
            failure_told: AtomicBool::new(false),
            memory: Mutex::default(),
        }
    }

    /// Since the server's start, s.
    fn up_s(&self) -> f64 {
        self.started.elapsed().as_secs_f64()
    }

    fn note(&self, is_bad: bool, text: impl Into<String>) {
        self.log.push(self.up_s(), is_bad, text.into());
    }

    /// The run begins.
    pub(super) fn begin(&self, watched: &Watched) {
        let viewer =
            PageViewer { shelf: Arc::clone(&self.shelf), log: Arc::clone(&self.log), started: self.started };
        watched.maps.add_viewer(Box::new(viewer));
        if let Some(ground) = &watched.ground {
            ground.live_view.open();
        }
        if self.watched.set(watched.clone()).is_ok() {
            self.note(false, "the run begins");
        }
    }

    /// The run has ended.
    pub(super) fn end(&self, error: Option<String>, cancelled: bool) {
        let ending = RunEnd { error, cancelled, up_s: self.up_s() };
        match &ending {
            RunEnd { error: Some(error), .. } => self.note(true, format!("the run failed: {error}")),
            RunEnd { cancelled: true, .. } => self.note(true, "the run was ended early"),
            RunEnd { .. } => self.note(false, "the run is complete"),
        }
        *self.ending.lock().unwrap_or_else(PoisonError::into_inner) = Some(ending);
    }

    pub(super) fn phase(&self) -> Phase {
        let ending = self.ending.lock().unwrap_or_else(PoisonError::into_inner);
        match (&*ending, self.watched.get()) {
            (Some(RunEnd { error: Some(_), .. }), _) => Phase::Failed,
            (Some(_), _) => Phase::Ended,
            (None, Some(_)) => Phase::Running,
            (None, None) => Phase::Starting,
        }
    }

    fn memory(&self) -> MutexGuard<'_, Memory> {
        self.memory.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// The newest status, at most one look old.
    pub(super) fn status(&self) -> Status {
        let known = self.memory().status.clone();
        known.unwrap_or_else(|| self.look())
    }

    /// The stages' counters; empty before the run.
    pub(super) fn progress(&self) -> Vec<StageProgress> {
        self.watched.get().map(|watched| Metrics::snapshot(&watched.metrics)).unwrap_or_default()
    }

    fn ground(&self) -> Option<&GroundOutcome> {
        self.watched.get().and_then(|watched| watched.ground.as_ref())
    }

    /// Packets over the mission's time; `None` before the instrument is known.
    pub(super) fn passes(&self) -> Option<Arc<PassLine>> {
        self.ground().and_then(|ground| ground.live_view.passes())
    }

    /// Where everything is; `None` before there are data with positions.
    pub(super) fn geometry(&self) -> Option<Geometry> {
        let now = self.ground()?.live_view.array()?;
        Some(Geometry::of(&now, self.earth))
    }

    /// Baselines of a channel; `None` if it has none.
    pub(super) fn uvw(&self, channel: ChannelId) -> Option<UvwDensity> {
        self.ground()?.live_view.density(channel)
    }

    /// Visibilities of a channel by direction; `None` if it has none. Takes a while.
    pub(super) fn hits(&self, channel: ChannelId) -> Option<HitsMap> {
        let live_view = &self.ground()?.live_view;
        Some(live_view.hits(channel)?.map(live_view.array()?.moon_radius_m))
    }

    /// Powers of the daughters in a channel; `None` if none came.
    pub(super) fn powers(&self, channel: ChannelId) -> Option<PowerWaterfall> {
        self.ground()?.live_view.powers(channel)
    }

    /// Looks at the run, notes what has changed, and keeps the status.
    pub(super) fn look(&self) -> Status {
        let phase = self.phase();
        let progress = self.progress();
        let ending = self.ending.lock().unwrap_or_else(PoisonError::into_inner).clone();
        let watched = self.watched.get();
        let ground = self.ground();
        if let Some(ground) = ground {
            ground.live_view.refresh();
        }
        let now = Instant::now();
        let mut memory = self.memory();
        let up_s = self.up_s();
        let elapsed_s = ending.as_ref().map_or(up_s, |ending| ending.up_s);
        let rates = match ending {
            Some(_) => whole_run(&progress, elapsed_s),
            None => memory.pulse.look(&progress, now),
        };
        let listening = watched.and_then(|watched| watched.listening.as_ref()).map(|listening| {
            let mut report = listening.report();
            report.senders.listed.truncate(SENDERS_SHOWN);
            ListenerStatus {
                open: listening.status.open(),
                bytes: listening.status.bytes(),
                backlog_bytes: listening.status.backlog_bytes(),
                silence_s: listening.status.silence().map(|silence| silence.as_secs_f64()),
                archive: listening.archive.as_ref().map(PacketArchive::report),
                report,
            }
        });
        let solving = watched.and_then(|watched| watched.solving.progress());
        let saving = ground.and_then(|ground| ground.saving.report());
        let read = |ground: &GroundOutcome| {
            let mut reception = ground.reception.lock().unwrap_or_else(PoisonError::into_inner).clone();
            if let Some(listening) = &listening {
                listening.report.complete(&mut reception);
            }
            let completeness = ground.completeness.lock().unwrap_or_else(PoisonError::into_inner).clone();
            (reception, (phase == Phase::Ended).then_some(completeness))
        };
        let (reception, completeness) = ground.map(read).map_or((None, None), |(a, b)| (Some(a), b));
        let status = Status {
            version: env!("CARGO_PKG_VERSION"),
            name: self.name.clone(),
            segment: self.segment,
            phase,
            error: ending.as_ref().and_then(|ending| ending.error.clone()),
            cancelled: ending.is_some_and(|ending| ending.cancelled),
            up_s,
            elapsed_s,
            stages: stages_of(&progress, &rates),
            solving: solving.map(|solving| memory.solver(solving, now)),
            ledger: ground.map(|ground| LedgerStatus::of(ground.ledger.report(), phase == Phase::Ended)),
            completeness,
            reception,
            waiting_bytes: ground.map(|ground| ground.waiting_bytes.load(Ordering::Relaxed)),
            listening,
            saving,
            products: watched.and_then(|watched| watched.products.as_ref()).map(ProductsWatch::report),
            channels: self.shelf.status(),
            has_state: self.state.is_some(),
            visitors: self.visitors.status(),
        };
        for (is_bad, text) in memory.changes(&status) {
            self.note(is_bad, text);
        }
        memory.status = Some(status.clone());
        status
    }
}

impl Memory {
    /// The state of the solver, with the time left.
    fn solver(&mut self, solving: Solving, now: Instant) -> SolverStatus {
        let Solving { number, what, iteration, residual, target, .. } = solving;
        let (_, since, first) = match self.solution {
            Some(seen) if seen.0 == number => seen,
            _ => *self.solution.insert((number, now, residual)),
        };
        let (done, whole) = ((first / residual).ln(), (first / target).ln());
        let elapsed_s = now.duration_since(since).as_secs_f64();
        let is_known = done > 0.05 * whole && elapsed_s > 1.0;
        let left_s = is_known.then(|| elapsed_s * (whole / done - 1.0).max(0.0));
        SolverStatus { what, iteration, residual, target, left_s }
    }

    /// Events since the last update, and whether they need attention.
    fn changes(&mut self, status: &Status) -> Vec<(bool, String)> {
        let mut found = Vec::new();
        self.ended.resize(status.stages.len(), false);
        for (was, stage) in self.ended.iter_mut().zip(&status.stages) {
            if stage.ended && !*was {
                found.push((false, format!("stage {} has ended", stage.name)));
            }
            *was = stage.ended;
        }
        if let Some(listening) = &status.listening {
            let closed = listening.report.connections;
            if closed > self.senders {
                found.push((
                    false,
                    format!("senders: {closed} connections accepted, {} open", listening.open),
                ));
            }
            self.senders = closed;
        }
        if let Some(saving) = &status.saving {
            if saving.written > self.saving.written {
                found.push((false, format!("checkpoint {} of this session is written", saving.written)));
            }
            if saving.unsaved.is_some() && saving.failed > self.saving.failed {
                found.push((true, saving.to_string()));
            }
            self.saving = saving.clone();
        }
        if let Some(products) = &status.products {
            found.extend(change("maps", "written", &self.products.unwritten, &products.unwritten));
            self.products = products.clone();
        }
        if let Some(archive) = status.listening.as_ref().and_then(|listening| listening.archive.as_ref()) {
            found.extend(change("the raw archive", "written", &self.archive.unwritten, &archive.unwritten));
            self.archive = archive.clone();
        }
        found
    }
}

/// The event when something begins to fail, or works again.
fn change(what: &str, done: &str, before: &Option<String>, now: &Option<String>) -> Option<(bool, String)> {
    match (before, now) {
        (None, Some(reason)) => Some((true, format!("{what} cannot be {done}: {reason}"))),
        (Some(_), None) => Some((false, format!("{what}: {done} again"))),
        _ => None,
    }
}

/// Sees maps for the console.
struct PageViewer {
    shelf: Arc<Shelf>,
    log: Arc<EventLog>,
    started: Instant,
}

impl MapViewer for PageViewer {
    fn view(&self, map: PublishedMap<'_>) {
        let said = self.shelf.put(map);
        self.log.push(self.started.elapsed().as_secs_f64(), false, said);
    }
}
