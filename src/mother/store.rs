//! The onboard store: holds data until the Earth is in sight, and sends them down as fast as the link allows.

use std::cmp::Reverse;
use std::collections::{BTreeMap, BTreeSet};
use std::convert::Infallible;
use std::sync::Arc;

use super::config::{SpacecraftConfig, StoreDrop, VISIBILITY_BYTES};
use crate::array::{Array, earth_in_sight_s};
use crate::frames::{GroundFrame, Housekeeping, VisibilityBlock};
use crate::runtime::{Outlet, Stage, Units};

/// A link that sends no more than so much while the Earth is in sight.
#[derive(Clone, Debug)]
pub struct PacedLink {
    /// Whose orbit says when that is.
    pub array: Arc<Array>,
    /// Bytes of payload a second.
    pub bytes_per_s: f64,
}

/// A block in the store.
#[derive(Debug)]
struct Held {
    window: u64,
    value: Value,
    rank: Rank,
    block: VisibilityBlock,
}

/// Seconds of typical data a byte, as bits of a number that is not negative: they have its order.
type Value = u64;

/// Parts of a block that are dropped at once, so that blocks are not copied for every visibility. Blocks of one window are
/// cut to the same time but for one.
const PARTS: usize = 32;

/// The order in which a full store drops, the least first: values; or times, as windows and ticks, upside down where the
/// latest go first.
type Rank = (u64, u32);

/// Either end of a block.
#[derive(Clone, Copy, Debug)]
enum End {
    Front,
    Back,
}

/// Holds frames while the Earth is hidden, and releases them, the oldest first, in the passes that follow.
///
/// A housekeeping frame closes a window: the Earth is in sight from then on, until the next window begins. What a
/// pass has no time for stays for the next one, and goes down behind the positions that it needs. When the mission
/// is over, a last pass empties the store.
///
/// Visibilities beyond the capacity are dropped, which ones [`StoreDrop`] says, and counted in the housekeeping frame
/// that closes the pass; nothing else is ever dropped.
#[derive(Debug)]
pub struct Store {
    capacity_bytes: u64,
    drop: StoreDrop,
    link: Option<PacedLink>,
    /// Number of the window that is being observed.
    window: u64,
    /// What the visibilities of a window are sent behind: instrument and positions.
    descriptions: BTreeMap<u64, Vec<GroundFrame>>,
    /// Blocks by their number, in the order in which they came.
    held: BTreeMap<u64, Held>,
    /// The same by rank; of those of one rank the one that came last first.
    by_rank: BTreeSet<(Rank, Reverse<u64>)>,
    held_bytes: u64,
    blocks: u64,
    /// Sums of weights and of lengths in seconds of all good visibilities so far, channel by channel.
    typical: BTreeMap<u16, [f64; 2]>,
    /// Closes the pass that is going on.
    closing: Option<Housekeeping>,
    kept: u64,
    dropped: u64,
}

impl Store {
    /// An empty store before a link; without one all goes down at once.
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

    /// Takes a block, and drops what is too much then.
    fn put(&mut self, block: VisibilityBlock) {
        let (value, number) = (self.value(&block), self.blocks);
        self.blocks += 1;
        self.held_bytes += VISIBILITY_BYTES * block.len() as u64;
        self.kept += block.len() as u64;
        let rank = self.rank(self.window, value, &block);
        self.by_rank.insert((rank, Reverse(number)));
        self.held.insert(number, Held { window: self.window, value, rank, block });
        while self.held_bytes > self.capacity_bytes {
            let too_many = (self.held_bytes - self.capacity_bytes).div_ceil(VISIBILITY_BYTES);
            let Some(gone) = self.drop_first(too_many) else { break };
            self.kept -= gone;
            self.dropped += gone;
        }
    }

    /// Where a block stands among those to be dropped: by value, or by its own first or last visibility's time, whatever
    /// the order in which blocks came.
    fn rank(&self, window: u64, value: Value, block: &VisibilityBlock) -> Rank {
        let ticks = |offset: Option<&u32>| offset.copied().unwrap_or(0);
        match self.drop {
            StoreDrop::Oldest => (window, ticks(block.offset_ticks.first())),
            StoreDrop::Newest => (!window, !ticks(block.offset_ticks.last())),
            StoreDrop::LowestValue => (value, 0),
        }
    }

    /// Drops up to `count` visibilities of the block that is first to go: as long as none of another goes before them, and
    /// no less than a part of `PARTS`. How many.
    fn drop_first(&mut self, count: u64) -> Option<u64> {
        let mut order = self.by_rank.iter();
        let (_, Reverse(number)) = *order.next()?;
        let next = order.next().map(|(rank, _)| *rank);
        let held = self.held.get(&number)?;
        let offsets = &held.block.offset_ticks;
        let least = offsets.len().div_ceil(PARTS);
        let (own, end) = match (self.drop, next) {
            (StoreDrop::Oldest, Some((window, ticks))) if window == held.window => {
                (offsets.partition_point(|&offset| offset <= ticks), End::Front)
            }
            (StoreDrop::Newest, Some((window, ticks))) if !window == held.window => {
                (offsets.len() - offsets.partition_point(|&offset| offset < !ticks), End::Back)
            }
            (StoreDrop::Oldest, _) => (offsets.len(), End::Front),
            (StoreDrop::Newest | StoreDrop::LowestValue, _) => (offsets.len(), End::Back),
        };
        let gone = self.take(number, count.min(own.max(least) as u64), end)?;
        Some(gone.len() as u64)
    }

