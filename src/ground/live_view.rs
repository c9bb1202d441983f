//! What visitors of the page see of a ground besides its counters. Nothing is gathered unless the page is served, and no
//! result depends on it.

use std::collections::BTreeMap;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use super::collector::Collector;
use super::pass_line::PassLine;
use super::power_waterfall::PowerWaterfall;
use super::sky_hits::SkyHits;
use super::uvw_density::UvwDensity;
use crate::array::{Ephemeris, SatelliteState};
use crate::calibration::AutoTable;
use crate::frames::{EphemerisSegment, GroundFrame, Instrument, PlacedFrame, PlacedVisibilities};
use crate::units::vector::{Vec3, scale, sub};
use crate::units::{ChannelId, MissionTime, Pair};

/// Most channels of which baselines are counted.
const CHANNELS_MAX: usize = 256;

/// Most points of a track.
const TRACK_MAX: usize = 64;

/// Where the satellites were at the time of the latest data.
#[derive(Clone, Debug, PartialEq)]
pub struct ArrayNow {
    /// Mission epoch: TAI seconds since 1958-01-01.
    pub epoch_tai_s: f64,
    /// Time of the latest visibilities that have positions, s.
    pub time_s: f64,
    /// Radius of the Moon, m.
    pub moon_radius_m: f64,
    /// Positions of the satellites, m, Moon-centred ecliptic axes.
    pub positions_m: Vec<Vec3>,
    /// Satellite 1 at that time, or at the nearest time with a known velocity.
    pub motion: SatelliteState,
    /// First and last time of the positions that came with the latest, s.
    pub known_s: [f64; 2],
    /// Where satellite 1 was between those, m.
    pub track_m: Vec<Vec3>,
}

impl ArrayNow {
    /// At a time; `None` without positions.
    fn at(ephemeris: &Ephemeris, instrument: &Instrument, time_s: f64) -> Option<Self> {
        let covers = |segment: &&EphemerisSegment| {
            segment.start.seconds() <= time_s && time_s <= segment.end().seconds()
        };
        let segment = ephemeris.segments().filter(covers).last()?;
        let satellites = usize::from(segment.satellites);
        let positions_m =
            (0..satellites).map(|n| ephemeris.position_at(time_s, n)).collect::<Option<Vec<_>>>()?;
        let known_s = [segment.start.seconds(), segment.end().seconds()];
        let middle_s = time_s.max(known_s[0] + 1.0).min(known_s[1] - 1.0);
        let [before_m, there_m, after_m] =
            [-1.0, 0.0, 1.0].map(|by_s| ephemeris.position_at(middle_s + by_s, 0));
        let motion =
            SatelliteState { position_m: there_m?, velocity_m_s: scale(0.5, sub(after_m?, before_m?)) };
        let own = segment.positions_m.iter().step_by(satellites.max(1));
        let track_m = own.step_by(segment.nodes().div_ceil(TRACK_MAX)).copied().collect();
        let (epoch_tai_s, moon_radius_m) = (instrument.epoch_tai_s, instrument.moon_radius_m);
        Some(Self { epoch_tai_s, time_s, moon_radius_m, positions_m, motion, known_s, track_m })
    }
}

#[derive(Debug, Default)]
struct Views {
    passes: Option<Arc<PassLine>>,
    array: Option<Arc<ArrayNow>>,
}

#[derive(Debug, Default)]
struct Shared {
    /// Whether visitors may come.
    is_open: AtomicBool,
    /// Whether visitors expect an update, even from a ground that never rests.
    is_due: AtomicBool,
    views: Mutex<Views>,
    /// By channel. The ground waits at most for one copy, some microseconds.
    densities: Mutex<BTreeMap<ChannelId, UvwDensity>>,
    /// Directions seen, by channel; copied like `densities`.
    hits: Mutex<BTreeMap<ChannelId, SkyHits>>,
    /// Likewise.
    powers: Mutex<BTreeMap<ChannelId, PowerWaterfall>>,
}

/// Passes, positions and baselines for visitors of the page; clones share it. The ground updates it when it is idle, and from time to time
/// while it works.
#[derive(Clone, Debug, Default)]
pub struct LiveView(Arc<Shared>);

impl LiveView {
    /// Opens it to visitors. Call it before the ground begins: earlier data are not counted.
    pub fn open(&self) {
        self.0.is_open.store(true, Ordering::Relaxed);
    }

    /// Asks a busy ground for an update. Call it at the intervals at which visitors expect one.
    pub fn refresh(&self) {
        self.0.is_due.store(true, Ordering::Relaxed);
    }

    /// Packets received and missing over the mission.
    #[must_use]
    pub fn passes(&self) -> Option<Arc<PassLine>> {
        self.views().passes.clone()
    }

    /// Where the satellites were at the time of the latest data.
    #[must_use]
    pub fn array(&self) -> Option<Arc<ArrayNow>> {
        self.views().array.clone()
    }

    /// The baselines of a channel of this session.
    #[must_use]
    pub fn density(&self, channel: ChannelId) -> Option<UvwDensity> {
        self.densities().get(&channel).cloned()
    }

