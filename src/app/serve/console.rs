//! The state that all connections read: the run, its maps and its log.

use std::path::PathBuf;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, OnceLock, PoisonError};
use std::time::Instant;

use axum::body::Bytes;

use super::event_log::EventLog;
use super::geometry::Geometry;
use super::map_cache::MapCache;
use super::stage_rates::{RateMeter, whole_run_rates};
use super::status::{
    LedgerStatus, ListenerStatus, Phase, SolverStatus, Status, VisitorStatus, stages_of, unix_s,
};
use super::subject::Subject;
use crate::array::EarthModel;
use crate::calibration::BurstChoice;
use crate::downlink::transport::packet_archive::{ArchiveReport, PacketArchive};
use crate::downlink::transport::socket::StationCounts;
use crate::ground::{GroundOutcome, HitsMap, PassLine, PowerWaterfall, SavingReport, UvwDensity};
use crate::imaging::Solving;
use crate::pipeline::RunHandles;
use crate::products::{MapViewer, ProductsReport, ProductsWatch, PublishedMap};
use crate::runtime::{Metrics, StageProgress};
use crate::units::ChannelId;

/// Maximum number of senders in a status, which is sent twice a second.
const SENDERS_SHOWN: usize = 20;

/// Counters of HTTP connections and requests.
#[derive(Debug, Default)]
pub(super) struct ClientCounts {
    pub(super) open: AtomicU64,
    pub(super) refused: AtomicU64,
    pub(super) cut: AtomicU64,
    pub(super) requests: AtomicU64,
}

impl ClientCounts {
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
    /// Time of the end since the server's start, s.
    up_s: f64,
}

/// State of the last update, to find what has changed.
#[derive(Debug, Default)]
struct LastUpdate {
    rates: RateMeter,
    /// The solution in progress: its number, when it was first seen, and its residual at that time.
    solution: Option<(u64, Instant, f64)>,
    ended: Vec<bool>,
    senders: u64,
    bursts: usize,
    saving: SavingReport,
    products: ProductsReport,
    archive: ArchiveReport,
    status: Option<Status>,
}

