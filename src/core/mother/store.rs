//! Onboard store: holds data until the Earth is in sight, and releases them at the rate of the link.

use std::cmp::Reverse;
use std::collections::{BTreeMap, BTreeSet};
use std::convert::Infallible;
use std::sync::Arc;

use super::config::{SpacecraftConfig, StoreDrop};
use super::sizes::VISIBILITY_BYTES;
use crate::array::{Array, earth_in_sight_s};
use crate::frames::{GroundFrame, Housekeeping, VisibilityBlock};
use crate::runtime::{Outlet, Stage, Units};

/// A downlink of limited rate that works while the Earth is in sight.
#[derive(Clone, Debug)]
pub struct PacedLink {
    /// The array, whose orbit determines when the Earth is in sight.
    pub array: Arc<Array>,
    /// Payload rate, bytes/s.
    pub bytes_per_s: f64,
}

/// A block in the store.
#[derive(Debug)]
struct HeldBlock {
    window: u64,
    value: Value,
    rank: Rank,
    block: VisibilityBlock,
}

/// Value of a byte, in seconds of typical data: the bits of a non-negative f64, which sort like the number itself.
type Value = u64;

/// Visibilities of a block are dropped in fractions of 1 / `PARTS`, so that the block is not copied for every one.
/// All blocks of a window are thus cut at the same time, to within one fraction.
const PARTS: usize = 32;

/// Order in which a full store drops blocks, lowest first: the value, or the time as (window, ticks), inverted if the
/// latest are dropped first.
type Rank = (u64, u32);

/// End of a block from which visibilities are dropped.
#[derive(Clone, Copy, Debug)]
enum StoreEnd {
    Front,
    Back,
}

/// Stage that holds frames while the Earth is hidden, and releases them in the following passes, oldest first.
///
/// A housekeeping frame closes a window: the Earth is in sight from then until the next window begins. Data that do
/// not fit into a pass stay for the next one, and are sent after their positions. At the end of the mission a last
/// pass empties the store.
///
/// A pass begins, after the instrument's description, and ends with the same report of the counts: if the end of the
/// pass is lost, the ground still learns how much it contained. The reports of the last pass apply to all time.
///
/// When the store is full, visibilities are dropped according to [`StoreDrop`] and counted in the reports of the
/// pass. Nothing else is ever dropped.
#[derive(Debug)]
pub struct Store {
    capacity_bytes: u64,
    drop: StoreDrop,
    link: Option<PacedLink>,
    /// Index of the window that is being observed.
    window: u64,
    /// Instrument and ephemeris frames that precede the visibilities of a window, by window.
    descriptions: BTreeMap<u64, Vec<GroundFrame>>,
    /// Blocks by arrival number.
    held: BTreeMap<u64, HeldBlock>,
    /// Blocks by rank; within a rank the latest arrival is first.
    by_rank: BTreeSet<(Rank, Reverse<u64>)>,
    held_bytes: u64,
    blocks: u64,
    /// Sums of the weights and of the durations, s, of all good visibilities so far, by channel.
    typical: BTreeMap<u16, [f64; 2]>,
    /// Frame that closes the current pass.
    closing: Option<Housekeeping>,
    kept: u64,
    dropped: u64,
}

impl Store {
    /// Creates an empty store before a link; without a link everything is sent at once.
    #[must_use]
    pub fn new(config: &SpacecraftConfig, link: Option<PacedLink>) -> Self {
        Self {
            capacity_bytes: config.store_bytes_max,
            drop: config.store_drop,
            link,
            window: 0,
            descriptions: BTreeMap::new(),
            held: BTreeMap::new(),
            by_rank: BTreeSet::new(),
            held_bytes: 0,
            blocks: 0,
            typical: BTreeMap::new(),
            closing: None,
            kept: 0,
            dropped: 0,
        }
    }

