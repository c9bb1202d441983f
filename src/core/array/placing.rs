//! Placing of visibilities: addition of the positions of both satellites.

use std::collections::BTreeMap;
use std::ops::Range;

use multiversion::multiversion;
use num_complex::Complex64;

use super::ephemeris::{Ephemeris, Piece};
use crate::frames::{PlacedVisibilities, VisibilityBlock, VisibilityReason};
use crate::units::MissionTime;

/// Numbers of visibilities of a block by result; their sum is that of the block.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct PlacingCounts {
    /// Number placed.
    pub placed: u64,
    /// Number skipped because of a flag, by the reason of the first flag.
    pub flagged: BTreeMap<VisibilityReason, u64>,
    /// Number skipped because no ephemeris covers their time.
    pub without_ephemeris: u64,
}

impl Ephemeris {
    /// Places the good visibilities of a block: adds the positions of their two satellites at the middle of each
    /// integration. Also returns the counts.
    ///
    /// `frequency_hz` is that of the block's channel. The result for a visibility depends only on its own time, not
    /// on how blocks are divided.
    #[must_use]
    #[doc(hidden)]
    pub fn place(&self, block: &VisibilityBlock, frequency_hz: f64) -> (PlacedVisibilities, PlacingCounts) {
        let mut out = PlacedVisibilities {
            channel: block.channel,
            band: 0,
            frequency_hz,
            pair: block.pair,
            time_s: Vec::with_capacity(block.len()),
            r_i_m: Vec::with_capacity(block.len()),
            r_j_m: Vec::with_capacity(block.len()),
            value_k_sr: Vec::with_capacity(block.len()),
            weight: Vec::with_capacity(block.len()),
            duration_s: Vec::with_capacity(block.len()),
            gain_errors: Vec::new(),
        };
        let counts = self.runs(block, &mut |range, piece| extend(&mut out, block, range, piece));
        (out, counts)
    }

    /// Counts as of [`Self::place`], and the mission time of the middle of the first visibility that it places, s.
    #[must_use]
    #[doc(hidden)]
    pub fn count(&self, block: &VisibilityBlock) -> (PlacingCounts, Option<f64>) {
        let mut first = None;
        let counts = self.runs(block, &mut |range, _| {
            let _ = first.get_or_insert(range.start);
        });
        (counts, first.map(|k| middle_half_ticks(block, k) as f64 / 2e6))
    }

    /// Calls `take` with each run of good visibilities and the piece of the ephemeris that is valid for all of it.
    fn runs(&self, block: &VisibilityBlock, take: &mut dyn FnMut(Range<usize>, &Piece<2>)) -> PlacingCounts {
        let mut counts = PlacingCounts::default();
        let mut from = 0;
        while from < block.len() {
            from = self.run(block, from, take, &mut counts);
        }
        counts
    }

    /// Finds the visibilities from `from` on that share its piece of the ephemeris (or its reason for being skipped);
    /// returns the index of the first that does not.
    fn run(
        &self,
        block: &VisibilityBlock,
        from: usize,
        take: &mut dyn FnMut(Range<usize>, &Piece<2>),
        counts: &mut PlacingCounts,
    ) -> usize {
        if let Some(reason) = block.flags[from].reason() {
            *counts.flagged.entry(reason).or_default() += 1;
            return from + 1;
        }
        let half_ticks = middle_half_ticks(block, from);
        let valid = self.valid_at(MissionTime(half_ticks >> 1));
        let mut holds = [2 * valid.first.0, valid.last.0.saturating_mul(2).saturating_add(1)];
        let satellites = [block.pair.i, block.pair.j].map(usize::from);
        let piece = valid.segment.and_then(|segment| Piece::at(segment, half_ticks, satellites));
        if let Some(piece) = &piece {
            // The first and last pieces extend beyond their nodes, and are valid at this time.
            let end = (piece.middle_half_ticks + piece.reach_half_ticks - 1).max(half_ticks);
            holds[1] = holds[1].min(end);
        }
        let continues = |&k: &usize| {
            let half_ticks = middle_half_ticks(block, k);
            block.flags[k].is_good() && holds[0] <= half_ticks && half_ticks <= holds[1]
        };
        let to = from + (from..block.len()).take_while(continues).count();
        match piece {
            Some(piece) => {
                counts.placed += (to - from) as u64;
                take(from..to, &piece);
            }
            None => counts.without_ephemeris += (to - from) as u64,
        }
        to
    }
}

