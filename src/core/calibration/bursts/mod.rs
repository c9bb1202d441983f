//! Bursts of point sources, such as the Sun's, found in the visibilities of a pass.
//!
//! [`find_bursts`] sees all visibilities of a pass in one channel; [`FoundBursts`] is the table of what was found, which leaves
//! visibilities that arrive later out as well.

mod curve;
mod detect;
mod early;
mod flux;
mod locate;
mod peel;
mod refine;
mod rows;
mod searched;

pub use curve::{BurstEvent, ChannelCurve, FluxPoint, find_events};
pub use detect::find_bursts;
pub use early::{BurstAlert, PassAlerts, find_alerts};
pub(super) use locate::{Sample, locate};
pub use peel::LightCurve;
pub use searched::{PassCounts, SearchedChannel, SearchedPasses};

use std::collections::BTreeMap;
use std::fmt;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use bincode::{Decode, Encode};
use serde::{Deserialize, Serialize, Serializer};

use crate::array::hidden_by_moon;
use crate::frames::PlacedVisibilities;
use crate::sky::healpix::pixel_directions;
use crate::units::vector::Vec3;
use crate::units::{ChannelId, Dimension};

/// Maximum number of bursts in a table, some 60 MB: 24 a day in 30 channels for a year. Later ones stay in the maps.
const BURSTS_MAX: usize = 1 << 18;

/// Alerts of a pass in a channel: what else looks like a burst, as an instrument that fails may at any time, is counted.
const ALERTS_OF_PASS: usize = 8;

/// Alerts, the latest, that a new one may be the same as: those of more than a pass.
const RECENT_ALERTS: usize = 1024;

/// Maximum memory of all light curves. Bursts beyond it are left out.
const CURVES_BYTES_MAX: usize = 1 << 26;

/// What is done with bursts.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum BurstChoice {
    /// Bursts are not looked for.
    #[default]
    Off,
    /// Visibilities in a burst stay out of the sums.
    Flag,
    /// Bursts are reported, and their visibilities are used like others.
    Keep,
    /// The flux of each burst by time is fitted and subtracted, with its error; what a point source does not explain stays out.
    Peel,
}

impl BurstChoice {
    #[allow(clippy::trivially_copy_pass_by_ref)] // As serde calls it.
    pub(super) fn is_off(&self) -> bool {
        *self == Self::Off
    }
}

/// What a search knows besides the visibilities.
#[derive(Clone, Copy, Debug)]
pub struct BurstSearch {
    /// Radius of the Moon, m.
    pub moon_radius_m: f64,
    /// Epoch of the mission, TAI seconds since 1958-01-01.
    pub epoch_tai_s: f64,
    /// What is done with bursts: light curves are fitted only for [`BurstChoice::Peel`].
    pub choice: BurstChoice,
}

/// A burst in one channel.
#[derive(Clone, Debug, PartialEq, Serialize, Encode, Decode)]
pub struct FoundBurst {
    /// Channel, from 0.
    pub channel: u16,
    /// Frequency, Hz.
    pub frequency_hz: f64,
    /// Start, s since the epoch.
    pub from_s: f64,
    /// End, s.
    pub until_s: f64,
    /// Time of the brightest interval, s.
    pub peak_s: f64,
    /// Start and end of the brightest interval, s.
    pub peak_span_s: [f64; 2],
    /// Signal-to-noise ratio of a point source at the position. The noise is that of the visibilities and the steady sky. NaN, as are flux
    /// densities, if not determined.
    pub significance: f64,
    /// Mean flux density in the brightest interval, as an isotropic antenna sees it, Jy.
    pub flux_jy: f64,
    /// Standard deviation of the flux density, Jy.
    pub flux_sigma_jy: f64,
    /// Ecliptic longitude and latitude, deg, the likeliest first, if there is one; others have a likelihood within 99 % of its distribution: daughters in
    /// one plane do not tell its two sides apart.
    pub positions_deg: Vec<[f64; 2]>,
    /// Standard deviations of each position along the longer and the shorter axis of its error ellipse, and the angle of the longer axis from
    /// ecliptic north through east, deg.
    pub position_errors_deg: Vec<[f64; 3]>,
    /// `sun` or `jupiter` if that is within three standard deviations (and two degrees of the Sun, 0.03 of Jupiter) of a position known to
    /// six degrees.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub name: Option<String>,
    /// Where a daughter was in the first, the second and the last third, m.
    #[serde(skip)]
    pub seen_from_m: [Vec3; 3],
    /// Radius of the Moon, m.
    #[serde(skip)]
    pub moon_radius_m: f64,
    /// What is subtracted; absent if the burst is flagged or kept.
    #[serde(skip)]
    pub light_curve: Option<LightCurve>,
}