    /// Stores a block, then drops what exceeds the capacity.
    fn put(&mut self, block: VisibilityBlock) {
        let (value, number) = (self.value(&block), self.blocks);
        self.blocks += 1;
        self.held_bytes += VISIBILITY_BYTES * block.len() as u64;
        self.kept += block.len() as u64;
        let rank = self.rank(self.window, value, &block);
        self.by_rank.insert((rank, Reverse(number)));
        self.held.insert(number, HeldBlock { window: self.window, value, rank, block });
        while self.held_bytes > self.capacity_bytes {
            let too_many = (self.held_bytes - self.capacity_bytes).div_ceil(VISIBILITY_BYTES);
            let Some(dropped_block) = self.drop_first(too_many) else { break };
            self.kept -= dropped_block;
            self.dropped += dropped_block;
        }
    }

    /// Rank of a block in the order of dropping: by value, or by the time of its first or last visibility,
    /// independent of the order of arrival.
    fn rank(&self, window: u64, value: Value, block: &VisibilityBlock) -> Rank {
        let ticks = |offset: Option<&u32>| offset.copied().unwrap_or(0);
        match self.drop {
            StoreDrop::Oldest => (window, ticks(block.offset_ticks.first())),
            StoreDrop::Newest => (!window, !ticks(block.offset_ticks.last())),
            StoreDrop::LowestValue => (value, 0),
        }
    }

    /// Drops up to `count` visibilities of the lowest-ranked block: those that rank below all other blocks, but at least
    /// one `PARTS`-th of the block. Returns the number dropped.
    fn drop_first(&mut self, count: u64) -> Option<u64> {
        let mut order = self.by_rank.iter();
        let (_, Reverse(number)) = *order.next()?;
        let next = order.next().map(|(rank, _)| *rank);
        let held = self.held.get(&number)?;
        let offsets = &held.block.offset_ticks;
        let least = offsets.len().div_ceil(PARTS);
        let (below_next, end) = match (self.drop, next) {
            (StoreDrop::Oldest, Some((window, ticks))) if window == held.window => {
                (offsets.partition_point(|&offset| offset <= ticks), StoreEnd::Front)
            }
            (StoreDrop::Newest, Some((window, ticks))) if !window == held.window => {
                (offsets.len() - offsets.partition_point(|&offset| offset < !ticks), StoreEnd::Back)
            }
            (StoreDrop::Oldest, _) => (offsets.len(), StoreEnd::Front),
            (StoreDrop::Newest | StoreDrop::LowestValue, _) => (offsets.len(), StoreEnd::Back),
        };
        let dropped_block = self.remove(number, count.min(below_next.max(least) as u64), end)?;
        Some(dropped_block.len() as u64)
    }

    /// Value of a byte of a block: its weight relative to the mean weight of a second of good data of its channel so
    /// far. Flagged data have no value.
    fn value(&mut self, block: &VisibilityBlock) -> Value {
        let [weights, seconds] = self.typical.entry(block.channel.0).or_default();
        let mut weight = 0.0;
        for k in (0..block.len()).filter(|&k| block.flags[k].is_good()) {
            weight += f64::from(block.weight[k]);
            *seconds += f64::from(block.duration_ticks[k]) * 1e-6;
        }
        *weights += weight;
        let value = weight * *seconds / (*weights * block.len() as f64);
        // 0 / 0 if there are no good data yet.
        if value > 0.0 { value.to_bits() } else { 0 }
    }

    /// Removes `count` visibilities from one end of a block, or the whole block.
    fn remove(&mut self, number: u64, count: u64, end: StoreEnd) -> Option<VisibilityBlock> {
        let held = self.held.get_mut(&number)?;
        let length = held.block.len();
        let count = usize::try_from(count).map_or(length, |count| count.min(length));
        self.held_bytes -= VISIBILITY_BYTES * count as u64;
        self.by_rank.remove(&(held.rank, Reverse(number)));
        if count == length {
            return self.held.remove(&number).map(|held| held.block);
        }
        let taken = match end {
            StoreEnd::Back => held.block.split_off(length - count),
            StoreEnd::Front => {
                let rest = held.block.split_off(count);
                std::mem::replace(&mut held.block, rest)
            }
        };
        let held = self.held.get(&number)?;
        let rank = self.rank(held.window, held.value, &held.block);
        self.by_rank.insert((rank, Reverse(number)));
        self.held.get_mut(&number)?.rank = rank;
        Some(taken)
    }