/// Appends the visibilities in `range`; `piece` is valid for all of them.
///
/// Simple loops are vectorised, which closures in iterators are not. No multiplication is fused with an addition, so
/// that every target gives the same bits.
#[multiversion(targets("x86_64+avx512f+avx512dq+avx512vl", "x86_64+avx2"))]
fn extend(out: &mut PlacedVisibilities, block: &VisibilityBlock, range: Range<usize>, piece: &Piece<2>) {
    let (from, to) = (out.time_s.len(), out.time_s.len() + range.len());
    out.time_s.resize(to, 0.0);
    out.r_i_m.resize(to, [0.0; 3]);
    out.r_j_m.resize(to, [0.0; 3]);
    out.value_k_sr.resize(to, Complex64::ZERO);
    out.weight.resize(to, 0.0);
    let twice_start = 2 * block.start.0;
    let ticks = block.offset_ticks[range.clone()].iter().zip(&block.duration_ticks[range.clone()]);
    let places = out.time_s[from..].iter_mut().zip(&mut out.r_i_m[from..]).zip(&mut out.r_j_m[from..]);
    for ((&offset, &duration), ((time_s, r_i_m), r_j_m)) in ticks.zip(places) {
        let half_ticks = twice_start + 2 * i64::from(offset) + i64::from(duration);
        *time_s = half_ticks as f64 / 2e6;
        [*r_i_m, *r_j_m] = piece.positions_m((half_ticks - piece.middle_half_ticks) as f64);
    }
    for (wide, value) in out.value_k_sr[from..].iter_mut().zip(&block.value_k_sr[range.clone()]) {
        *wide = Complex64::new(f64::from(value.re), f64::from(value.im));
    }
    for (wide, weight) in out.weight[from..].iter_mut().zip(&block.weight[range.clone()]) {
        *wide = f64::from(*weight);
    }
    // Exact to a microsecond up to 16 s, to 1e-7 of itself beyond.
    out.duration_s.extend(block.duration_ticks[range].iter().map(|&ticks| (f64::from(ticks) * 1e-6) as f32));
}

/// Middle of integration `k` after the mission epoch, half ticks, exact.
fn middle_half_ticks(block: &VisibilityBlock, k: usize) -> i64 {
    2 * (block.start.0 + i64::from(block.offset_ticks[k])) + i64::from(block.duration_ticks[k])
}

#[cfg(test)]
mod tests {
    use num_complex::Complex32;

    use super::*;
    use crate::array::{Array, ArrayConfig, segments_for};
    use crate::frames::Flags;
    use crate::units::vector::{norm, sub};
    use crate::units::{ChannelId, Pair};

    fn table(array: &Array, start: i64, end: i64) -> Ephemeris {
        let mut table = Ephemeris::default();
        for segment in segments_for(array, MissionTime(start), MissionTime(end), 60.0) {
            table.insert(segment);
        }
        table
    }

    fn block(count: u32) -> VisibilityBlock {
        VisibilityBlock {
            channel: ChannelId(1),
            pair: Pair { i: 1, j: 7 },
            start: MissionTime(1_000_000_000_000),
            offset_ticks: (0..count).map(|k| 1_000_003 * k).collect(),
            duration_ticks: vec![1_000_001; count as usize],
            value_k_sr: (0..count).map(|k| Complex32::new(k as f32, 0.5)).collect(),
            weight: vec![0.25; count as usize],
            flags: vec![Flags::GOOD; count as usize],
        }
    }