impl FoundBurst {
    /// Length, s.
    #[must_use]
    pub fn length_s(&self) -> f64 {
        self.until_s - self.from_s
    }

    /// Length of what stays out of the sums, if bursts are peeled or flagged, s.
    #[must_use]
    pub fn left_out_s(&self) -> f64 {
        // The last cell may reach beyond the end.
        self.light_curve.as_ref().map_or(self.length_s(), |curve| curve.unexplained_s().min(self.length_s()))
    }

    /// Whether the values are those of a burst. Checkpoints are untrusted.
    #[must_use]
    pub fn is_sound(&self, channels: usize) -> bool {
        usize::from(self.channel) < channels
            && self.from_s.is_finite()
            && self.length_s() >= 0.0
            && self.light_curve.as_ref().is_none_or(LightCurve::is_sound)
    }

    /// Whether visibility `k` of a block lies in the burst.
    #[must_use]
    pub fn holds(&self, placed: &PlacedVisibilities, k: usize) -> bool {
        let half_s = 0.5 * placed.duration_s.get(k).copied().map_or(0.0, f64::from);
        ChannelId(self.channel) == placed.channel
            && placed.time_s[k] + half_s > self.from_s
            && placed.time_s[k] - half_s < self.until_s
    }
}

impl fmt::Display for FoundBurst {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let hz = Dimension::Frequency.show(self.frequency_hz);
        write!(f, "a burst at {hz} from {:.1} s to {:.1} s: ", self.from_s, self.until_s)?;
        match self.flux_jy.is_finite() {
            true => write!(f, "{:.2e} +- {:.1e} Jy", self.flux_jy, self.flux_sigma_jy)?,
            false => write!(f, "of unknown flux")?,
        }
        if self.significance.is_finite() {
            write!(f, ", {:.0} sigma", self.significance)?;
        }
        let first = self.positions_deg.first().zip(self.position_errors_deg.first());
        if let Some(([longitude, latitude], [longer, shorter, _])) = first {
            write!(
                f,
                ", from ecliptic longitude {longitude:.2}, latitude {latitude:.2} deg (+- {longer:.2}, {shorter:.2})"
            )?;
            match self.positions_deg.len() - 1 {
                0 => {}
                others => write!(f, " or {others} other direction(s)")?,
            }
        }
        if let Some(name) = &self.name {
            write!(f, ": {name}")?;
        }
        Ok(())
    }
}

/// Nside of the directions of a summary: the Moon covers a quarter of the sky.
const NSIDE: usize = 2;

/// Maximum number of bursts that a summary lists.
const LISTED_MAX: usize = 1000;

/// Summary of the bursts of a run.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct BurstSummary {
    /// What is done with their visibilities.
    pub action: BurstChoice,
    /// Number of bursts, counted in each channel.
    pub found: u64,
    /// Channels with bursts.
    pub channels: Vec<BurstHours>,
    /// The bursts; a thousand of them in JSON.
    #[serde(serialize_with = "first_bursts")]
    pub bursts: Vec<FoundBurst>,
    /// The passes of each channel that were searched.
    pub searched: Vec<SearchedPasses>,
}

fn first_bursts<S: Serializer>(bursts: &[FoundBurst], serializer: S) -> Result<S::Ok, S::Error> {
    serializer.collect_seq(bursts.iter().take(LISTED_MAX))
}

/// Time of the bursts in a channel.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct BurstHours {
    /// Frequency, Hz.
    pub frequency_hz: f64,
    /// Number of bursts.
    pub found: u64,
    /// Number of those without direction: beyond 16 in a pass, or where visibilities do not tell.
    pub without_direction: u64,
    /// Total length, h.
    pub hours: f64,
    /// What of it is left out of the map, h.
    pub hours_left_out: f64,
    /// For how long of that each direction was in sight, h: HEALPix of nside 2, RING, ecliptic axes.
    pub hours_left_out_by_direction: Vec<f64>,
}