    /// Sends the windows before window `until`, up to `bytes` bytes. The report precedes the first frame other than
    /// an instrument description, without which no packet can be read.
    fn send(
        &mut self,
        until: u64,
        bytes: Option<u64>,
        mut report: Option<Housekeeping>,
        out: &mut Outlet<GroundFrame>,
    ) {
        let mut left = bytes.unwrap_or(u64::MAX);
        while let Some(window) = self.descriptions.keys().next().copied().filter(|window| *window < until) {
            let descriptions = self.descriptions.remove(&window).unwrap_or_default();
            for frame in &descriptions {
                left = left.saturating_sub(description_bytes(frame));
                if !matches!(frame, GroundFrame::Instrument(_)) {
                    push_report(&mut report, out);
                }
                out.push(frame.clone());
            }
            while let Some((&number, _)) =
                self.held.first_key_value().filter(|(_, held)| held.window == window)
            {
                if left < VISIBILITY_BYTES {
                    // The rest of the window needs these frames again.
                    self.descriptions.insert(window, descriptions);
                    return;
                }
                let Some(block) = self.remove(number, left / VISIBILITY_BYTES, StoreEnd::Front) else {
                    break;
                };
                left -= VISIBILITY_BYTES * block.len() as u64;
                push_report(&mut report, out);
                out.push(GroundFrame::Visibilities(block));
            }
            if left < VISIBILITY_BYTES {
                return;
            }
        }
    }

    /// Ends the current pass, if there is one, at `time_s`; `None` for the last pass, which sends everything.
    fn end_pass(&mut self, time_s: Option<f64>, out: &mut Outlet<GroundFrame>) {
        let Some(closing) = self.closing.take() else { return };
        let bytes = self.link.as_ref().zip(time_s).map(|(link, time_s)| {
            let sight_s = earth_in_sight_s(&link.array, closing.time.seconds(), time_s);
            (sight_s * link.bytes_per_s) as u64
        });
        // Nothing is dropped while a pass is sent.
        let dropped = closing.dropped + self.dropped;
        let is_last = time_s.is_none() && self.held.values().all(|held| held.window < self.window);
        let time = if is_last { Housekeeping::FOREVER } else { closing.time };
        let report = Housekeeping { time, dropped, ..closing };
        self.send(self.window, bytes, Some(report), out);
        out.push(GroundFrame::Housekeeping(report));
    }
}

fn push_report(report: &mut Option<Housekeeping>, out: &mut Outlet<GroundFrame>) {
    if let Some(report) = report.take() {
        out.push(GroundFrame::Housekeeping(report));
    }
}

/// Approximate size of a description on the link: 24 bytes per position.
fn description_bytes(frame: &GroundFrame) -> u64 {
    match frame {
        GroundFrame::Ephemeris(segment) => 64 + 24 * segment.positions_m.len() as u64,
        _ => 512,
    }
}

impl Stage for Store {
    type In = GroundFrame;
    type Out = GroundFrame;
    type Error = Infallible;

    fn step(&mut self, frame: GroundFrame, out: &mut Outlet<GroundFrame>) -> Result<(), Infallible> {
        match frame {
            GroundFrame::Visibilities(block) => {
                self.end_pass(Some(block.start.seconds()), out);
                if !block.is_empty() {
                    self.descriptions.entry(self.window).or_default();
                    self.put(block);
                }
            }
            GroundFrame::Housekeeping(report) => {
                // After a window without data the time with the Earth hidden does not count.
                self.end_pass(Some(report.time.seconds()), out);
                self.closing = Some(report);
                self.window += 1;
            }
            other => self.descriptions.entry(self.window).or_default().push(other),
        }
        Ok(())
    }