    /// What a byte of a block is worth: its weight, in terms of what a second of its channel's good data has weighed
    /// so far. What is flagged is worth nothing.
    fn value(&mut self, block: &VisibilityBlock) -> Value {
        let [weights, seconds] = self.typical.entry(block.channel.0).or_default();
        let mut weight = 0.0;
        for k in (0..block.len()).filter(|&k| block.flags[k].is_good()) {
            weight += f64::from(block.weight[k]);
            *seconds += f64::from(block.duration_ticks[k]) * 1e-6;
        }
        *weights += weight;
        let value = weight * *seconds / (*weights * block.len() as f64);
        // Nothing good yet is 0 / 0.
        if value > 0.0 { value.to_bits() } else { 0 }
    }

    /// Takes so many visibilities out of a block, or all that it has.
    fn take(&mut self, number: u64, count: u64, end: End) -> Option<VisibilityBlock> {
        let held = self.held.get_mut(&number)?;
        let length = held.block.len();
        let count = usize::try_from(count).map_or(length, |count| count.min(length));
        self.held_bytes -= VISIBILITY_BYTES * count as u64;
        self.by_rank.remove(&(held.rank, Reverse(number)));
        if count == length {
            return self.held.remove(&number).map(|held| held.block);
        }
        let taken = match end {
            End::Back => held.block.split_off(length - count),
            End::Front => {
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

    /// Sends windows before the one with the number `until`, as many bytes of them as there is time for.
    fn send(&mut self, until: u64, bytes: Option<u64>, out: &mut Outlet<GroundFrame>) {
        let mut left = bytes.unwrap_or(u64::MAX);
        while let Some(window) = self.descriptions.keys().next().copied().filter(|window| *window < until) {
            let descriptions = self.descriptions.remove(&window).unwrap_or_default();
            for frame in &descriptions {
                left = left.saturating_sub(description_bytes(frame));
                out.push(frame.clone());
            }
            while let Some((&number, _)) =
                self.held.first_key_value().filter(|(_, held)| held.window == window)
            {
                if left < VISIBILITY_BYTES {
                    // The rest needs them again.
                    self.descriptions.insert(window, descriptions);
                    return;
                }
                let Some(block) = self.take(number, left / VISIBILITY_BYTES, End::Front) else { break };
                left -= VISIBILITY_BYTES * block.len() as u64;
                out.push(GroundFrame::Visibilities(block));
            }
            if left < VISIBILITY_BYTES {
                return;
            }
        }
    }

    /// Ends the pass that is going on, if one is, at a time; `None` once all is sent.
    fn end_pass(&mut self, time_s: Option<f64>, out: &mut Outlet<GroundFrame>) {
        let Some(report) = self.closing.take() else { return };
        let bytes = self.link.as_ref().zip(time_s).map(|(link, time_s)| {
            let sight_s = earth_in_sight_s(&link.array, report.time.seconds(), time_s);
            (sight_s * link.bytes_per_s) as u64
        });
        self.send(self.window, bytes, out);
        let dropped = report.dropped + self.dropped;
        out.push(GroundFrame::Housekeeping(Housekeeping { dropped, ..report }));
    }
}

/// About what a description takes on the link: 24 bytes a position.
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
                // Of a window without data the time in which the Earth was hidden counts as nothing.
                self.end_pass(Some(report.time.seconds()), out);
                self.closing = Some(report);
                self.window += 1;
                if self.link.is_none() {
                    self.end_pass(None, out);
                }
            }
            other => self.descriptions.entry(self.window).or_default().push(other),
        }
        Ok(())
    }

    /// A window that was cut short is sent down as far as it went.
    fn finish(&mut self, out: &mut Outlet<GroundFrame>) -> Result<(), Infallible> {
        self.end_pass(None, out);
        self.send(u64::MAX, None, out);
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

    /// Sends windows of two blocks each; what comes out, pass by pass.
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
        let closes = |frame: &GroundFrame| matches!(frame, GroundFrame::Housekeeping(_));
        frames.split_inclusive(closes).map(<[_]>::to_vec).collect()
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
                // Whole visibilities; the limb's crossing is found to 1e-7 s.
                assert!((sent as f64 - time_for).abs() <= 1.0, "{sent} {time_for}");
            }
            // Nothing comes before its positions.
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
            // The first pair's go on for as long again as the second's.
            (StoreDrop::Newest, 500, 1_000),
            // The same time of both: 167 of the first and 333 of the second.
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
        // What has a flag goes first, however long it is.
        let mut store = Store::new(&config(room, StoreDrop::LowestValue), None);
        let mut flagged = block(&windows[0], 1, 200_000);
        flagged.flags.fill(Flags::INTERFERENCE);
        store.put(flagged);
        store.put(block(&windows[0], 2, 100_000));
        assert_eq!(store.held.values().map(|held| held.block.len()).collect::<Vec<_>>(), [500, 1_000]);
    }
}
