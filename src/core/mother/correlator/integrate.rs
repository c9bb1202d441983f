//! Integration of short dumps, for as long as the motion of each baseline allows.

use num_complex::Complex32;

use super::kernel::{LANES, ProductSums, product};
use crate::array::{Array, EarthOccultation, integration_time_s};
use crate::frames::{Flags, ObservingWindow, VisibilityBlock};
use crate::mother::Schedule;
use crate::units::constants::SPEED_OF_LIGHT_M_S;
use crate::units::vector::{norm, scale, sub};
use crate::units::{ChannelId, Pair, TICKS_PER_SECOND, all_pairs};

/// Maximum number of visibilities in a block of one pair and channel, once the powers are known.
const HELD_MAX: usize = 2048;

/// Weight of a flagged visibility without samples: the downlink accepts positive weights only.
const NO_WEIGHT: f32 = f32::MIN_POSITIVE;

/// An integration with a smaller fraction of its samples is flagged as incomplete: its effective middle may then be off
/// by a twentieth of its length, 2 degrees of fringe.
pub(super) const COMPLETE_MIN: f64 = 0.9;

/// Rule that combines dumps into integrations.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct DumpRule {
    /// Samples per dump; with sub-bands, per sub-band.
    pub dump_samples: usize,
    /// Width of a channel or sub-band, Hz, which is the sample rate.
    pub width_hz: f64,
    /// An integration with a smaller fraction of its samples is flagged as incomplete.
    pub complete_min: f64,
}

impl DumpRule {
    /// Number of whole dumps in the integration time, at least one.
    #[must_use]
    pub fn dumps(&self, dt_s: f64) -> u64 {
        ((dt_s * self.width_hz / self.dump_samples as f64) as u64).max(1)
    }

    fn ticks(&self, dumps: u64) -> u32 {
        crate::daughters::sample_ticks(dumps * self.dump_samples as u64, self.width_hz) as u32
    }
}

/// Samples of a dump that arrived, for one group of channels.
#[derive(Clone, Debug, PartialEq)]
pub struct Presence {
    /// Number of samples that arrived from both daughters, by product and lane.
    pub common: Vec<[u32; LANES]>,
    /// Whether too many samples were out of range, by daughter and lane.
    pub saturated: Vec<[bool; LANES]>,
}

/// The running integrations of up to `LANES` channels.
pub struct GroupIntegrator {
    first_channel: usize,
    schedules: Vec<Schedule>,
    rule: DumpRule,
    window: ObservingWindow,
    /// Occultation of the Earth, if visibilities with the Earth in sight are flagged.
    shadow: Option<EarthOccultation>,
    /// Number of dumps in the window.
    dumps: u64,
    now: u64,
    pairs: Vec<PairLanes>,
    /// Whether the powers are known; until then weights assume unit powers, and all visibilities are held.
    powers_known: bool,
}

/// The integrations of one pair in all channels of a group.
struct PairLanes {
    pair: Pair,
    re: [f64; LANES],
    im: [f64; LANES],
    used: [u32; LANES],
    /// Dump at which the integration ends, by lane.
    until: [u64; LANES],
    /// The earliest end.
    due: u64,
    from: [u64; LANES],
    number: [u64; LANES],
    keep: [bool; LANES],
    saturated: [bool; LANES],
    held: Vec<VisibilityBlock>,
}

impl GroupIntegrator {
    /// Creates integrators of the channels from `first_channel` on, one per schedule, over `dumps` dumps of a window.
    #[must_use]
    pub fn new(
        first_channel: usize,
        schedules: &[Schedule],
        rule: DumpRule,
        array: &Array,
        window: ObservingWindow,
        dumps: u64,
    ) -> Self {
        let pairs = all_pairs(array.satellites()).into_iter().map(PairLanes::new).collect();
        let schedules = schedules[..schedules.len().min(LANES)].to_vec();
        let mut own = Self {
            first_channel,
            schedules,
            rule,
            window,
            shadow: None,
            dumps,
            now: 0,
            pairs,
            powers_known: false,
        };
        for at in 0..own.pairs.len() {
            for lane in 0..own.schedules.len() {
                let Schedule { windows, every_nth, .. } = own.schedules[lane];
                own.pairs[at].number[lane] = windows.first_integration(window.index, every_nth);
                own.open(at, lane, array);
            }
        }
        own
    }