    /// Visibilities of this session by direction, for a channel.
    #[must_use]
    pub fn hits(&self, channel: ChannelId) -> Option<SkyHits> {
        self.all_hits().get(&channel).cloned()
    }

    /// The daughters' powers in a channel, of this session.
    #[must_use]
    pub fn powers(&self, channel: ChannelId) -> Option<PowerWaterfall> {
        self.all_powers().get(&channel).cloned()
    }

    fn all_powers(&self) -> MutexGuard<'_, BTreeMap<ChannelId, PowerWaterfall>> {
        self.0.powers.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn all_hits(&self) -> MutexGuard<'_, BTreeMap<ChannelId, SkyHits>> {
        self.0.hits.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn densities(&self) -> MutexGuard<'_, BTreeMap<ChannelId, UvwDensity>> {
        self.0.densities.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn views(&self) -> MutexGuard<'_, Views> {
        self.0.views.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// What a ground is doing when it updates the view.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Activity {
    /// Between two steps of many.
    Working,
    /// Nothing waits to be done, or it has finished.
    Idle,
}

/// Which auto-correlations a block holds.
#[derive(Clone, Copy, Debug)]
pub(super) struct AutoSpan {
    channel: ChannelId,
    daughter: u8,
    span: [MissionTime; 2],
}

/// The ground's side of a [`LiveView`].
#[derive(Debug, Default)]
pub(super) struct LiveViewWriter {
    live_view: LiveView,
    latest_s: Option<f64>,
}

impl LiveViewWriter {
    /// The writer of a live view.
    pub(super) fn of(live_view: &LiveView) -> Self {
        Self { live_view: live_view.clone(), ..Self::default() }
    }

    /// Shows what earlier sessions received; `latest_s` is the time of their latest visibilities.
    pub(super) fn resume(&mut self, latest_s: Option<f64>, collector: &Collector, ephemeris: &Ephemeris) {
        self.latest_s = self.latest_s.into_iter().chain(latest_s).reduce(f64::max);
        self.put(collector, ephemeris);
    }

    /// The span of a block of auto-correlations that is about to be calibrated, if the page is served.
    pub(super) fn expect_powers(&self, frame: Option<&GroundFrame>) -> Option<AutoSpan> {
        let Some(GroundFrame::Visibilities(block)) = frame else { return None };
        let (Pair { i, j }, last) = (block.pair, block.len().checked_sub(1)?);
        let length = i64::from(block.offset_ticks[last]) + i64::from(block.duration_ticks[last]);
        let span = [i64::from(block.offset_ticks[0]), length].map(|ticks| block.start.plus_ticks(ticks));
        let is_wanted = i == j && self.live_view.0.is_open.load(Ordering::Relaxed);
        is_wanted.then_some(AutoSpan { channel: block.channel, daughter: i, span })
    }

    /// Adds the calibrated powers of a block.
    pub(super) fn add_powers(&self, AutoSpan { channel, daughter, span }: AutoSpan, autos: &AutoTable) {
        let mut powers = self.live_view.all_powers();
        if powers.len() < CHANNELS_MAX || powers.contains_key(&channel) {
            let waterfall = powers.entry(channel).or_default();
            autos
                .between(channel, daughter, span)
                .for_each(|(time_s, power)| waterfall.add(daughter, time_s, power));
        }
    }

    /// Adds visibilities with positions.
    pub(super) fn add(&mut self, frame: &PlacedFrame) {
        if let PlacedFrame::Visibilities(placed) = frame
            && self.live_view.0.is_open.load(Ordering::Relaxed)
        {
            self.note(placed);
        }
    }

    fn note(&mut self, placed: &PlacedVisibilities) {
        let latest_s = placed.time_s.last().copied();
        self.latest_s = self.latest_s.into_iter().chain(latest_s).reduce(f64::max);
        let mut densities = self.live_view.densities();
        if densities.len() < CHANNELS_MAX || densities.contains_key(&placed.channel) {
            let density = densities.entry(placed.channel);
            density.or_insert_with(|| UvwDensity::new(placed.frequency_hz)).add(placed);
            let mut hits = self.live_view.all_hits();
            hits.entry(placed.channel).or_insert_with(|| SkyHits::new(placed.frequency_hz)).add(placed);
        }
    }

    /// Updates the live view, if an update is due.
    pub(super) fn show(&self, activity: Activity, collector: &Collector, ephemeris: &Ephemeris) {
        let Shared { is_open, is_due, .. } = &*self.live_view.0;
        let is_open = is_open.load(Ordering::Relaxed);
        let is_time = is_open && (activity == Activity::Idle || is_due.swap(false, Ordering::Relaxed));
        if is_time {
            self.put(collector, ephemeris);
        }
    }

    fn put(&self, collector: &Collector, ephemeris: &Ephemeris) {
        let Some(instrument) = collector.instrument() else { return };
        let passes = PassLine::of(instrument.epoch_tai_s, collector.received());
        let array = self.latest_s.and_then(|latest_s| ArrayNow::at(ephemeris, instrument, latest_s));
        *self.live_view.views() = Views { passes: Some(Arc::new(passes)), array: array.map(Arc::new) };
    }
}
