//! Durations and weights of integrations.

use lunarray::array::{Array, ArrayConfig};
use lunarray::frames::{Flags, SampleBlock, Samples, SpaceFrame};
use lunarray::units::constants::SPEED_OF_LIGHT_M_S;
use lunarray::units::vector::{norm, sub};
use lunarray::units::{ChannelId, all_pairs};

use lunarray::mother::correlator::Division;
use lunarray::mother::{Fidelity, IntegrationTooShort, SpacecraftConfig};

use crate::craft::{Spacecraft, WIDTH_HZ, block_by_block, constant};

#[test]
fn no_baseline_moves_more_than_an_eighth_of_a_wavelength() {
    let frequencies_hz = vec![3e6, 10e6, 30e6];
    let craft = Spacecraft::new(ArrayConfig::default(), frequencies_hz, constant(0.0), 60.0);
    for (channel, frequency_hz) in craft.frequencies_hz.iter().enumerate() {
        // Missing samples cost nothing to correlate, and are integrated all the same.
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
                    // Whole dumps of an eighth of the shortest integration, or of 2 ms, shorten integrations by at most that.
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
    // Some blocks are lost, some duplicated, and some late.
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
                        // Missing samples are omitted from the mean, not counted as zero.
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

#[test]
fn the_first_weights_of_a_window_are_as_accurate_as_later_ones() {
    for (bands, block_samples) in [(64, 1024), (64, 256), (1, 256)] {
        let mut craft = Spacecraft::new(ArrayConfig::default(), vec![1e6], constant(0.0), 16.384);
        craft.division = Division { sub_bands: bands, delay_centre: None };
        craft.daughters.block_samples = block_samples;
        craft.rule.duration_s_max = 0.25;
        let blocks = craft.run(51);
        let (mut sum, mut count, mut worst) = (0.0, 0.0, 0.0_f64);
        for block in &blocks {
            for k in 0..block.len() {
                // Powers are one, so a weight is twice the number of samples.
                let samples = f64::from(block.duration_ticks[k]) * 1e-6 * WIDTH_HZ / bands as f64;
                let found = f64::from(block.weight[k]) / (2.0 * samples);
                worst = worst.max((found - 1.0).abs());
                if block.offset_ticks[k] == 0 {
                    sum += found;
                    count += 1.0;
                }
            }
        }
        assert_eq!(count, 28.0 * bands as f64);
        // Powers of 1024 samples are accurate to 1/32; there are 8 of each band, and a weight has two of them. The mean of
        // inverse powers is 1/1024 too large. Later powers are averages of 10 s, 1250 samples and more.
        let (mean, error) = (sum / count, 1.0 / 32.0);
        let expected = 1.0 + 2.0 / 1024.0;
        let common = 2.0 * error / (8.0 * bands as f64).sqrt();
        assert!((mean - expected).abs() < 4.0 * common, "{bands} bands, {block_samples}: {mean}");
        // 1792 products at each of some ten independent times: five sigma.
        assert!(worst < 5.0 * error * 2.0_f64.sqrt() + 0.02, "{bands} bands, {block_samples}: {worst}");
    }
}

#[test]
fn integrations_shorter_than_the_correlators_sums_are_refused() {
    let array = Array::new(&ArrayConfig::default()).unwrap();
    let config = |frequency_hz: f64, motion: f64, limit: f64, sub_bands: usize| SpacecraftConfig {
        fidelity: Fidelity::Samples,
        channels_hz: vec![frequency_hz],
        motion_wavelengths_max: motion,
        baseline_wavelengths_max: lunarray::units::PerChannel::All(limit),
        sub_bands,
        ..SpacecraftConfig::default()
    };
    // Daughters 100 km apart, of 1551.7 m/s on a circle of 2037.1 km, pass at 76.2 m/s: a thousandth of 10 m takes 0.131 ms,
    // an eighth of it 16.4 ms.
    let speed_m_s = std::f64::consts::TAU / 8248.68 * 2.0 * 2037.1e3 * (100.0_f64 / 2.0 / 2037.1).sin();
    let dt_s = |motion: f64| motion * SPEED_OF_LIGHT_M_S / 30e6 / speed_m_s;
    let problem = config(30e6, 1e-3, 0.0, 1).dump_problem(&array);
    let Some(IntegrationTooShort { shortest_s, dump_s }) = &problem else { panic!("{problem:?}") };
    // The node's motion adds 1e-4 to speeds.
    assert!((shortest_s / dt_s(1e-3) - 1.0).abs() < 1e-3, "{shortest_s}");
    assert_eq!(*dump_s, 16.0 / WIDTH_HZ);
    let said = problem.unwrap().to_string();
    assert!(said.contains("1.31") && said.contains("2.000e-3 s"), "{said}");
    for (config, refused) in [
        (config(30e6, 0.125, 0.0, 1), false),
        (config(30e6, 0.125, 0.0, 64), false),
        // 64 samples, one of each sub-band, are 8 ms.
        (config(30e6, 0.05, 0.0, 64), true),
        (config(30e6, 0.05, 0.0, 1), false),
        // 10 wavelengths of 10 m move at a thousandth of the speed of 10000.
        (config(30e6, 1e-3, 10.0, 1), false),
        (SpacecraftConfig { integration_s_max: 1.9e-3, ..config(1e6, 0.125, 0.0, 1) }, true),
        (SpacecraftConfig { fidelity: Fidelity::Visibilities, ..config(30e6, 1e-3, 0.0, 1) }, false),
    ] {
        assert_eq!(config.dump_problem(&array).is_some(), refused, "{config:?}");
    }
    let set = |text: &str| text.to_owned();
    let source = lunarray::pipeline::ConfigSource {
        overrides: vec![
            set("spacecraft.fidelity=samples"),
            set("spacecraft.channels_hz=[30e6]"),
            set("spacecraft.motion_wavelengths_max=0.001"),
            set("spacecraft.baseline_wavelengths_max=0.0"),
            set("spacecraft.every_nth_integration=1"),
        ],
        ..lunarray::pipeline::ConfigSource::default()
    };
    let said = source.load().unwrap_err().to_string();
    assert!(said.contains("dumps of 2.000e-3 s"), "{said}");
}