    /// Flags visibilities of pairs of which a daughter sees the Earth.
    #[must_use]
    pub fn with_earth_occultation(self, shadow: Option<EarthOccultation>) -> Self {
        Self { shadow, ..self }
    }

    /// Marks `powers` (by daughter and lane, K sr) as accurate enough for weights, and weights the visibilities held
    /// so far.
    pub fn set_powers_known(&mut self, powers: &[[f64; LANES]]) {
        if std::mem::replace(&mut self.powers_known, true) {
            return;
        }
        for own in &mut self.pairs {
            for (lane, held) in own.held.iter_mut().enumerate() {
                let power = power_of(own.pair, powers, lane);
                for weight in &mut held.weight {
                    *weight = weight_of(f64::from(*weight) / power);
                }
            }
        }
    }

    /// Adds a dump; `powers` (by daughter and lane, K sr) weight the visibilities once they are known.
    pub fn add(
        &mut self,
        sums: &ProductSums,
        presence: &Presence,
        powers: &[[f64; LANES]],
        array: &Array,
        out: &mut Vec<VisibilityBlock>,
    ) {
        self.now += 1;
        for at in 0..self.pairs.len() {
            let pair = &mut self.pairs[at];
            let (i, j) = (usize::from(pair.pair.i), usize::from(pair.pair.j));
            let [re, im] = &sums[product(i, j)];
            let both = &presence.common[product(i, j)];
            for lane in 0..LANES {
                pair.re[lane] += f64::from(re[lane]);
                pair.im[lane] += f64::from(im[lane]);
                pair.used[lane] += both[lane];
                pair.saturated[lane] |= presence.saturated[i][lane] | presence.saturated[j][lane];
            }
            if self.now >= pair.due {
                for lane in 0..self.schedules.len() {
                    if self.now >= self.pairs[at].until[lane] {
                        self.close(at, lane, powers, out);
                        self.open(at, lane, array);
                    }
                }
            }
        }
    }

    /// Ends all integrations and emits all held blocks.
    pub fn finish(&mut self, powers: &[[f64; LANES]], out: &mut Vec<VisibilityBlock>) {
        for lane in 0..self.schedules.len() {
            for at in 0..self.pairs.len() {
                if self.pairs[at].from[lane] < self.now {
                    self.close(at, lane, powers, out);
                }
            }
        }
        self.set_powers_known(powers);
        for lane in 0..self.schedules.len() {
            for at in 0..self.pairs.len() {
                let held = std::mem::take(&mut self.pairs[at].held[lane]);
                if !held.is_empty() {
                    out.push(held);
                }
            }
        }
    }

    /// Starts an integration at the next dump.
    fn open(&mut self, at: usize, lane: usize, array: &Array) {
        let (now, schedule) = (self.now, self.schedules[lane]);
        let t_s = self.window.start.plus_ticks(i64::from(self.rule.ticks(now))).seconds();
        let own = &mut self.pairs[at];
        let (i, j) = (array.state(own.pair.i.into(), t_s), array.state(own.pair.j.into(), t_s));
        let dt_s = integration_time_s(schedule.rule, schedule.frequency_hz, i.velocity_m_s, j.velocity_m_s);
        let near_enough = norm(sub(i.position_m, j.position_m)) < longest_m(&schedule);
        own.keep[lane] = near_enough && own.number[lane].is_multiple_of(schedule.every_nth.max(1));
        own.number[lane] += 1;
        own.from[lane] = now;
        own.until[lane] = (now + self.rule.dumps(dt_s)).min(self.dumps.max(now + 1));
        (own.re[lane], own.im[lane], own.used[lane], own.saturated[lane]) = (0.0, 0.0, 0, false);
        own.due = own.until[..self.schedules.len()].iter().copied().min().unwrap_or(u64::MAX);
    }