    /// Sends everything; an interrupted window as far as it was observed.
    fn finish(&mut self, out: &mut Outlet<GroundFrame>) -> Result<(), Infallible> {
        self.end_pass(None, out);
        self.send(u64::MAX, None, None, out);
        Ok(())
    }

    fn units(&self) -> Units {
        Units::of(self.kept, "visibilities")
    }
}

#[cfg(test)]
mod tests {
    use num_complex::Complex32;

    use super::*;
    use crate::array::{ArrayConfig, ObservingWindows, segments_for};
    use crate::frames::{Flags, ObservingWindow};
    use crate::units::{ChannelId, Pair};

    const COUNT: usize = 1_000;

    fn block(window: &ObservingWindow, j: u8, duration_ticks: u32) -> VisibilityBlock {
        VisibilityBlock {
            channel: ChannelId(0),
            pair: Pair { i: 0, j },
            start: window.start,
            offset_ticks: (0..COUNT as u32).map(|k| k * duration_ticks).collect(),
            duration_ticks: vec![duration_ticks; COUNT],
            value_k_sr: vec![Complex32::ONE; COUNT],
            weight: vec![duration_ticks as f32; COUNT],
            flags: vec![Flags::GOOD; COUNT],
        }
    }

    /// Processes windows of two blocks each; returns the frames sent, pass by pass.
    fn passes(store: &mut Store, windows: &[ObservingWindow]) -> Vec<Vec<GroundFrame>> {
        let array = Array::new(&ArrayConfig::default()).unwrap();
        let (mut out, mut sampled) = (Outlet::collect(), 0);
        for window in windows {
            for segment in segments_for(&array, window.start, window.end, 300.0) {
                store.step(GroundFrame::Ephemeris(segment), &mut out).unwrap();
            }
            for (j, duration_ticks) in [(1, 200_000), (2, 100_000)] {
                store.step(GroundFrame::Visibilities(block(window, j, duration_ticks)), &mut out).unwrap();
                sampled += COUNT as u64;
            }
            let report = Housekeeping { time: window.end, sampled, dropped: 0 };
            store.step(GroundFrame::Housekeeping(report), &mut out).unwrap();
        }
        store.finish(&mut out).unwrap();
        let frames = out.into_vec();
        let passes: Vec<Vec<GroundFrame>> = frames.split_inclusive(ends_pass()).map(<[_]>::to_vec).collect();
        for (k, pass) in passes.iter().enumerate() {
            let reports: Vec<&GroundFrame> = pass.iter().filter(|frame| is_report(frame)).collect();
            // One report before everything except instrument descriptions, and an equal one at the end.
            assert!(is_report(&pass[0]) && reports.len() == 2 && reports[0] == reports[1], "{reports:?}");
            let GroundFrame::Housekeeping(report) = reports[0] else { panic!("no report") };
            assert_eq!(report.is_last(), k + 1 == windows.len());
        }
        passes
    }

    fn is_report(frame: &GroundFrame) -> bool {
        matches!(frame, GroundFrame::Housekeeping(_))
    }

    /// Whether a frame is the report that ends a pass: not the first of the pass.
    fn ends_pass() -> impl FnMut(&GroundFrame) -> bool {
        let mut in_pass = false;
        move |frame| match is_report(frame) {
            true => std::mem::take(&mut in_pass),
            false => {
                in_pass = true;
                false
            }
        }
    }

    fn sent(pass: &[GroundFrame]) -> usize {
        let of =
            |frame: &GroundFrame| if let GroundFrame::Visibilities(block) = frame { block.len() } else { 0 };
        pass.iter().map(of).sum()
    }

    fn config(store_bytes_max: u64, store_drop: StoreDrop) -> SpacecraftConfig {
        SpacecraftConfig { store_bytes_max, store_drop, ..SpacecraftConfig::default() }
    }

