//! Links from the daughters to the mother.

use std::collections::VecDeque;
use std::convert::Infallible;
use std::sync::{Arc, Mutex, PoisonError};

use serde::Serialize;

use super::config::{DaughtersConfig, DropPolicy};
use crate::array::Array;
use crate::frames::{ObservingWindow, SampleBlock, SpaceFrame};
use crate::runtime::{Outlet, Stage, Units};
use crate::units::{MissionTime, TICKS_PER_SECOND};

/// Counters of the links, summed over daughters.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize)]
pub struct LinkCounts {
    /// Blocks sent.
    pub sent: u64,
    /// Bits sent.
    pub bits: u64,
    /// Blocks dropped because a buffer was full, or because the next window began before they were sent.
    pub dropped: u64,
    /// Samples of the dropped blocks.
    pub dropped_samples: u64,
    /// Largest number of bits queued in one buffer.
    pub waiting_bits_max: u64,
}

impl LinkCounts {
    fn count_sent(&mut self, blocks: &[SampleBlock]) {
        self.sent += blocks.len() as u64;
        self.bits += blocks.iter().map(|block| block.samples.bits()).sum::<u64>();
    }

    fn count_dropped(&mut self, samples: u64) {
        self.dropped += 1;
        self.dropped_samples += samples;
    }
}

/// Stage that sends blocks at a limited rate: each daughter has a link and a bounded transmit buffer. When a block
/// does not fit, the drop policy decides which block is dropped and counted.
///
/// After a window the links continue until one orbit has passed since its start, which is about when the next window
/// begins. Blocks still queued then are dropped by the same policy. The frame that ends the window follows the last
/// block.
pub struct SampleLink {
    rate_bits_per_s: f64,
    /// Time from a window's start within which its samples must be sent, s.
    orbit_s: f64,
    window: Option<ObservingWindow>,
    capacity_bits: u64,
    policy: DropPolicy,
    buffers: Vec<Buffer>,
    counts: Arc<Mutex<LinkCounts>>,
}

#[derive(Default)]
struct Buffer {
    queue: VecDeque<SampleBlock>,
    bits: u64,
    /// Bits of the first block that have been sent already.
    sent_bits: f64,
    /// Time up to which the link has been simulated.
    now: Option<MissionTime>,
}

impl SampleLink {
    /// Creates the links of an array's daughters, which update `counts` while they run.
    #[must_use]
    pub fn new(config: &DaughtersConfig, array: &Array, counts: Arc<Mutex<LinkCounts>>) -> Self {
        let daughters = array.satellites();
        Self {
            rate_bits_per_s: config.link_bits_per_s_max,
            orbit_s: array.orbital_period_s(),
            window: None,
            capacity_bits: config.link_buffer_bytes * 8,
            policy: config.link_drop,
            buffers: (0..daughters).map(|_| Buffer::default()).collect(),
            counts,
        }
    }

    /// Accepts blocks that arrived together, and sends on together those that leave their buffers.
    fn accept(&mut self, mut blocks: Vec<SampleBlock>, out: &mut Outlet<SpaceFrame>) {
        let counts = Arc::clone(&self.counts);
        let mut counts = counts.lock().unwrap_or_else(PoisonError::into_inner);
        let sent = if self.rate_bits_per_s <= 0.0 {
            blocks
        } else {
            // Channels take turns at being first, so that a full buffer costs all of them the same.
            let first = blocks.first().map_or(0, |block| block.number) % blocks.len().max(1) as u64;
            blocks.rotate_left(first as usize);
            let mut sent = Vec::new();
            for block in blocks {
                self.queue(block, &mut counts, &mut sent);
            }
            sent
        };
        counts.count_sent(&sent);
        drop(counts);
        if !sent.is_empty() {
            out.push(SpaceFrame::Samples(sent));
        }
    }