/// The run as it is served.
#[derive(Debug)]
pub(super) struct Console {
    pub(super) name: String,
    pub(super) segment: &'static str,
    /// The configuration in JSON.
    pub(super) config: Bytes,
    /// Folder of the state, if there is one.
    pub(super) state: Option<PathBuf>,
    /// Motion of the Earth.
    earth: EarthModel,
    /// Folders whose free disk space is reported, by content.
    pub(super) folders: Vec<(&'static str, PathBuf)>,
    pub(super) started: Instant,
    pub(super) maps: Arc<MapCache>,
    pub(super) log: Arc<EventLog>,
    pub(super) clients: ClientCounts,
    pub(super) handles: OnceLock<RunHandles>,
    end: Mutex<Option<RunEnd>>,
    /// Whether metrics were read since the run failed.
    pub(super) is_failure_scraped: AtomicBool,
    last_update: Mutex<LastUpdate>,
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
            maps: Arc::default(),
            log: Arc::default(),
            clients: ClientCounts::default(),
            handles: OnceLock::new(),
            end: Mutex::default(),
            is_failure_scraped: AtomicBool::new(false),
            last_update: Mutex::default(),
        }
    }

    fn up_s(&self) -> f64 {
        self.started.elapsed().as_secs_f64()
    }

    fn log_event(&self, is_bad: bool, text: impl Into<String>) {
        self.log.push(is_bad, text.into());
    }

    pub(super) fn set_run(&self, handles: &RunHandles) {
        let viewer = PageViewer { maps: Arc::clone(&self.maps), log: Arc::clone(&self.log) };
        handles.maps.add_viewer(Box::new(viewer));
        if let Some(ground) = &handles.ground {
            ground.live_view.open();
        }
        if self.handles.set(handles.clone()).is_ok() {
            self.log_event(false, "the run begins");
        }
    }

    pub(super) fn set_end(&self, error: Option<String>, cancelled: bool) {
        let end = RunEnd { error, cancelled, up_s: self.up_s() };
        match &end {
            RunEnd { error: Some(error), .. } => self.log_event(true, format!("the run failed: {error}")),
            RunEnd { cancelled: true, .. } => self.log_event(true, "the run was ended early"),
            RunEnd { .. } => self.log_event(false, "the run is complete"),
        }
        *self.end.lock().unwrap_or_else(PoisonError::into_inner) = Some(end);
    }

    pub(super) fn phase(&self) -> Phase {
        let end = self.end.lock().unwrap_or_else(PoisonError::into_inner);
        match (&*end, self.handles.get()) {
            (Some(RunEnd { error: Some(_), .. }), _) => Phase::Failed,
            (Some(_), _) => Phase::Ended,
            (None, Some(_)) => Phase::Running,
            (None, None) => Phase::Starting,
        }
    }

    fn last_update(&self) -> MutexGuard<'_, LastUpdate> {
        self.last_update.lock().unwrap_or_else(PoisonError::into_inner)
    }

    pub(super) fn status(&self) -> Status {
        let last = self.last_update().status.clone();
        last.unwrap_or_else(|| self.update())
    }

    /// The stages' counters; empty before the run.
    pub(super) fn progress(&self) -> Vec<StageProgress> {
        self.handles.get().map(|handles| Metrics::snapshot(&handles.metrics)).unwrap_or_default()
    }

    fn ground(&self) -> Option<&GroundOutcome> {
        self.handles.get().and_then(|handles| handles.ground.as_ref())
    }

    /// Packets over mission time; `None` before the instrument is known.
    pub(super) fn passes(&self) -> Option<Arc<PassLine>> {
        self.ground().and_then(|ground| ground.live_view.passes())
    }

    /// Positions of satellites, Moon and Earth; `None` before there are data with positions.
    pub(super) fn geometry(&self) -> Option<Geometry> {
        let array = self.ground()?.live_view.array()?;
        Some(Geometry::new(&array, self.earth))
    }

    /// Density of a channel's baselines in uvw; `None` if it has none.
    pub(super) fn uvw(&self, channel: ChannelId) -> Option<UvwDensity> {
        self.ground()?.live_view.density(channel)
    }

    /// Map of a channel's visibilities by direction; `None` if it has none. It is computed on each call.
    pub(super) fn hits(&self, channel: ChannelId) -> Option<HitsMap> {
        let live_view = &self.ground()?.live_view;
        Some(live_view.hits(channel)?.map(live_view.array()?.moon_radius_m))
    }

    /// Auto-correlation powers of a channel over time; `None` if it has none.
    pub(super) fn powers(&self, channel: ChannelId) -> Option<PowerWaterfall> {
        self.ground()?.live_view.powers(channel)
    }

    /// Collects and keeps the status of the run, and logs what has changed.
    pub(super) fn update(&self) -> Status {
        let phase = self.phase();
        let progress = self.progress();
        let end = self.end.lock().unwrap_or_else(PoisonError::into_inner).clone();
        let handles = self.handles.get();
        let ground = self.ground();
        if let Some(ground) = ground {
            ground.live_view.refresh();
        }
        let now = Instant::now();
        let mut last_update = self.last_update();
        let up_s = self.up_s();
        let elapsed_s = end.as_ref().map_or(up_s, |end| end.up_s);
        let rates = match end {
            Some(_) => whole_run_rates(&progress, elapsed_s),
            None => last_update.rates.sample(&progress, now),
        };
        let listening = handles.and_then(|handles| handles.listening.as_ref()).map(|listening| {
            let mut report = listening.report();
            report.senders.listed.truncate(SENDERS_SHOWN);
            let silence_s = |counts: &StationCounts| Some(counts.heard?.elapsed().as_secs_f64());
            ListenerStatus {
                station_silence_s: report
                    .stations
                    .iter()
                    .map(|(name, of)| (name.clone(), silence_s(of)))
                    .collect(),
                open: listening.status.open(),
                bytes: listening.status.bytes(),
                backlog_bytes: listening.status.backlog_bytes(),
                silence_s: listening.status.silence().map(|silence| silence.as_secs_f64()),
                archive: listening.archive.as_ref().map(PacketArchive::report),
                report,
            }
        });
        let solving = handles.and_then(|handles| handles.solving.progress());
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
            error: end.as_ref().and_then(|end| end.error.clone()),
            cancelled: end.is_some_and(|end| end.cancelled),
            unix_s: unix_s(),
            up_s,
            elapsed_s,
            stages: stages_of(&progress, &rates),
            solving: solving.map(|solving| last_update.solver(solving, now)),
            ledger: ground.map(|ground| LedgerStatus::new(ground.ledger.report(), phase == Phase::Ended)),
            completeness,
            reception,
            bursts: ground
                .filter(|ground| ground.bursts.choice() != BurstChoice::Off)
                .map(|ground| ground.bursts.len() as u64),
            waiting_bytes: ground.map(|ground| ground.waiting_bytes.load(Ordering::Relaxed)),
            listening,
            saving,
            products: handles.and_then(|handles| handles.products.as_ref()).map(ProductsWatch::report),
            channels: self.maps.status(),
            has_state: self.state.is_some(),
            visitors: self.clients.status(),
        };
        for (is_bad, text) in last_update.changes(&status) {
            self.log_event(is_bad, text);
        }
        for burst in ground.map(|ground| ground.bursts.since(last_update.bursts)).unwrap_or_default() {
            self.log_event(false, burst.to_string());
            last_update.bursts += 1;
        }
        last_update.status = Some(status.clone());
        status
    }
}

