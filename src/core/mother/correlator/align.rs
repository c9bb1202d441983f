//! Aligns the sample streams of all daughters and channels by block number.

use std::collections::BTreeMap;

use crate::frames::{ObservingWindow, SampleBlock};

/// Counts of received and missing blocks.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct AlignerCounts {
    /// Blocks used.
    pub used: u64,
    /// Blocks that did not arrive in time.
    pub missing: u64,
    /// Blocks that arrived after their row had been released.
    pub late: u64,
    /// Duplicate blocks.
    pub duplicate: u64,
    /// Blocks with an invalid number, time tag, length or origin.
    pub malformed: u64,
    /// Samples of the used blocks.
    pub used_samples: u64,
    /// Samples of the late blocks.
    pub late_samples: u64,
    /// Samples of the malformed blocks.
    pub malformed_samples: u64,
}

impl AlignerCounts {
    /// Adds the counters of another aligner.
    pub fn add(&mut self, other: Self) {
        self.used += other.used;
        self.missing += other.missing;
        self.late += other.late;
        self.duplicate += other.duplicate;
        self.malformed += other.malformed;
        self.used_samples += other.used_samples;
        self.late_samples += other.late_samples;
        self.malformed_samples += other.malformed_samples;
    }
}

/// Blocks of one number, of all channels and daughters.
#[derive(Clone, Debug, PartialEq)]
pub struct BlockRow {
    /// Number of the blocks.
    pub number: u64,
    /// Samples per block.
    pub samples: usize,
    /// Blocks by channel, then by daughter; `None` if missing.
    pub blocks: Vec<Option<SampleBlock>>,
}

/// Dimensions of a window's sample streams.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct StreamShape {
    /// Number of daughters.
    pub daughters: usize,
    /// Number of channels.
    pub channels: usize,
    /// Samples per block, except the last one.
    pub block_samples: usize,
    /// Width of a channel, Hz, which is the sample rate.
    pub width_hz: f64,
    /// Number of blocks that may arrive after a missing one before it is given up.
    pub wait_blocks: u64,
}

/// Collects blocks of the same number into rows, and releases rows in the order of numbers. A row is released incomplete
/// when a block arrives that is `wait_blocks` ahead of it, which bounds memory.
#[derive(Debug)]
pub struct Aligner {
    streams: StreamShape,
    window: ObservingWindow,
    /// Number of samples in the window.
    samples: u64,
    next: u64,
    pending: BTreeMap<u64, PartialRow>,
    counts: AlignerCounts,
}

#[derive(Debug)]
struct PartialRow {
    row: BlockRow,
    present: usize,
}

impl Aligner {
    /// Creates an aligner for `window`.
    #[must_use]
    pub fn new(streams: StreamShape, window: ObservingWindow) -> Self {
        let length_s = (window.end.0 - window.start.0) as f64 * 1e-6;
        let samples = (length_s * streams.width_hz).round().max(0.0) as u64;
        let (pending, counts) = (BTreeMap::new(), AlignerCounts::default());
        Self { streams, window, samples, next: 0, pending, counts }
    }

    /// Number of samples in the window.
    #[must_use]
    pub fn samples(&self) -> u64 {
        self.samples
    }

    /// Counts so far.
    #[must_use]
    pub fn counts(&self) -> AlignerCounts {
        self.counts
    }

    /// Accepts a block; returns the rows that are now complete or given up.
    pub fn put(&mut self, block: SampleBlock) -> Vec<BlockRow> {
        let number = block.number;
        let (length, samples) = (self.length(number), block.samples.len() as u64);
        if length == 0 || !self.is_well_formed(&block, length) {
            self.counts.malformed += 1;
            self.counts.malformed_samples += samples;
            return Vec::new();
        }
        if number < self.next {
            self.counts.late += 1;
            self.counts.late_samples += samples;
            return Vec::new();
        }
        let mut rows = Vec::new();
        // Rows far behind the block are released incomplete.
        while number >= self.next + self.streams.wait_blocks {
            rows.push(self.release());
        }
        let StreamShape { daughters, channels, .. } = self.streams;
        let partial = self
            .pending
            .entry(number)
            .or_insert_with(|| PartialRow::new(number, length, daughters * channels));
        let slot =
            &mut partial.row.blocks[usize::from(block.channel.0) * daughters + usize::from(block.daughter)];
        if slot.is_some() {
            self.counts.duplicate += 1;
            return rows;
        }
        *slot = Some(block);
        partial.present += 1;
        while self.pending.get(&self.next).is_some_and(|first| first.present == daughters * channels) {
            rows.push(self.release());
        }
        rows
    }

    /// Releases the remaining rows up to `end_samples` of the window.
    pub fn finish(&mut self, end_samples: u64) -> Vec<BlockRow> {
        let mut rows = Vec::new();
        while self.next * (self.streams.block_samples as u64) < end_samples.min(self.samples) {
            rows.push(self.release());
        }
        rows
    }