    fn close(&mut self, at: usize, lane: usize, powers: &[[f64; LANES]], out: &mut Vec<VisibilityBlock>) {
        let (rule, own) = (self.rule, &mut self.pairs[at]);
        if !own.keep[lane] {
            return;
        }
        let (from, used) = (own.from[lane], f64::from(own.used[lane]));
        let dumps = self.now - from;
        let block = &mut own.held[lane];
        block.channel = ChannelId((self.first_channel + lane) as u16);
        block.pair = own.pair;
        block.start = self.window.start;
        let mut flags = Flags::GOOD;
        if used < rule.complete_min * (dumps * rule.dump_samples as u64) as f64 {
            flags.0 |= Flags::INCOMPLETE.0;
        }
        if own.saturated[lane] {
            flags.0 |= Flags::SATURATED.0;
        }
        let [start, end] =
            [from, self.now].map(|dumps| self.window.start.plus_ticks(rule.ticks(dumps).into()));
        if self.shadow.as_ref().is_some_and(|shadow| !shadow.covers(own.pair, start, end)) {
            flags.0 |= Flags::EARTH.0;
        }
        let power = if self.powers_known { power_of(own.pair, powers, lane) } else { 1.0 };
        let mean = |sum: f64| if used > 0.0 { (sum / used) as f32 } else { 0.0 };
        block.offset_ticks.push(rule.ticks(from));
        block.duration_ticks.push(rule.ticks(self.now) - rule.ticks(from));
        block.value_k_sr.push(Complex32::new(mean(own.re[lane]), mean(own.im[lane])));
        // Variance of the real or imaginary part of a mean of products of independent samples: P_i P_j / (2 n).
        block.weight.push(weight_of(2.0 * used / power));
        block.flags.push(flags);
        if self.powers_known && block.len() >= HELD_MAX {
            out.push(std::mem::take(block));
        }
    }
}

/// Product of a pair's powers, (K sr)^2.
fn power_of(pair: Pair, powers: &[[f64; LANES]], lane: usize) -> f64 {
    powers[usize::from(pair.i)][lane] * powers[usize::from(pair.j)][lane]
}

/// Weight for the downlink: finite and positive.
fn weight_of(weight: f64) -> f32 {
    let weight = weight as f32;
    if weight.is_finite() { weight.max(NO_WEIGHT) } else { NO_WEIGHT }
}

impl PairLanes {
    fn new(pair: Pair) -> Self {
        Self {
            pair,
            re: [0.0; LANES],
            im: [0.0; LANES],
            used: [0; LANES],
            until: [u64::MAX; LANES],
            due: 0,
            from: [0; LANES],
            number: [0; LANES],
            keep: [false; LANES],
            saturated: [false; LANES],
            held: vec![VisibilityBlock::default(); LANES],
        }
    }
}

/// Shortest integration of any correlated pair in any channel, s.
#[must_use]
pub fn shortest_integration_s(array: &Array, schedules: &[Schedule]) -> f64 {
    let last = array.satellites() - 1;
    // Chords are longest at the start of a breathing period, and speeds are proportional to chords.
    let (first, last) = (array.state(0, 0.0), array.state(last, 0.0));
    let chord_m = norm(sub(first.position_m, last.position_m));
    let shortest_s = |schedule: &Schedule| {
        let part = (longest_m(schedule) / chord_m).min(1.0);
        let (v_i, v_j) = (scale(part, first.velocity_m_s), scale(part, last.velocity_m_s));
        integration_time_s(schedule.rule, schedule.frequency_hz, v_i, v_j)
    };
    schedules.iter().map(shortest_s).fold(f64::INFINITY, f64::min)
}

/// Longest baseline of a schedule, m.
fn longest_m(schedule: &Schedule) -> f64 {
    match schedule.baseline_wavelengths_max {
        0.0 => f64::INFINITY,
        limit => limit * SPEED_OF_LIGHT_M_S / schedule.frequency_hz,
    }
}

/// Samples per dump: at most an eighth of the shortest integration of any channel, so that rounding to whole dumps
/// shortens integrations by an eighth at most, but at least one slice and one sample per sub-band.
#[must_use]
pub fn dump_samples(array: &Array, schedules: &[Schedule], rate_hz: f64, sub_bands: usize) -> usize {
    let most = (shortest_integration_s(array, schedules) * rate_hz / 8.0) as usize;
    let samples = [64, 32].into_iter().find(|&samples| samples <= most);
    samples.unwrap_or(crate::mother::correlator::kernel::SLICE).max(sub_bands)
}

/// Longest window whose offsets fit their ticks, s.
pub(super) const WINDOW_S_MAX: f64 = u32::MAX as f64 / TICKS_PER_SECOND as f64;