impl BurstHours {
    fn add(&mut self, burst: &FoundBurst, is_left_out: bool, hats: &[Vec3]) {
        self.found += 1;
        self.without_direction += u64::from(burst.positions_deg.is_empty());
        self.hours += burst.length_s() / 3600.0;
        if !is_left_out {
            return;
        }
        let hours = burst.left_out_s() / 3600.0;
        self.hours_left_out += hours;
        for (hat, lost) in hats.iter().zip(&mut self.hours_left_out_by_direction) {
            let is_seen = |r_m: &&Vec3| !hidden_by_moon(**r_m, *hat, burst.moon_radius_m);
            *lost += hours * burst.seen_from_m.iter().filter(is_seen).count() as f64 / 3.0;
        }
    }
}

impl BurstSummary {
    /// The summary of some bursts and passes; `None` if there are neither.
    #[must_use]
    pub fn new(action: BurstChoice, bursts: Vec<FoundBurst>, searched: Vec<SearchedPasses>) -> Option<Self> {
        let hats = pixel_directions(NSIDE);
        let mut channels: BTreeMap<u16, BurstHours> = BTreeMap::new();
        for burst in &bursts {
            let channel = channels.entry(burst.channel).or_insert_with(|| BurstHours {
                frequency_hz: burst.frequency_hz,
                found: 0,
                without_direction: 0,
                hours: 0.0,
                hours_left_out: 0.0,
                hours_left_out_by_direction: vec![0.0; hats.len()],
            });
            channel.add(burst, action != BurstChoice::Keep, &hats);
        }
        let found = bursts.len() as u64;
        let channels = channels.into_values().collect();
        (found > 0 || !searched.is_empty()).then_some(Self { action, found, channels, bursts, searched })
    }
}

impl fmt::Display for BurstSummary {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let what = match self.action {
            BurstChoice::Flag => "left out",
            BurstChoice::Peel => "subtracted",
            BurstChoice::Off | BurstChoice::Keep => "kept in the maps",
        };
        match self.found {
            0 => write!(f, "none found")?,
            found => write!(f, "{found} bursts, {what}:")?,
        }
        for of_channel in &self.channels {
            let hz = Dimension::Frequency.show(of_channel.frequency_hz);
            let BurstHours { found, without_direction, hours, hours_left_out, .. } = of_channel;
            write!(f, "\n  {hz}: {found} bursts, {hours:.2} hours, {hours_left_out:.2} left out")?;
            if *without_direction > 0 {
                write!(f, ", {without_direction} without direction")?;
            }
            let by_direction = || of_channel.hours_left_out_by_direction.iter().copied();
            let [least, most] =
                [by_direction().fold(f64::INFINITY, f64::min), by_direction().fold(0.0, f64::max)];
            if most > 0.0 {
                write!(f, " ({least:.2} to {most:.2} by direction)")?;
            }
        }
        for passes in self.searched.iter().filter(|passes| passes.not_searched > 0) {
            write!(f, "\n  {passes}")?;
        }
        Ok(())
    }
}

/// The bursts that a ground has found. Clones share them.
#[derive(Clone, Debug, Default)]
pub struct FoundBursts {
    choice: BurstChoice,
    table: Arc<Mutex<BurstTable>>,
}

#[derive(Debug, Default)]
struct BurstTable {
    bursts: Vec<FoundBurst>,
    /// Number of bursts of earlier sessions.
    earlier: usize,
    /// Starts and indices of the bursts of each channel, in the order of time.
    starts: BTreeMap<u16, Vec<(f64, usize)>>,
    /// Length of the longest burst, s.
    longest_s: f64,
    /// Memory of all light curves.
    curves_bytes: usize,
    /// Alerts of this session, before their passes ended.
    alerts: Vec<BurstAlert>,
    /// Number of those that were not told.
    untold: u64,
    /// Passes of any session.
    passes: PassCounts,
}

