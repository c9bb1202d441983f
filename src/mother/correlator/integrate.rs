//! From short dumps to integrations as long as each baseline allows.

use num_complex::Complex32;

use super::kernel::{LANES, ProductSums, product};
use crate::array::{Array, integration_time_s};
use crate::frames::{Flags, ObservingWindow, VisibilityBlock};
use crate::mother::Schedule;
use crate::units::constants::SPEED_OF_LIGHT_M_S;
use crate::units::vector::{norm, scale, sub};
use crate::units::{ChannelId, Pair, TICKS_PER_SECOND, all_pairs};

/// Visibilities of one pair and channel that are held before they are handed on, once powers are settled.
const HELD_MAX: usize = 2048;

/// Weight of a visibility without samples, which is flagged: the downlink takes none that is not positive.
const NO_WEIGHT: f32 = f32::MIN_POSITIVE;

/// An integration with a smaller fraction of its samples is flagged as incomplete: its effective middle may then be off
/// by a twentieth of its length, 2 degrees of fringe.
pub(super) const COMPLETE_MIN: f64 = 0.9;

/// How dumps become integrations.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct DumpRule {
    /// Samples of a dump, in each sub-band where there are such.
    pub dump_samples: usize,
    /// Width of a channel or sub-band, Hz: the rate of samples.
    pub width_hz: f64,
    /// An integration with a smaller part of its samples is flagged as incomplete.
    pub complete_min: f64,
}

impl DumpRule {
    /// Whole dumps that fit into the integration time, at least one.
    #[must_use]
    pub fn dumps(&self, dt_s: f64) -> u64 {
        ((dt_s * self.width_hz / self.dump_samples as f64) as u64).max(1)
    }

    fn ticks(&self, dumps: u64) -> u32 {
        crate::daughters::sample_ticks(dumps * self.dump_samples as u64, self.width_hz) as u32
    }
}

/// What the daughters of one group of channels sent of a dump.
#[derive(Clone, Debug, PartialEq)]
pub struct Presence {
    /// By product and lane: samples of the dump that both daughters sent.
    pub there: Vec<[u32; LANES]>,
    /// By daughter and lane: whether too many of them were out of range.
    pub saturated: Vec<[bool; LANES]>,
}

/// The running integrations of up to `LANES` channels.
pub struct GroupIntegrator {
    first_channel: usize,
    schedules: Vec<Schedule>,
    rule: DumpRule,
    window: ObservingWindow,
    /// Dumps of the window.
    dumps: u64,
    now: u64,
    pairs: Vec<PairLanes>,
    /// Whether powers are known; until then weights stand for powers of one, and all visibilities are held.
    settled: bool,
}

/// One pair in all channels of a group.
struct PairLanes {
    pair: Pair,
    re: [f64; LANES],
    im: [f64; LANES],
    used: [u32; LANES],
    /// Dump in which the integration ends.
    until: [u64; LANES],
    /// The earliest of them.
    due: u64,
    from: [u64; LANES],
    number: [u64; LANES],
    keep: [bool; LANES],
    saturated: [bool; LANES],
    held: Vec<VisibilityBlock>,
}

impl GroupIntegrator {
    /// Integrators of the channels from `first_channel` on, one a schedule, over `dumps` dumps of a window.
    #[must_use]
    pub fn new(
        first_channel: usize,
        schedules: &[Schedule],
        rule: DumpRule,
        array: &Array,
        (window, dumps): (ObservingWindow, u64),
    ) -> Self {
        let pairs = all_pairs(array.satellites()).into_iter().map(PairLanes::new).collect();
        let schedules = schedules[..schedules.len().min(LANES)].to_vec();
        let mut own = Self { first_channel, schedules, rule, window, dumps, now: 0, pairs, settled: false };
        for at in 0..own.pairs.len() {
            for lane in 0..own.schedules.len() {
                own.pairs[at].number[lane] = window.index / own.schedules[lane].every_nth_window.max(1);
                own.open(at, lane, array);
            }
        }
        own
    }