    /// Puts a block into its daughter's buffer, once the blocks that leave before its time are sent.
    fn queue(&mut self, block: SampleBlock, counts: &mut LinkCounts, sent: &mut Vec<SampleBlock>) {
        let (bits, samples) = (block.samples.bits(), block.samples.len() as u64);
        let Some(buffer) = self.buffers.get_mut(usize::from(block.daughter)) else {
            counts.count_dropped(samples);
            return;
        };
        buffer.send_until(block.time, self.rate_bits_per_s, sent);
        if self.policy == DropPolicy::Oldest {
            while buffer.bits + bits > self.capacity_bits
                && let Some(samples) = buffer.drop_oldest()
            {
                counts.count_dropped(samples);
            }
        }
        if buffer.bits + bits > self.capacity_bits {
            counts.count_dropped(samples);
        } else {
            buffer.bits += bits;
            buffer.queue.push_back(block);
        }
        counts.waiting_bits_max = counts.waiting_bits_max.max(buffer.bits);
    }

    /// Flushes the buffers after a window: sends blocks while there is time, in the order of block numbers, as the
    /// daughters send in parallel, and drops the others.
    fn flush(&mut self, out: &mut Outlet<SpaceFrame>) {
        let until = self
            .window
            .take()
            .map(|window| MissionTime::from_seconds(window.start.seconds() + self.orbit_s).max(window.end));
        let counts = Arc::clone(&self.counts);
        let mut counts = counts.lock().unwrap_or_else(PoisonError::into_inner);
        let mut sent = Vec::new();
        for buffer in &mut self.buffers {
            let mut buffer = std::mem::take(buffer);
            let until = until.or(buffer.now).unwrap_or_default();
            if self.policy == DropPolicy::Oldest {
                let budget = buffer.budget(until, self.rate_bits_per_s);
                while buffer.bits as f64 > budget
                    && let Some(samples) = buffer.drop_oldest()
                {
                    counts.count_dropped(samples);
                }
            }
            buffer.send_until(until, self.rate_bits_per_s, &mut sent);
            for block in &buffer.queue {
                counts.count_dropped(block.samples.len() as u64);
            }
        }
        counts.count_sent(&sent);
        drop(counts);
        sent.sort_by_key(|block| block.number);
        let mut rest = sent.into_iter().peekable();
        while let Some(first) = rest.next() {
            let number = first.number;
            let same = std::iter::from_fn(|| rest.next_if(|block| block.number == number));
            out.push(SpaceFrame::Samples(std::iter::once(first).chain(same).collect()));
        }
    }
}

impl Buffer {
    /// Adds the blocks that leave by `time` to `sent`.
    fn send_until(&mut self, time: MissionTime, rate_bits_per_s: f64, sent: &mut Vec<SampleBlock>) {
        let mut budget = self.budget(time, rate_bits_per_s);
        self.now = Some(time);
        while let Some(first) = self.queue.front() {
            let bits = first.samples.bits();
            if bits as f64 > budget {
                break;
            }
            budget -= bits as f64;
            self.bits -= bits;
            sent.extend(self.queue.pop_front());
        }
        // An idle link accumulates no credit.
        self.sent_bits = if self.queue.is_empty() { 0.0 } else { budget };
    }

    /// Bits that can be sent by `time`, including those of the first block that were sent already.
    fn budget(&self, time: MissionTime, rate_bits_per_s: f64) -> f64 {
        let ticks = (time.0 - self.now.unwrap_or(time).0).max(0);
        self.sent_bits + rate_bits_per_s * ticks as f64 / TICKS_PER_SECOND as f64
    }

    /// Drops the oldest block that is not being sent; returns its number of samples.
    fn drop_oldest(&mut self) -> Option<u64> {
        // The first block is being sent.
        let oldest = self.queue.remove(1)?;
        self.bits -= oldest.samples.bits();
        Some(oldest.samples.len() as u64)
    }
}

impl Stage for SampleLink {
    type In = SpaceFrame;
    type Out = SpaceFrame;
    type Error = Infallible;

    fn step(&mut self, frame: SpaceFrame, out: &mut Outlet<SpaceFrame>) -> Result<(), Infallible> {
        match frame {
            SpaceFrame::Samples(blocks) => self.accept(blocks, out),
            SpaceFrame::WindowStart(window) => {
                // A window whose end was lost ends where the next one begins.
                self.flush(out);
                self.window = Some(window);
                out.push(frame);
            }
            SpaceFrame::WindowEnd(_) => {
                self.flush(out);
                out.push(frame);
            }
        }
        Ok(())
    }