impl BurstTable {
    fn add(&mut self, mut burst: FoundBurst) {
        let bytes = burst.light_curve.as_ref().map_or(0, LightCurve::bytes);
        if self.curves_bytes + bytes > CURVES_BYTES_MAX {
            burst.light_curve = None;
        } else {
            self.curves_bytes += bytes;
        }
        self.longest_s = self.longest_s.max(burst.length_s());
        let starts = self.starts.entry(burst.channel).or_default();
        let at = starts.partition_point(|(from_s, _)| *from_s <= burst.from_s);
        starts.insert(at, (burst.from_s, self.bursts.len()));
        self.bursts.push(burst);
    }

    /// Whether a burst of a channel has a time in it.
    fn knows(&self, channel: u16, peak_s: f64) -> bool {
        let starts = self.starts.get(&channel).map(Vec::as_slice).unwrap_or_default();
        let from = starts.partition_point(|(from_s, _)| *from_s < peak_s - self.longest_s);
        let until = starts.partition_point(|(from_s, _)| *from_s <= peak_s);
        starts[from..until.max(from)].iter().any(|(_, index)| self.bursts[*index].until_s > peak_s)
    }

    /// Whether an alert is no news.
    fn has_told(&self, alert: &BurstAlert) -> bool {
        self.alerts.iter().rev().take(RECENT_ALERTS).any(|other| other.is_same_as(alert))
            || self.knows(alert.channel, alert.peak_s)
    }

    /// The bursts in the time of a block, and perhaps some beside it, without the first `known`, in the order in which they were found.
    fn about(&self, placed: &PlacedVisibilities, known: usize) -> Vec<&FoundBurst> {
        let starts = self.starts.get(&placed.channel.0).map(Vec::as_slice).unwrap_or_default();
        let Some((&first, &last)) = placed.time_s.first().zip(placed.time_s.last()) else {
            return Vec::new();
        };
        let half_s = 0.5 * placed.duration_s.iter().copied().fold(0.0, f32::max) as f64;
        let from = starts.partition_point(|(from_s, _)| *from_s < first - half_s - self.longest_s);
        let until = starts.partition_point(|(from_s, _)| *from_s <= last + half_s);
        let near = starts[from..until.max(from)].iter().map(|(_, index)| *index);
        let mut indices: Vec<usize> = near.filter(|index| *index >= known).collect();
        indices.sort_unstable();
        indices.into_iter().map(|index| &self.bursts[index]).collect()
    }
}

impl FoundBursts {
    /// An empty table.
    #[must_use]
    pub fn new(choice: BurstChoice) -> Self {
        Self { choice, ..Self::default() }
    }

    fn table(&self) -> MutexGuard<'_, BurstTable> {
        self.table.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// What is done with bursts.
    #[must_use]
    pub fn choice(&self) -> BurstChoice {
        self.choice
    }

    /// Adds a burst; returns whether there was room.
    pub fn add(&self, burst: FoundBurst) -> bool {
        let mut table = self.table();
        let has_room = table.bursts.len() < BURSTS_MAX;
        if has_room {
            table.add(burst);
        }
        has_room
    }

    /// Adds what a look at an open pass finds in a channel, unless there is an alert of its time, or a burst; of a pass only some.
    pub fn alert(&self, pass: &mut PassAlerts, found: Vec<BurstAlert>) {
        let mut table = self.table();
        let mut untold = 0;
        for mut alert in found.into_iter().filter(|alert| !table.has_told(alert)).collect::<Vec<_>>() {
            if pass.told < ALERTS_OF_PASS && table.alerts.len() < BURSTS_MAX {
                pass.told += 1;
                alert.is_last = pass.told == ALERTS_OF_PASS;
                table.alerts.push(alert);
            } else {
                untold += 1;
            }
        }
        // Each look finds those of the earlier ones again.
        table.untold += untold.max(pass.untold) - pass.untold;
        pass.untold = untold.max(pass.untold);
    }

    /// Alerts of this session, except the first `seen`.
    #[must_use]
    pub fn alerts_since(&self, seen: usize) -> Vec<BurstAlert> {
        self.table().alerts.get(seen..).unwrap_or_default().to_vec()
    }

    /// Number of alerts of this session.
    #[must_use]
    pub fn alerts(&self) -> usize {
        self.table().alerts.len()
    }

    /// Number of alerts of this session that were not told, as their pass had had enough of them.
    #[must_use]
    pub fn untold_alerts(&self) -> u64 {
        self.table().untold
    }