    /// Says that `powers`, of daughters by lane, K sr, are now good enough to weigh products by; what is held gets its
    /// weights.
    pub fn settle(&mut self, powers: &[[f64; LANES]]) {
        if std::mem::replace(&mut self.settled, true) {
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

    /// Adds a dump; `powers` are those of daughters by lane, K sr, by which products are weighted once they are settled.
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
            let both = &presence.there[product(i, j)];
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

    /// Ends all integrations where they are, and hands on what is held.
    pub fn finish(&mut self, powers: &[[f64; LANES]], out: &mut Vec<VisibilityBlock>) {
        for lane in 0..self.schedules.len() {
            for at in 0..self.pairs.len() {
                if self.pairs[at].from[lane] < self.now {
                    self.close(at, lane, powers, out);
                }
            }
        }
        self.settle(powers);
        for lane in 0..self.schedules.len() {
            for at in 0..self.pairs.len() {
                let held = std::mem::take(&mut self.pairs[at].held[lane]);
                if !held.is_empty() {
                    out.push(held);
                }
            }
        }
    }

    /// Begins an integration at the dump that comes.
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
        let power = if self.settled { power_of(own.pair, powers, lane) } else { 1.0 };
        let mean = |sum: f64| if used > 0.0 { (sum / used) as f32 } else { 0.0 };
        block.offset_ticks.push(rule.ticks(from));
        block.duration_ticks.push(rule.ticks(self.now) - rule.ticks(from));
        block.value_k_sr.push(Complex32::new(mean(own.re[lane]), mean(own.im[lane])));
        // Variance of the mean of products of independent samples, in one part: P_i P_j / (2 n).
        block.weight.push(weight_of(2.0 * used / power));
        block.flags.push(flags);
        if self.settled && block.len() >= HELD_MAX {
            out.push(std::mem::take(block));
        }
    }
}

/// Product of a pair's powers, (K sr)^2.
fn power_of(pair: Pair, powers: &[[f64; LANES]], lane: usize) -> f64 {
    powers[usize::from(pair.i)][lane] * powers[usize::from(pair.j)][lane]
}

/// A weight as it goes down.
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

/// The shortest integration of any pair that is correlated, in any channel, s.
#[must_use]
pub fn shortest_integration_s(array: &Array, schedules: &[Schedule]) -> f64 {
    let last = array.satellites() - 1;
    // Breathing changes lengths: the longest chord is that of a period's start. Speeds go with chords.
    let (first, last) = (array.state(0, 0.0), array.state(last, 0.0));
    let chord_m = norm(sub(first.position_m, last.position_m));
    let shortest_s = |schedule: &Schedule| {
        let part = (longest_m(schedule) / chord_m).min(1.0);
        let (v_i, v_j) = (scale(part, first.velocity_m_s), scale(part, last.velocity_m_s));
        integration_time_s(schedule.rule, schedule.frequency_hz, v_i, v_j)
    };
    schedules.iter().map(shortest_s).fold(f64::INFINITY, f64::min)
}

/// Length of the longest baseline that a schedule lets pass, m.
fn longest_m(schedule: &Schedule) -> f64 {
    match schedule.baseline_wavelengths_max {
        0.0 => f64::INFINITY,
        limit => limit * SPEED_OF_LIGHT_M_S / schedule.frequency_hz,
    }
}

/// Samples of a dump that is short against the shortest integration of any channel: an eighth of it or less,
/// but no less than a slice, so that rounding to dumps shortens integrations by an eighth at most; and no less than one
/// of each sub-band.
#[must_use]
pub fn dump_samples(array: &Array, schedules: &[Schedule], rate_hz: f64, sub_bands: usize) -> usize {
    let most = (shortest_integration_s(array, schedules) * rate_hz / 8.0) as usize;
    let samples = [64, 32].into_iter().find(|&samples| samples <= most);
    samples.unwrap_or(crate::mother::correlator::kernel::SLICE).max(sub_bands)
}

/// Seconds of the longest time that offsets in ticks can tell apart in a window.
pub(super) const WINDOW_S_MAX: f64 = u32::MAX as f64 / TICKS_PER_SECOND as f64;
