//! Lengths and weights of integrations.

use lunarray::array::ArrayConfig;
use lunarray::frames::{Flags, SampleBlock, Samples, SpaceFrame};
use lunarray::units::constants::SPEED_OF_LIGHT_M_S;
use lunarray::units::vector::{norm, sub};
use lunarray::units::{ChannelId, all_pairs};

use crate::craft::{Spacecraft, WIDTH_HZ, block_by_block, constant};

#[test]
fn no_baseline_moves_more_than_an_eighth_of_a_wavelength() {
    let frequencies_hz = vec![3e6, 10e6, 30e6];
    let craft = Spacecraft::new(ArrayConfig::default(), frequencies_hz, constant(0.0), 60.0);
    for (channel, frequency_hz) in craft.frequencies_hz.iter().enumerate() {
        // Silence costs nothing to correlate: what is missing is integrated all the same.
        let ends = vec![SpaceFrame::WindowStart(craft.window), SpaceFrame::WindowEnd(craft.window)];
        let (blocks, _) = craft.correlate(ends);
        for pair in all_pairs(8) {
            let mut expected_ticks = 0;
            for block in blocks.iter().filter(|b| b.pair == pair && usize::from(b.channel.0) == channel) {
                for k in 0..block.len() {
                    assert_eq!(block.offset_ticks[k], expected_ticks);
                    expected_ticks += block.duration_ticks[k];
                    let from_s = block.start.seconds() + f64::from(block.offset_ticks[k]) * 1e-6;
                    let until_s = from_s + f64::from(block.duration_ticks[k]) * 1e-6;
                    let baseline = |t_s: f64| {
                        sub(
                            craft.array.position_m(pair.i.into(), t_s),
                            craft.array.position_m(pair.j.into(), t_s),
                        )
                    };
                    let moved =
                        norm(sub(baseline(until_s), baseline(from_s))) * frequency_hz / SPEED_OF_LIGHT_M_S;
                    assert!(moved <= 0.125 * (1.0 + 1e-6), "{pair} {frequency_hz}: {moved}");
                    let last = i64::from(expected_ticks) == craft.window.end.0 - craft.window.start.0;
                    // Whole dumps, of an eighth of the shortest integration or 2 ms: up to so much shorter.
                    let longest = block.duration_ticks[k] > 24_992_000;
                    assert!(last || longest || moved > 0.125 * 0.87, "{pair} {frequency_hz}: {moved}");
                }
            }
            assert_eq!(i64::from(expected_ticks), craft.window.end.0 - craft.window.start.0, "{pair}");
        }
    }
}

#[test]
fn weights_add_up_to_the_samples_that_arrived() {
    let craft = Spacecraft::new(ArrayConfig::default(), vec![5e6, 20e6], constant(0.0), 12.288);
    let ones = |block: SampleBlock| {
        let length = block.samples.len();
        SampleBlock { samples: Samples::Float { re: vec![1.0; length], im: vec![0.0; length] }, ..block }
    };
    // Some blocks are lost, some come again, and some come too late.
    let (mut frames, mut late, mut arrived) = (Vec::new(), Vec::new(), std::collections::HashMap::new());
    let (mut lost, mut again) = (0, 0);
    for frame in block_by_block(craft.sample(6).0, |block| Some(ones(block))) {
        let SpaceFrame::Samples(mut blocks) = frame else {
            if matches!(frame, SpaceFrame::WindowEnd(_)) {
                frames.push(SpaceFrame::Samples(std::mem::take(&mut late)));
            }
            frames.push(frame);
            continue;
        };
        let block = blocks.pop().unwrap();
        let key = block.number * 16 + u64::from(block.channel.0) * 8 + u64::from(block.daughter);
        match key % 37 {
            0 => lost += 1,
            1 if block.number < 80 => late.push(block),
            more => {
                arrived.insert((block.channel, block.daughter, block.number), block.samples.len() as u64);
                if more == 2 {
                    again += 1;
                    frames.push(SpaceFrame::Samples(vec![block.clone()]));
                }
                frames.push(SpaceFrame::Samples(vec![block]));
            }
        }
    }
    let count_late = 1536 - lost - arrived.len() as u64;
    let (blocks, counts) = craft.correlate(frames);
    assert_eq!(
        (counts.blocks.late, counts.blocks.duplicate, counts.blocks.malformed),
        (count_late, again, 0)
    );
    assert_eq!((counts.blocks.used, counts.blocks.missing), (arrived.len() as u64, lost + count_late));
    assert!(lost > 10 && again > 10 && count_late > 10);
    let mut flagged = 0;
    for channel in [ChannelId(0), ChannelId(1)] {
        for pair in all_pairs(8) {
            let of = |daughter, number| arrived.get(&(channel, daughter, number)).copied().unwrap_or(0);
            let expected: u64 = (0..96).map(|number| of(pair.i, number).min(of(pair.j, number))).sum();
            let mut found = 0.0;
            for block in blocks.iter().filter(|b| b.pair == pair && b.channel == channel) {
                for k in 0..block.len() {
                    // Powers are one, so a weight is twice the number of samples.
                    found += f64::from(block.weight[k]) / 2.0;
                    let samples = f64::from(block.duration_ticks[k]) * 1e-6 * WIDTH_HZ;
                    let complete = f64::from(block.weight[k]) / 2.0 > 0.9 * samples;
                    assert_eq!(block.flags[k] == Flags::GOOD, complete, "{pair} {k}");
                    flagged += u64::from(!complete);
                    if complete {
                        // What is missing is left out of the mean, and not counted as nothing.
                        assert!((block.value_k_sr[k].re - 1.0).abs() < 1e-6, "{}", block.value_k_sr[k]);
                    }
                }
            }
            // Weights are f32.
            assert!((found - expected as f64).abs() < 1e-4 * expected as f64, "{pair}: {found} {expected}");
        }
    }
    assert!(flagged > 10);
}
