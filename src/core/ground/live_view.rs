//! The view of a ground stage for page visitors, other than its counters. It is gathered only if the page is served, and no
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

const CHANNELS_MAX: usize = 256;

const TRACK_MAX: usize = 64;

/// Positions of the satellites at the time of the latest data.
#[derive(Clone, Debug, PartialEq)]
pub struct ArrayGeometry {
    /// Mission epoch: TAI seconds since 1958-01-01.
    pub epoch_tai_s: f64,
    /// Time of the latest visibilities that have positions, s.
    pub time_s: f64,
    /// Radius of the Moon, m.
    pub moon_radius_m: f64,
    /// Positions of the satellites, m, Moon-centred ecliptic axes.
    pub positions_m: Vec<Vec3>,
    /// State of satellite 1 at that time, or at the nearest time with a known velocity.
    pub motion: SatelliteState,
    /// First and last time of the ephemeris segment, s.
    pub known_s: [f64; 2],
    /// Positions of satellite 1 between these times, m.
    pub track_m: Vec<Vec3>,
}

impl ArrayGeometry {
    /// The geometry at a time; `None` if the ephemeris does not cover it.
    fn new(ephemeris: &Ephemeris, instrument: &Instrument, time_s: f64) -> Option<Self> {
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
        let of_first = segment.positions_m.iter().step_by(satellites.max(1));
        let track_m = of_first.step_by(segment.nodes().div_ceil(TRACK_MAX)).copied().collect();
        let (epoch_tai_s, moon_radius_m) = (instrument.epoch_tai_s, instrument.moon_radius_m);
        Some(Self { epoch_tai_s, time_s, moon_radius_m, positions_m, motion, known_s, track_m })
    }
}

#[derive(Debug, Default)]
struct Views {
    channels: Option<usize>,
    passes: Option<Arc<PassLine>>,
    array: Option<Arc<ArrayGeometry>>,
}

#[derive(Debug, Default)]
struct Shared {
    is_open: AtomicBool,
    /// Whether an update is requested even if data arrive without pause.
    is_due: AtomicBool,
    views: Mutex<Views>,
    /// Baselines by channel. The ground stage waits at most for one copy, some microseconds.
    densities: Mutex<BTreeMap<ChannelId, UvwDensity>>,
    hits: Mutex<BTreeMap<ChannelId, SkyHits>>,
    powers: Mutex<BTreeMap<ChannelId, PowerWaterfall>>,
}

/// The view of a ground stage for page visitors. The stage updates it when it is idle, and on request while it works. Clones share it.
#[derive(Clone, Debug, Default)]
pub struct LiveView(Arc<Shared>);

impl LiveView {
    /// Starts gathering. Call it before the stage begins: earlier data are not counted.
    pub fn open(&self) {
        self.0.is_open.store(true, Ordering::Relaxed);
    }

    /// Requests an update from a busy stage. Call it at the intervals at which visitors expect updates.
    pub fn refresh(&self) {
        self.0.is_due.store(true, Ordering::Relaxed);
    }

    /// Number of channels that data can have; `None` before the instrument is known.
    #[must_use]
    pub fn channels(&self) -> Option<usize> {
        self.views().channels
    }

    /// Packets received and missing over the mission.
    #[must_use]
    pub fn passes(&self) -> Option<Arc<PassLine>> {
        self.views().passes.clone()
    }

    /// The positions of the satellites at the time of the latest data.
    #[must_use]
    pub fn array(&self) -> Option<Arc<ArrayGeometry>> {
        self.views().array.clone()
    }

    /// The baselines of a channel in this session.
    #[must_use]
    pub fn density(&self, channel: ChannelId) -> Option<UvwDensity> {
        self.densities().get(&channel).cloned()
    }

    /// The number of visibilities of a channel by direction, in this session.
    #[must_use]
    pub fn hits(&self, channel: ChannelId) -> Option<SkyHits> {
        self.all_hits().get(&channel).cloned()
    }

    /// The powers of the daughters in a channel, in this session.
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

/// Activity of a ground stage when it updates the view.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Activity {
    /// More data are waiting.
    Working,
    /// No data are waiting, or the stage has finished.
    Idle,
}

#[derive(Clone, Copy, Debug)]
pub(super) struct AutoSpan {
    channel: ChannelId,
    daughter: u8,
    span: [MissionTime; 2],
}

#[derive(Debug, Default)]
pub(super) struct LiveViewWriter {
    live_view: LiveView,
    latest_s: Option<f64>,
}

impl LiveViewWriter {
    pub(super) fn new(live_view: &LiveView) -> Self {
        Self { live_view: live_view.clone(), ..Self::default() }
    }

    /// Shows the data of earlier sessions. `latest_s` is the time of their latest visibilities.
    pub(super) fn resume(&mut self, latest_s: Option<f64>, collector: &Collector, ephemeris: &Ephemeris) {
        self.latest_s = self.latest_s.into_iter().chain(latest_s).reduce(f64::max);
        self.put(collector, ephemeris);
    }

    /// The span of a block of auto-correlations; `None` for other frames, or if the page is not served.
    pub(super) fn auto_span(&self, frame: Option<&GroundFrame>) -> Option<AutoSpan> {
        let Some(GroundFrame::Visibilities(block)) = frame else { return None };
        let (Pair { i, j }, last) = (block.pair, block.len().checked_sub(1)?);
        let length = i64::from(block.offset_ticks[last]) + i64::from(block.duration_ticks[last]);
        let span = [i64::from(block.offset_ticks[0]), length].map(|ticks| block.start.plus_ticks(ticks));
        let is_wanted = i == j && self.live_view.0.is_open.load(Ordering::Relaxed);
        is_wanted.then_some(AutoSpan { channel: block.channel, daughter: i, span })
    }

    pub(super) fn add_powers(&self, AutoSpan { channel, daughter, span }: AutoSpan, autos: &AutoTable) {
        let mut powers = self.live_view.all_powers();
        if powers.len() < CHANNELS_MAX || powers.contains_key(&channel) {
            let waterfall = powers.entry(channel).or_default();
            autos
                .between(channel, daughter, span)
                .for_each(|(time_s, power)| waterfall.add(daughter, time_s, power));
        }
    }

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
        let updates = is_open && (activity == Activity::Idle || is_due.swap(false, Ordering::Relaxed));
        if updates {
            self.put(collector, ephemeris);
        }
    }

    fn put(&self, collector: &Collector, ephemeris: &Ephemeris) {
        let Some(instrument) = collector.instrument() else { return };
        let passes = PassLine::new(instrument.epoch_tai_s, collector.received());
        let array = self.latest_s.and_then(|latest_s| ArrayGeometry::new(ephemeris, instrument, latest_s));
        let spectrum = instrument.spectrometer.as_ref().map_or(0, |found| usize::from(found.channels));
        *self.live_view.views() = Views {
            channels: Some(instrument.channels.len() + spectrum),
            passes: Some(Arc::new(passes)),
            array: array.map(Arc::new),
        };
    }
}