impl LastUpdate {
    /// The status of the solver, with an estimate of the time left.
    fn solver(&mut self, solving: Solving, now: Instant) -> SolverStatus {
        let Solving { number, what, iteration, residual, target, .. } = solving;
        let (_, since, first) = match self.solution {
            Some(seen) if seen.0 == number => seen,
            _ => *self.solution.insert((number, now, residual)),
        };
        let (done, total) = ((first / residual).ln(), (first / target).ln());
        let elapsed_s = now.duration_since(since).as_secs_f64();
        let is_known = done > 0.05 * total && elapsed_s > 1.0;
        let left_s = is_known.then(|| elapsed_s * (total / done - 1.0).max(0.0));
        SolverStatus { what, iteration, residual, target, left_s }
    }

    /// Events since the last update, and whether they need attention.
    fn changes(&mut self, status: &Status) -> Vec<(bool, String)> {
        let mut found = Vec::new();
        self.ended.resize(status.stages.len(), false);
        for (had_ended, stage) in self.ended.iter_mut().zip(&status.stages) {
            if stage.ended && !*had_ended {
                found.push((false, format!("stage {} has ended", stage.name)));
            }
            *had_ended = stage.ended;
        }
        if let Some(listening) = &status.listening {
            let accepted = listening.report.connections;
            if accepted > self.senders {
                found.push((
                    false,
                    format!("senders: {accepted} connections accepted, {} open", listening.open),
                ));
            }
            self.senders = accepted;
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
            found.extend(failure_change("maps", &self.products.unwritten, &products.unwritten));
            self.products = products.clone();
        }
        if let Some(archive) = status.listening.as_ref().and_then(|listening| listening.archive.as_ref()) {
            found.extend(failure_change("the raw archive", &self.archive.unwritten, &archive.unwritten));
            self.archive = archive.clone();
        }
        found
    }
}

/// The event when writing `what` begins to fail, or works again.
fn failure_change(what: &str, before: &Option<String>, now: &Option<String>) -> Option<(bool, String)> {
    match (before, now) {
        (None, Some(reason)) => Some((true, format!("{what} cannot be written: {reason}"))),
        (Some(_), None) => Some((false, format!("{what}: written again"))),
        _ => None,
    }
}

struct PageViewer {
    maps: Arc<MapCache>,
    log: Arc<EventLog>,
}

impl MapViewer for PageViewer {
    fn view(&self, map: PublishedMap<'_>) {
        let description = self.maps.put(map);
        self.log.push(false, description);
    }
}