    fn finish(&mut self, out: &mut Outlet<SpaceFrame>) -> Result<(), Infallible> {
        self.flush(out);
        Ok(())
    }

    fn units(&self) -> Units {
        Units::of(self.counts.lock().unwrap_or_else(PoisonError::into_inner).bits, "bits")
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::array::ArrayConfig;
    use crate::frames::Samples;
    use crate::units::ChannelId;

    /// 1000 samples of 2 x 8 bits, 16 kbit, every 0.1 s.
    fn block(number: u64) -> SampleBlock {
        SampleBlock {
            channel: ChannelId(0),
            daughter: 0,
            number,
            time: MissionTime(100_000 * number as i64),
            saturated: 0,
            samples: Samples::Codes { bits: 8, step: 1.0, re: vec![0; 1000], im: vec![0; 1000] },
        }
    }

    fn numbers(rate: f64, buffer_bytes: u64, policy: DropPolicy) -> (Vec<u64>, LinkCounts) {
        let config = DaughtersConfig {
            link_bits_per_s_max: rate,
            link_buffer_bytes: buffer_bytes,
            link_drop: policy,
            ..DaughtersConfig::default()
        };
        let counts = Arc::default();
        let array = Array::new(&ArrayConfig::default()).unwrap();
        let mut link = SampleLink::new(&config, &array, Arc::clone(&counts));
        let mut out = Outlet::collect();
        let window = ObservingWindow { index: 0, start: MissionTime(0), end: MissionTime(1_200_000) };
        link.step(SpaceFrame::WindowStart(window), &mut out).unwrap();
        for number in 0..12 {
            link.step(SpaceFrame::Samples(vec![block(number)]), &mut out).unwrap();
        }
        link.finish(&mut out).unwrap();
        let numbers = |frame: SpaceFrame| match frame {
            SpaceFrame::Samples(blocks) => blocks.into_iter().map(|block| block.number).collect(),
            _ => Vec::new(),
        };
        let counts = *counts.lock().unwrap();
        (out.into_vec().into_iter().flat_map(numbers).collect(), counts)
    }

    #[test]
    fn a_link_that_is_fast_enough_drops_nothing() {
        for rate in [0.0, 160e3, 1e9] {
            let (sent, counts) = numbers(rate, 4096, DropPolicy::Newest);
            assert_eq!(sent, (0..12).collect::<Vec<_>>());
            assert_eq!((counts.sent, counts.bits, counts.dropped), (12, 12 * 16_000, 0));
        }
    }

    #[test]
    fn a_slow_link_drops_by_its_policy_and_counts() {
        // One block leaves in 0.2 s, two fit the buffer.
        for (policy, expected) in [
            (DropPolicy::Newest, vec![0, 1, 2, 4, 6, 8, 10]),
            (DropPolicy::Oldest, vec![0, 1, 3, 5, 7, 9, 11]),
        ] {
            let (sent, counts) = numbers(80e3, 4096, policy);
            assert_eq!(counts.sent + counts.dropped, 12);
            assert_eq!(counts.dropped_samples, 1000 * counts.dropped);
            assert_eq!(counts.sent, sent.len() as u64);
            assert!(counts.waiting_bits_max <= 4096 * 8);
            assert_eq!(sent, expected, "{policy:?}");
        }
    }

    #[test]
    fn after_a_window_blocks_are_sent_for_one_orbit() {
        // An orbit lasts 8248.68 s, all of it after the first block: 82 kbit, five blocks of 16 kbit.
        for (policy, expected) in
            [(DropPolicy::Newest, vec![0, 1, 2, 3, 4]), (DropPolicy::Oldest, vec![0, 8, 9, 10, 11])]
        {
            let (sent, counts) = numbers(10.0, 1 << 20, policy);
            assert_eq!((counts.sent, counts.dropped, counts.dropped_samples), (5, 7, 7_000));
            assert_eq!(sent, expected, "{policy:?}");
        }
        // One block takes longer than an orbit.
        assert_eq!(numbers(1.0, 1 << 20, DropPolicy::Newest).1.dropped, 12);
    }
}
