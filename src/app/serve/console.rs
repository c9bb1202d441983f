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
use crate::downlink::transport::packet_archive::PacketArchive;
use crate::downlink::transport::socket::StationCounts;
use crate::ground::{GroundOutcome, HitsMap, PassLine, PowerWaterfall, UvwDensity};
use crate::imaging::{SolutionClock, Solving};
use crate::pipeline::{Change, RunChanges, RunView};
use crate::products::{MapViewer, ProductsWatch, PublishedMap};
use crate::runtime::StageProgress;
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
    solution: SolutionClock,
    told: RunChanges,
    senders: u64,
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
    pub(super) handles: OnceLock<RunView>,
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

    pub(super) fn set_run(&self, handles: &RunView) {
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
        self.handles.get().map(RunView::stages).unwrap_or_default()
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

    /// Number of channels that data can have; `None` before the instrument is known.
    pub(super) fn channels(&self) -> Option<usize> {
        self.ground()?.live_view.channels()
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
        let view = self.handles.get();
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
        let listening = view.and_then(|view| view.listening.as_ref()).map(|listening| {
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
        let solving = view.and_then(|view| view.solving.progress());
        let mut reception = view.and_then(RunView::reception);
        if let (Some(reception), Some(listening)) = (&mut reception, &listening) {
            listening.report.complete(reception);
        }
        let completeness = ground
            .filter(|_| phase == Phase::Ended)
            .map(|ground| ground.completeness.lock().unwrap_or_else(PoisonError::into_inner).clone());
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
            solving: solving.map(|solving| last_update.solver(solving)),
            ledger: ground.map(|ground| LedgerStatus::new(ground.ledger.report(), phase == Phase::Ended)),
            completeness,
            reception,
            bursts: ground
                .filter(|ground| ground.bursts.choice() != BurstChoice::Off)
                .map(|ground| ground.bursts.len() as u64),
            burst_alerts: ground
                .filter(|ground| ground.bursts.choice() != BurstChoice::Off)
                .map(|ground| ground.bursts.alerts() as u64),
            burst_alerts_untold: ground
                .filter(|ground| ground.bursts.choice() != BurstChoice::Off)
                .map(|ground| ground.bursts.untold_alerts()),
            waiting_bytes: ground.map(|ground| ground.waiting_bytes.load(Ordering::Relaxed)),
            listening,
            saving: view.and_then(RunView::saving),
            products: view.and_then(|view| view.products.as_ref()).map(ProductsWatch::report),
            channels: self.maps.status(),
            has_state: self.state.is_some(),
            visitors: self.clients.status(),
        };
        let changes = view.map(|view| last_update.told.next(view, &progress)).unwrap_or_default();
        self.log_changes(&changes, &status, &mut last_update.senders);
        last_update.status = Some(status.clone());
        status
    }

    /// Logs what has changed; `senders` is how many were accepted before.
    fn log_changes(&self, changes: &[Change], status: &Status, senders: &mut u64) {
        for (is_bad, text) in changes.iter().filter_map(event_of) {
            self.log_event(is_bad, text);
        }
        if let Some(listening) = &status.listening {
            let accepted = listening.report.connections;
            if accepted > std::mem::replace(senders, accepted) {
                let open = listening.open;
                self.log_event(false, format!("senders: {accepted} connections accepted, {open} open"));
            }
        }
    }
}

impl LastUpdate {
    /// The status of the solver, with an estimate of the time left.
    fn solver(&mut self, solving: Solving) -> SolverStatus {
        let left_s = self.solution.left_s(&solving);
        let Solving { what, iteration, residual, target, .. } = solving;
        SolverStatus { what, iteration, residual, target, left_s }
    }
}

/// The event of a change, and whether it needs attention; `None` for changes that the page does not list.
fn event_of(change: &Change) -> Option<(bool, String)> {
    match change {
        Change::StageEnded(stage) => Some((false, format!("stage {stage} has ended"))),
        Change::Saving { before, now } if now.unsaved.is_some() && now.failed > before.failed => {
            Some((true, now.to_string()))
        }
        Change::Saving { before, now } => (now.written > before.written)
            .then(|| (false, format!("checkpoint {} of this session is written", now.written))),
        Change::Instrument(_) => None,
        Change::Burst(burst) => Some((false, burst.to_string())),
        Change::BurstAlert(alert) => Some((false, alert.to_string())),
        Change::Products(now) => Some(failure_change("maps", now.as_ref())),
        Change::Archive(now) => Some(failure_change("the raw archive", now.as_ref())),
    }
}

/// The event when writing `what` begins to fail, or works again.
fn failure_change(what: &str, now: Option<&String>) -> (bool, String) {
    match now {
        Some(reason) => (true, format!("{what} cannot be written: {reason}")),
        None => (false, format!("{what}: written again")),
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