    #[test]
    fn a_pass_sends_what_it_has_time_for_and_the_last_the_rest() {
        let array = Arc::new(Array::new(&ArrayConfig::default()).unwrap());
        // Every third window only: the Earth is hidden twice on the way from one to the next.
        let all: Vec<ObservingWindow> = ObservingWindows::new(&array, 0.0, 1e5).take(10).collect();
        let windows: Vec<ObservingWindow> = all.iter().copied().step_by(3).collect();
        let link = PacedLink { array: Arc::clone(&array), bytes_per_s: 1.5 };
        let mut store = Store::new(&config(u64::MAX, StoreDrop::Newest), Some(link));
        let passes = passes(&mut store, &windows);
        assert_eq!(passes.len(), windows.len());
        let mut all_sent = 0;
        for (k, pass) in passes.iter().enumerate() {
            let sent = sent(pass);
            all_sent += sent;
            if k + 1 < passes.len() {
                let between = |n: usize| all[n + 1].start.seconds() - all[n].end.seconds();
                let sight_s: f64 = (3 * k..3 * k + 3).map(between).sum();
                let described: u64 = pass
                    .iter()
                    .filter(|f| matches!(f, GroundFrame::Ephemeris(_)))
                    .map(description_bytes)
                    .sum();
                let time_for = (1.5 * sight_s - described as f64) / VISIBILITY_BYTES as f64;
                // Only whole visibilities are sent; the limb crossing is found to 1e-7 s.
                assert!((sent as f64 - time_for).abs() <= 1.0, "{sent} {time_for}");
            }
            // No visibility is sent before its positions.
            let mut known = Vec::new();
            for frame in pass {
                match frame {
                    GroundFrame::Ephemeris(segment) => known.push(segment.start),
                    GroundFrame::Visibilities(block) => assert!(known.contains(&block.start)),
                    _ => {}
                }
            }
        }
        assert_eq!(all_sent, windows.len() * 2 * COUNT);
        assert!(store.held.is_empty() && store.by_rank.is_empty() && store.held_bytes == 0);
    }

    #[test]
    fn a_full_store_drops_by_its_policy() {
        let array = Array::new(&ArrayConfig::default()).unwrap();
        let windows: Vec<ObservingWindow> = ObservingWindows::new(&array, 0.0, 1e5).take(2).collect();
        // Room for one block and a half.
        let room = VISIBILITY_BYTES * COUNT as u64 * 3 / 2;
        for (drop, first, second) in [
            // The first pair's integrations last twice as long as the second's.
            (StoreDrop::Newest, 500, 1_000),
            // Equal time spans: 167 of the first pair and 333 of the second.
            (StoreDrop::Oldest, 833, 667),
            // The second pair's integrations are half as long and weigh half as much.
            (StoreDrop::LowestValue, 1_000, 500),
        ] {
            let mut store = Store::new(&config(room, drop), None);
            let passes = passes(&mut store, &windows);
            for (k, pass) in passes.iter().enumerate() {
                let of = |j: u8| {
                    let of_pair = |frame: &&GroundFrame| matches!(frame, GroundFrame::Visibilities(block) if block.pair.j == j);
                    pass.iter().filter(of_pair).map(|frame| sent(std::slice::from_ref(frame))).sum::<usize>()
                };
                let off = of(1).abs_diff(first);
                assert!(off <= COUNT / PARTS + 1 && of(1) + of(2) == first + second, "{drop:?}: {}", of(1));
                let Some(GroundFrame::Housekeeping(report)) = pass.last() else { panic!("no report") };
                assert_eq!(report.dropped, 500 * (k as u64 + 1));
            }
        }
        // Flagged data are dropped first, whatever their duration.
        let mut store = Store::new(&config(room, StoreDrop::LowestValue), None);
        let mut flagged = block(&windows[0], 1, 200_000);
        flagged.flags.fill(Flags::INTERFERENCE);
        store.put(flagged);
        store.put(block(&windows[0], 2, 100_000));
        assert_eq!(store.held.values().map(|held| held.block.len()).collect::<Vec<_>>(), [500, 1_000]);
    }
}