    /// Whether a burst of the table has the peak of another in its time. What was subtracted leaves its power in the weights.
    #[must_use]
    pub fn knows(&self, burst: &FoundBurst) -> bool {
        self.table().knows(burst.channel, burst.peak_s)
    }

    /// Whether a burst is subtracted from visibilities of a channel in a span of time.
    #[must_use]
    pub fn subtracts_in(&self, channel: ChannelId, [from_s, until_s]: [f64; 2]) -> bool {
        let is_in = |burst: &FoundBurst| {
            burst.channel == channel.0 && burst.until_s > from_s && burst.from_s < until_s
        };
        self.choice == BurstChoice::Peel && self.table().bursts.iter().any(is_in)
    }

    /// Resumes with the bursts and passes of earlier sessions.
    pub fn resume(&self, bursts: Vec<FoundBurst>, searched: Vec<SearchedPasses>) {
        let mut table = self.table();
        *table = BurstTable { earlier: bursts.len(), ..BurstTable::default() };
        bursts.into_iter().for_each(|burst| table.add(burst));
        searched.into_iter().for_each(|passes| table.passes.add(passes));
    }

    /// Counts a pass.
    pub fn add_pass(&self, channels: &[SearchedChannel]) {
        self.table().passes.add_pass(channels);
    }

    /// The passes of each channel that were searched, in any session.
    #[must_use]
    pub fn searched(&self) -> Vec<SearchedPasses> {
        self.table().passes.list()
    }

    /// All bursts, in the order in which they were found.
    #[must_use]
    pub fn list(&self) -> Vec<FoundBurst> {
        self.table().bursts.clone()
    }

    /// Number of bursts.
    #[must_use]
    pub fn len(&self) -> usize {
        self.table().bursts.len()
    }

    /// Whether no burst was found.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Bursts of this session, except the first `seen`.
    #[must_use]
    pub fn since(&self, seen: usize) -> Vec<FoundBurst> {
        let table = self.table();
        table.bursts.get(table.earlier + seen..).unwrap_or_default().to_vec()
    }

    /// Divides a block by what bursts do to its visibilities; `None` if all are outside, or bursts are kept. The first `known` bursts have been
    /// subtracted from it already.
    #[must_use]
    pub fn divided(&self, placed: &PlacedVisibilities, known: usize) -> Option<DividedBlock> {
        if matches!(self.choice, BurstChoice::Off | BurstChoice::Keep) {
            return None;
        }
        let table = self.table();
        let bursts = table.about(placed, known);
        let is_in_burst = |k: usize| bursts.iter().any(|burst| burst.holds(placed, k));
        if bursts.is_empty() || !(0..placed.len()).any(is_in_burst) {
            return None;
        }
        let mut divided = DividedBlock {
            used: placed.clone(),
            left_out: placed.without_visibilities(),
            as_received: placed.without_visibilities(),
            peeled: placed.without_visibilities(),
        };
        let mut is_left_out = vec![false; placed.len()];
        for (k, is_left_out) in is_left_out.iter_mut().enumerate() {
            for burst in bursts.iter().filter(|burst| burst.holds(placed, k)) {
                let curve = burst.light_curve.as_ref();
                match curve.and_then(|curve| curve.without_burst(&divided.used, k)) {
                    Some((value, weight)) if !*is_left_out => {
                        (divided.used.value_k_sr[k], divided.used.weight[k]) = (value, weight);
                    }
                    _ => *is_left_out = true,
                }
            }
            if *is_left_out {
                divided.left_out.push_from(placed, k);
            } else if is_in_burst(k) {
                divided.as_received.push_from(placed, k);
                divided.peeled.push_from(&divided.used, k);
            }
        }
        let mut used = placed.without_visibilities();
        (0..placed.len()).filter(|k| !is_left_out[*k]).for_each(|k| used.push_from(&divided.used, k));
        Some(DividedBlock { used, ..divided })
    }
}

/// A block whose visibilities lie, in part, in bursts.
#[derive(Clone, Debug)]
pub struct DividedBlock {
    /// What a map uses, in the order of the block.
    pub used: PlacedVisibilities,
    /// What it does not use.
    pub left_out: PlacedVisibilities,
    /// Those used ones that lie in a burst, as they were received.
    pub as_received: PlacedVisibilities,
    /// The same without their bursts.
    pub peeled: PlacedVisibilities,
}

#[cfg(test)]
mod tests;