    fn release(&mut self) -> BlockRow {
        let number = self.next;
        self.next += 1;
        let count = self.streams.daughters * self.streams.channels;
        let length = self.length(number);
        let partial = self.pending.remove(&number).unwrap_or_else(|| PartialRow::new(number, length, count));
        self.counts.used += partial.present as u64;
        self.counts.used_samples += (partial.present * partial.row.samples) as u64;
        self.counts.missing += (count - partial.present) as u64;
        partial.row
    }

    /// Number of samples of a block; 0 beyond the window.
    fn length(&self, number: u64) -> usize {
        let block_samples = self.streams.block_samples as u64;
        let first = number.saturating_mul(block_samples);
        self.samples.saturating_sub(first).min(block_samples) as usize
    }

    fn is_well_formed(&self, block: &SampleBlock, length: usize) -> bool {
        let first = block.number * self.streams.block_samples as u64;
        let ticks = crate::daughters::sample_ticks(first, self.streams.width_hz);
        block.samples.len() == length
            && block.time == self.window.start.plus_ticks(ticks)
            && usize::from(block.daughter) < self.streams.daughters
            && usize::from(block.channel.0) < self.streams.channels
    }
}

impl PartialRow {
    fn new(number: u64, samples: usize, count: usize) -> Self {
        Self { row: BlockRow { number, samples, blocks: vec![None; count] }, present: 0 }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::frames::Samples;
    use crate::units::{ChannelId, MissionTime};

    const STREAMS: StreamShape =
        StreamShape { daughters: 2, channels: 1, block_samples: 256, width_hz: 8e3, wait_blocks: 2 };

    /// Two and a half blocks of 32 ms.
    fn aligner() -> Aligner {
        let window = ObservingWindow { index: 0, start: MissionTime(5_000), end: MissionTime(85_000) };
        Aligner::new(STREAMS, window)
    }

    fn block(daughter: u8, number: u64) -> SampleBlock {
        let length = if number == 2 { 128 } else { 256 };
        SampleBlock {
            channel: ChannelId(0),
            daughter,
            number,
            time: MissionTime(5_000 + 32_000 * number as i64),
            saturated: 0,
            samples: Samples::Float { re: vec![0.0; length], im: vec![0.0; length] },
        }
    }

    fn shape(rows: &[BlockRow]) -> Vec<(u64, usize, Vec<bool>)> {
        rows.iter()
            .map(|row| (row.number, row.samples, row.blocks.iter().map(Option::is_some).collect()))
            .collect()
    }

    #[test]
    fn blocks_are_aligned_in_any_order() {
        let mut aligner = aligner();
        assert!(aligner.put(block(0, 0)).is_empty());
        assert!(aligner.put(block(1, 1)).is_empty());
        assert_eq!(shape(&aligner.put(block(1, 0))), [(0, 256, vec![true, true])]);
        assert_eq!(shape(&aligner.put(block(0, 1))), [(1, 256, vec![true, true])]);
        assert!(aligner.put(block(0, 2)).is_empty());
        assert_eq!(shape(&aligner.put(block(1, 2))), [(2, 128, vec![true, true])]);
        assert!(aligner.finish(u64::MAX).is_empty());
        let expected = AlignerCounts { used: 6, used_samples: 4 * 256 + 2 * 128, ..AlignerCounts::default() };
        assert_eq!(aligner.counts(), expected);
    }

    #[test]
    fn missing_late_duplicate_and_malformed_blocks_are_counted() {
        let mut aligner = aligner();
        assert!(aligner.put(block(0, 0)).is_empty());
        assert!(aligner.put(block(0, 0)).is_empty());
        let rows = aligner.put(block(0, 2));
        assert_eq!(shape(&rows), [(0, 256, vec![true, false])]);
        assert!(aligner.put(block(1, 0)).is_empty());
        for wrong in [
            SampleBlock { number: 3, ..block(0, 2) },
            SampleBlock { number: u64::MAX, ..block(0, 2) },
            SampleBlock { time: MissionTime(0), ..block(0, 1) },
            SampleBlock { daughter: 2, ..block(0, 1) },
            SampleBlock { channel: ChannelId(1), ..block(0, 1) },
            SampleBlock { samples: block(0, 2).samples, ..block(0, 1) },
        ] {
            assert!(aligner.put(wrong).is_empty());
        }
        let rows = aligner.finish(u64::MAX);
        assert_eq!(shape(&rows), [(1, 256, vec![false, false]), (2, 128, vec![true, false])]);
        let expected = AlignerCounts {
            used: 2,
            missing: 4,
            late: 1,
            duplicate: 1,
            malformed: 6,
            used_samples: 256 + 128,
            late_samples: 256,
            malformed_samples: 3 * 128 + 3 * 256,
        };
        assert_eq!(aligner.counts(), expected);
    }
}
