//! A store that is smaller than a window.

use lunarray::frames::{Flags, GroundFrame, Housekeeping, VisibilityBlock};
use lunarray::mother::{SpacecraftConfig, Store, StoreDrop, VISIBILITY_BYTES};
use lunarray::runtime::{Outlet, Stage};
use lunarray::units::{ChannelId, MissionTime, Pair, all_pairs};
use num_complex::Complex32;

const CHANNELS: u16 = 3;
const TICKS: u32 = 2_400_000_000;

/// Contiguous integrations through the window, shorter for longer baselines.
fn block(channel: u16, pair: Pair) -> VisibilityBlock {
    let duration = 2_000_000 / u32::from(pair.j - pair.i);
    let count = (TICKS / duration) as usize;
    VisibilityBlock {
        channel: ChannelId(channel),
        pair,
        start: MissionTime(7),
        offset_ticks: (0..count as u32).map(|k| k * duration).collect(),
        duration_ticks: vec![duration; count],
        value_k_sr: vec![Complex32::ONE; count],
        weight: vec![1.0; count],
        flags: vec![Flags::GOOD; count],
    }
}

#[test]
fn a_window_is_cut_at_one_time_in_all_channels_and_pairs() {
    let blocks: Vec<VisibilityBlock> = (0..CHANNELS)
        .flat_map(|channel| all_pairs(8).into_iter().map(move |pair| block(channel, pair)))
        .collect();
    let sampled: usize = blocks.iter().map(VisibilityBlock::len).sum();
    for (drop, part) in [(StoreDrop::Newest, 0.25), (StoreDrop::Oldest, 0.25), (StoreDrop::Newest, 0.9)] {
        let room = (part * sampled as f64) as u64;
        let config = SpacecraftConfig {
            store_bytes_max: room * VISIBILITY_BYTES,
            store_drop: drop,
            ..SpacecraftConfig::default()
        };
        let mut store = Store::new(&config, None);
        let mut out = Outlet::collect();
        for block in &blocks {
            store.step(GroundFrame::Visibilities(block.clone()), &mut out).unwrap();
        }
        let report = Housekeeping { time: MissionTime(7), sampled: sampled as u64, dropped: 0 };
        store.step(GroundFrame::Housekeeping(report), &mut out).unwrap();
        // A pass begins with the first frame of the next window, or at the end.
        store.finish(&mut out).unwrap();
        let mut frames = out.into_vec();
        let Some(GroundFrame::Housekeeping(report)) = frames.pop() else { panic!("no report") };
        assert_eq!(report.dropped, sampled as u64 - room);
        assert!(report.is_last());
        assert_eq!(frames.remove(0), GroundFrame::Housekeeping(report));
        let mut held = 0;
        let mut sent = 0;
        for frame in &frames {
            let GroundFrame::Visibilities(block) = frame else { panic!("{frame:?}") };
            held += block.len() as u64;
            sent += 1;
            let (first, last) = (block.offset_ticks[0], block.offset_ticks[block.len() - 1]);
            let end = f64::from(last + block.duration_ticks[0]) / f64::from(TICKS);
            let from = f64::from(first) / f64::from(TICKS);
            // Blocks are cut in steps of 1/32: one may be ahead of or behind the others by one step, plus a whole integration
            // of 2 s at most.
            let (from, end) = match drop {
                StoreDrop::Oldest => (1.0 - from, 1.0 - end),
                _ => (end, from),
            };
            assert!(end.abs() < 1e-3, "{drop:?} {}: other end {end}", block.pair);
            assert!((from - part).abs() < part / 16.0 + 1e-3, "{drop:?} {part} {}: {from}", block.pair);
        }
        assert_eq!((held, sent), (room, blocks.len()), "{drop:?}");
    }
}