    #[test]
    fn positions_are_those_of_the_array() {
        let array = Array::new(&ArrayConfig::default()).unwrap();
        let block = block(2_000);
        let table = table(&array, block.start.0, block.start.0 + 2_001_000_000);
        let (placed, counts) = table.place(&block, 1e7);
        assert_eq!((counts.placed, counts.without_ephemeris), (2_000, 0));
        for k in 0..placed.len() {
            let t_s = placed.time_s[k];
            assert!((t_s - block.middle_s(k)).abs() < 1e-9);
            // 1e-5 m: interpolation 1e-6, rounding of a time of 1e6 s at 1.55 km/s 2e-7.
            assert!(norm(sub(placed.r_i_m[k], array.position_m(1, t_s))) < 1e-5);
            assert!(norm(sub(placed.r_j_m[k], array.position_m(7, t_s))) < 1e-5);
        }
        assert_eq!((placed.value_k_sr[9].re, placed.weight[9]), (9.0, 0.25));
    }

    #[test]
    fn flagged_and_uncovered_visibilities_are_counted() {
        let array = Array::new(&ArrayConfig::default()).unwrap();
        let mut block = block(100);
        block.flags[3] = Flags(Flags::SATURATED.0 | Flags::INTERFERENCE.0);
        block.flags[4] = Flags::UNCALIBRATED;
        block.flags[99] = Flags(128);
        // Covered: all but the first ten and the last twenty.
        let start = block.start.0;
        let table = table(&array, start + 10 * 1_000_003, start + 80 * 1_000_003);
        let (placed, counts) = table.place(&block, 1e7);
        assert_eq!(placed.len() as u64, counts.placed);
        let flagged = [
            (VisibilityReason::Interference, 1),
            (VisibilityReason::Uncalibrated, 1),
            (VisibilityReason::UnknownFlag, 1),
        ];
        let flagged = flagged.into_iter().collect();
        assert_eq!(counts, PlacingCounts { placed: 70, flagged, without_ephemeris: 27 });
        // Counting alone says the same.
        assert_eq!(table.count(&block), (counts, placed.time_s.first().copied()));
        let nowhere = Ephemeris::default();
        assert_eq!(nowhere.count(&block), (nowhere.place(&block, 1e7).1, None));
    }

    #[test]
    fn the_split_of_a_block_does_not_matter() {
        let array = Array::new(&ArrayConfig::default()).unwrap();
        let whole = block(50);
        let table = table(&array, whole.start.0, whole.start.0 + 60_000_000);
        let (placed, _) = table.place(&whole, 1e7);
        let later = VisibilityBlock {
            start: whole.start.plus_ticks(i64::from(whole.offset_ticks[20])),
            offset_ticks: whole.offset_ticks[20..].iter().map(|t| t - whole.offset_ticks[20]).collect(),
            duration_ticks: whole.duration_ticks[20..].to_vec(),
            value_k_sr: whole.value_k_sr[20..].to_vec(),
            weight: whole.weight[20..].to_vec(),
            flags: whole.flags[20..].to_vec(),
            ..whole
        };
        let (part, _) = table.place(&later, 1e7);
        assert_eq!(part.time_s, placed.time_s[20..]);
        assert_eq!(part.r_i_m, placed.r_i_m[20..]);
    }

    #[test]
    fn a_satellite_that_the_ephemeris_lacks_is_no_panic() {
        let array = Array::new(&ArrayConfig::default()).unwrap();
        let block = VisibilityBlock { pair: Pair { i: 0, j: 40 }, ..block(5) };
        let table = table(&array, block.start.0, block.start.0 + 60_000_000);
        assert_eq!(table.place(&block, 1e7).1.without_ephemeris, 5);
    }
}
