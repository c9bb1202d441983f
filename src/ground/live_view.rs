//! What visitors may see of a ground at work beyond its counters. Nothing is gathered unless somebody may look, and nothing of
//! it enters a result.

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

/// Most places of a track.
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
    /// Satellite 1 at that time, or as near to it as its velocity is known.
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
    /// Visitors may come at any time.
    is_open: AtomicBool,
    /// Something new is due, even from a ground that never rests.
    is_due: AtomicBool,
    views: Mutex<Views>,
    /// By channel; the ground waits for a copy of one at most, some microseconds.
    densities: Mutex<BTreeMap<ChannelId, UvwDensity>>,
    /// Likewise.
    hits: Mutex<BTreeMap<ChannelId, SkyHits>>,
    /// Likewise.
    powers: Mutex<BTreeMap<ChannelId, PowerWaterfall>>,
}

/// Where visitors see passes, positions and baselines; clones share it. The ground puts the newest there when it rests, and at
/// times while it works.
#[derive(Clone, Debug, Default)]
pub struct LiveView(Arc<Shared>);

impl LiveView {
    /// From now on visitors may come. To be called before the ground begins: what went before is not counted.
    pub fn open(&self) {
        self.0.is_open.store(true, Ordering::Relaxed);
    }

    /// Something new is due from a ground that never rests. To be called at the intervals at which visitors expect that.
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

    /// Where the pairs of a channel stood, of this session.
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

/// When a ground shows itself.
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
    /// That of a live view.
    pub(super) fn of(live_view: &LiveView) -> Self {
        Self { live_view: live_view.clone(), ..Self::default() }
    }

    /// Puts what earlier sessions received into the live view, of which the latest visibilities were made at a time.
    pub(super) fn resume(&mut self, latest_s: Option<f64>, collector: &Collector, ephemeris: &Ephemeris) {
        self.latest_s = self.latest_s.into_iter().chain(latest_s).reduce(f64::max);
        self.put(collector, ephemeris);
    }

    /// A block of auto-correlations that is about to be calibrated, if somebody may look.
    pub(super) fn expect_powers(&self, frame: Option<&GroundFrame>) -> Option<AutoSpan> {
        let Some(GroundFrame::Visibilities(block)) = frame else { return None };
        let (Pair { i, j }, last) = (block.pair, block.len().checked_sub(1)?);
        let length = i64::from(block.offset_ticks[last]) + i64::from(block.duration_ticks[last]);
        let span = [i64::from(block.offset_ticks[0]), length].map(|ticks| block.start.plus_ticks(ticks));
        let is_wanted = i == j && self.live_view.0.is_open.load(Ordering::Relaxed);
        is_wanted.then_some(AutoSpan { channel: block.channel, daughter: i, span })
    }

    /// Notes the powers that a block has become.
    pub(super) fn see_powers(&self, AutoSpan { channel, daughter, span }: AutoSpan, autos: &AutoTable) {
        let mut powers = self.live_view.all_powers();
        if powers.len() < CHANNELS_MAX || powers.contains_key(&channel) {
            let waterfall = powers.entry(channel).or_default();
            autos
                .between(channel, daughter, span)
                .for_each(|(time_s, power)| waterfall.add(daughter, time_s, power));
        }
    }

    /// Notes visibilities that have got their positions.
    pub(super) fn see(&mut self, frame: &PlacedFrame) {
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

    /// Puts the newest into the live view, if it is time for that.
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
