//! Noise of correlations of unquantised and of quantised samples.

use std::collections::HashMap;
use std::f64::consts::FRAC_2_PI;
use std::path::Path;

use lunarray::array::ArrayConfig;
use lunarray::calibration::VanVleck;
use lunarray::downlink::DownlinkReader;
use lunarray::frames::{GroundFrame, VisibilityBlock};
use lunarray::sky::fits::{WriteOptions, write_map};
use lunarray::sky::generated::{GeneratedSky, generate};
use lunarray::sky::{Frame, SkyMap};
use lunarray::units::Pair;

use crate::craft::{Spacecraft, WIDTH_HZ, constant, frequencies, moments, values};

#[test]
fn noise_follows_the_radiometer_equation_for_any_integration_time() {
    // An empty sky and receivers of 2 K sr.
    let mut craft = Spacecraft::new(ArrayConfig::default(), frequencies(30), constant(0.0), 4.0);
    craft.receiver_noise_k_sr = 1.0;
    let frames = craft.sample(1).0;
    for dt_s in [0.008, 0.08, 0.16, 0.4] {
        // None of these baselines moves far enough to shorten the integration; `values` omits those that do.
        craft.rule.duration_s_max = dt_s;
        let values = values(&craft.correlate(frames.clone()).0, dt_s);
        let (mean, variance) = moments(&values);
        let expected = 2.0 * 2.0 / (2.0 * WIDTH_HZ * dt_s);
        let parts = 2.0 * values.len() as f64;
        // Standard error of a variance; products of two Gaussians have 6 / (2 n) more kurtosis than a Gaussian.
        let samples = WIDTH_HZ * dt_s;
        let error = ((2.0 + 3.0 / samples) / parts).sqrt();
        eprintln!(
            "{dt_s} s: {} values, variance ratio {:.5} +- {error:.5}",
            values.len(),
            variance / expected
        );
        assert!(values.len() > 2_000, "{}", values.len());
        assert!((variance / expected - 1.0).abs() < 3.0 * error);
        // The mean of an empty sky is zero.
        assert!(mean.norm() < 4.0 * (2.0 * expected / values.len() as f64).sqrt(), "{mean}");
    }
}

#[test]
fn quantisers_have_their_published_efficiency() {
    // Signal-to-noise ratio of a correlation of 0.05, relative to unquantised samples (Thompson, Moran & Swenson).
    for (bits, efficiency) in [(1, FRAC_2_PI), (2, 0.881), (4, 0.9881), (8, 1.0), (32, 1.0)] {
        let sky = constant(0.05);
        let mut craft = Spacecraft::new(ArrayConfig::default(), frequencies(30), sky, 4.0);
        let dt_s = 0.04;
        craft.rule.duration_s_max = dt_s;
        craft.daughters.bits = bits;
        let values = values(&craft.run(2), dt_s);
        let (mean, variance) = moments(&values);
        let (n, samples) = (values.len() as f64, WIDTH_HZ * dt_s);
        // A correlation of 0.05 of unit power; the noise variance without quantisation is 1 / (2 samples).
        let found = mean.re / 0.05 / (2.0 * samples * variance).sqrt();
        // Errors of the mean of the real part and of the deviation. Each pair shares a daughter with 12 others,
        // and with it 0.05 of its noise.
        let error = (1.6_f64.sqrt() * variance.sqrt() / n.sqrt() / mean.re).hypot((0.5 / (2.0 * n)).sqrt());
        eprintln!("{bits} bits: efficiency {found:.4} +- {:.4}", error * found);
        // 8 bits are 0.9999; products of a correlation of 0.05 have 1 + 0.05^2 the noise.
        assert!((found / efficiency - 1.0).abs() < 3.0 * error + 1.4e-3, "{bits}: {found}");
        assert!(error < 0.007, "{error}");
    }
}

/// Mean square about zero of real or imaginary parts, relative to the expected value.
fn part_ratio(parts: impl Iterator<Item = f64>, expected: f64) -> (f64, f64) {
    let (sum, count) = parts.fold((0.0, 0.0), |(sum, count), x| (sum + x * x, count + 1.0));
    (sum / count / expected, count)
}

#[test]
fn quantised_noise_is_the_radiometers_over_the_efficiency_for_any_integration_time() {
    // The efficiency is that of a signal-to-noise ratio (Thompson, Emerson & Schwab 2007; Thompson, Moran & Swenson
    // 2017, Sect. 8.3), in amplitudes: the variance of a corrected correlation grows with its inverse square.
    // Table 8.2, for uniform steps: 2/pi, 0.88115 and 0.98846.
    for (bits, efficiency) in [(1, FRAC_2_PI), (2, 0.88115), (4, 0.98846), (32, 1.0)] {
        let relation = VanVleck::new(bits).ok();
        // None of these baselines moves far enough in 0.4 s to shorten the integration.
        let frequencies_hz = (0..30).map(|k| 3e5 + 1e4 * f64::from(k)).collect();
        let mut craft = Spacecraft::new(ArrayConfig::default(), frequencies_hz, constant(0.0), 4.096);
        craft.receiver_noise_k_sr = 1.0;
        craft.daughters.bits = bits;
        craft.daughters.block_samples = 8192;
        let frames = craft.sample(11).0;
        for dt_s in [0.064, 0.16, 0.4] {
            craft.rule.duration_s_max = dt_s;
            let mut blocks = craft.correlate(frames.clone()).0;
            if let Some(relation) = &relation {
                blocks.iter_mut().for_each(|block| relation.apply(block, WIDTH_HZ));
            }
            let values = values(&blocks, dt_s);
            let samples = WIDTH_HZ * dt_s;
            // T_sys of 2 K sr.
            let expected = 2.0 * 2.0 / (2.0 * samples) / (efficiency * efficiency);
            let real = part_ratio(values.iter().map(|v| v.re), expected);
            let imaginary = part_ratio(values.iter().map(|v| v.im), expected);
            for (name, (ratio, count)) in [("real", real), ("imaginary", imaginary)] {
                // As above; a quantiser's products have less kurtosis.
                let error = ((2.0 + 3.0 / samples) / count).sqrt();
                // Quantised powers are relative to the level, which the 8192 samples of a first block determine to 1.1 %; 240
                // of them, each in both factors of a variance, give 0.15 %. The nonlinear relation lowers the variance of
                // one-bit noise at n samples by 2.5 / (2 n), and that of more bits by less.
                let level = if bits < 32 { 3.0 * 0.0015 + 1.25 / samples } else { 0.0 };
                eprintln!("{bits} bits, {dt_s} s, {name}: {count} values, {ratio:.4} +- {error:.4}");
                assert!(count > 7_000.0, "{count}");
                assert!((ratio - 1.0).abs() < 3.0 * error + level, "{bits} bits, {dt_s} s, {name}: {ratio}");
            }
        }
    }
}

#[test]
fn van_vleck_returns_the_amplitude_of_weak_and_strong_correlations() {
    for bits in [1, 2, 4] {
        let relation = VanVleck::new(bits).unwrap();
        for cross in [0.01, 0.1, 0.3, 0.6, 0.9] {
            let sky = constant(cross);
            // All integrations last 0.4 s: no baseline moves far enough at these frequencies to shorten them.
            let frequencies_hz = (0..16).map(|k| 3e5 + 1e4 * f64::from(k)).collect();
            let mut craft = Spacecraft::new(ArrayConfig::default(), frequencies_hz, sky, 4.0);
            craft.rule.duration_s_max = 0.4;
            craft.daughters.bits = bits;
            let mut blocks = craft.run(9);
            let (mut sum, mut weight) = (0.0, 0.0);
            for block in &mut blocks {
                relation.apply(block, WIDTH_HZ);
                for k in 0..block.len() {
                    let w = f64::from(block.weight[k]);
                    sum += w * f64::from(block.value_k_sr[k].re);
                    weight += w;
                }
            }
            let found = sum / weight;
            // Each pair shares a daughter with 12 others, and all share the noise of the common signal.
            let samples = 16.0 * 4.0 * WIDTH_HZ;
            let error = ((1.0 + 12.0 * cross) / weight + cross * cross / samples).sqrt();
            // The relation is nonlinear: noise leaves a bias of half its curvature times a variance of 1/6400, from 3200 samples.
            let curvature = 2e-4 * cross;
            assert!(
                (found - cross).abs() < 4.0 * error + curvature,
                "{bits} bits, {cross}: {found} +- {error}"
            );
        }
    }
}

/// The downlink's visibilities at 10 MHz of two windows of a minute each, under `sky`.
fn downlinked(sky: &Path, fidelity: &str, seed: u64) -> Vec<VisibilityBlock> {
    const PIPELINE: &str = r#"
        name = "noise"
        [spacecraft]
        channels_hz = [1.0e7]
        duration_s = 17e3
        window_s_max = 60.0
        flag_earth = false # the last daughters see the Earth for 64 s of a window
        model = "direct"
        auto_integration_s = 1.024
        auto_powers = true
        [map]
        engine = 'pixel'
        nside = 4
    "#;
    let folder = tempfile::tempdir().unwrap();
    let (pipeline, out) = (folder.path().join("noise.toml"), folder.path().join("downlink.ccsds"));
    std::fs::write(&pipeline, PIPELINE).unwrap();
    let sets = [
        format!("spacecraft.fidelity={fidelity}"),
        format!("seed={seed}"),
        format!("sky.file={:?}", sky.to_str().unwrap()),
    ];
    let mut command = assert_cmd::Command::cargo_bin("lunarray").unwrap();
    command.args(["simulate", pipeline.to_str().unwrap(), "--out", out.to_str().unwrap()]);
    let done = command.args(sets.iter().flat_map(|set| ["--set", set])).output().unwrap();
    assert!(done.status.success(), "{}", String::from_utf8_lossy(&done.stderr));
    let (mut reader, mut found) = (DownlinkReader::open(&out).unwrap(), Vec::new());
    while let Some(frame) = reader.next_frame().unwrap() {
        if let GroundFrame::Visibilities(block) = frame {
            found.push(block);
        }
    }
    found
}

/// Weight per second of each pair.
fn weights(blocks: &[VisibilityBlock]) -> HashMap<Pair, f64> {
    let mut sums: HashMap<Pair, [f64; 2]> = HashMap::new();
    for block in blocks {
        let [weights, seconds] = sums.entry(block.pair).or_default();
        *weights += block.weight.iter().map(|w| f64::from(*w)).sum::<f64>();
        *seconds += block.duration_ticks.iter().map(|ticks| f64::from(*ticks) * 1e-6).sum::<f64>();
    }
    sums.into_iter().map(|(pair, [weights, seconds])| (pair, weights / seconds)).collect()
}

/// Mean square difference of two runs in units of the variance from their weights, and the number of parts.
fn chi_square(first: &[VisibilityBlock], second: &[VisibilityBlock]) -> (f64, f64) {
    let (mut sum, mut count) = (0.0, 0.0);
    assert_eq!(first.len(), second.len());
    for (first, second) in first.iter().zip(second) {
        assert_eq!((first.pair, &first.offset_ticks), (second.pair, &second.offset_ticks));
        for k in 0..first.len() {
            let variance = f64::from(first.weight[k].recip() + second.weight[k].recip());
            sum += f64::from((first.value_k_sr[k] - second.value_k_sr[k]).norm_sqr()) / variance;
            count += 2.0;
        }
    }
    (sum / count, count)
}

type Runs = [Vec<VisibilityBlock>; 2];

/// Visibilities of pairs, and auto-correlations in the order of daughters.
fn split(runs: Runs) -> (Runs, Runs) {
    let parts = runs.map(|run| run.into_iter().partition::<Vec<_>, _>(|block| block.pair.i != block.pair.j));
    let [(first, mut first_own), (second, mut second_own)] = parts;
    for own in [&mut first_own, &mut second_own] {
        own.sort_by_key(|block| (block.start, block.pair.i));
    }
    ([first, second], [first_own, second_own])
}

/// Compares auto-correlations of sample fidelity (two seeds) with those of visibility fidelity: shapes, means, noise and
/// weights.
fn check_powers(powers: &[Runs]) {
    let [samples, visibilities] = powers else { panic!("two fidelities") };
    for runs in powers {
        assert_eq!((runs[0].len(), runs[1].len()), (16, 16));
        // Visibilities have noise in both parts, auto-correlations in one.
        let (found, parts) = chi_square(&runs[0], &runs[1]);
        let (found, count) = (2.0 * found, 0.5 * parts);
        // A weight uses the measured power, accurate to 1/8192 in the square, which is negligible here.
        assert!((found - 1.0).abs() < 4.0 * (2.0 / count).sqrt(), "{found} of {count}");
    }
    for (sampled, drawn) in samples[0].iter().zip(&visibilities[0]) {
        assert_eq!((sampled.channel, sampled.pair, sampled.start), (drawn.channel, drawn.pair, drawn.start));
        assert_eq!(sampled.offset_ticks, drawn.offset_ticks);
        assert_eq!((&sampled.duration_ticks, &sampled.flags), (&drawn.duration_ticks, &drawn.flags));
        let seconds = |block: &VisibilityBlock, k: usize| f64::from(block.duration_ticks[k]) * 1e-6;
        for block in [sampled, drawn] {
            for k in 0..block.len() {
                let (power, samples) = (f64::from(block.value_k_sr[k].re), seconds(block, k) * WIDTH_HZ);
                assert_eq!(block.value_k_sr[k].im, 0.0);
                assert!((f64::from(block.weight[k]) * power * power / samples - 1.0).abs() < 1e-5);
            }
        }
        let mean = |block: &VisibilityBlock| {
            let of = |k: usize| seconds(block, k) * f64::from(block.value_k_sr[k].re);
            (0..block.len()).map(of).sum::<f64>() / 60.0
        };
        // Both have the noise of a minute. Eight bits change a power by at most a thousandth.
        let error = (2.0 / (60.0 * WIDTH_HZ)).sqrt();
        let ratio = mean(sampled) / mean(drawn);
        assert!((ratio - 1.0).abs() < 4.0 * error + 1e-3, "{}: {ratio} +- {error}", sampled.pair);
    }
}

#[test]
fn weights_and_noise_are_the_same_in_both_fidelities() {
    let folder = tempfile::tempdir().unwrap();
    let sky = folder.path().join("sky.fits");
    let map = SkyMap::new(Frame::Ecliptic, generate(&GeneratedSky::default(), 1e7, 32, 1).unwrap()).unwrap();
    write_map(&sky, &map, &WriteOptions::default()).unwrap();
    let of = |fidelity: &&str| [1, 2].map(|seed| downlinked(&sky, fidelity, seed));
    let (runs, powers): (Vec<_>, Vec<_>) = ["samples", "visibilities"].iter().map(of).map(split).unzip();
    check_powers(&powers);
    let [samples, visibilities] = [&runs[0], &runs[1]].map(|[first, _]| weights(first));
    assert_eq!(samples.len(), 28);
    for (pair, expected) in &visibilities {
        let ratio = samples[pair] / expected;
        // Two powers of two minutes of samples. A weight uses earlier samples, as far as they go back: the integrations of a
        // window's first seconds share one power, so that a sixth of the samples counts twice.
        let error = (2.0 / (2.0 * 60.0 * WIDTH_HZ) * 1.5_f64).sqrt();
        // The mean of inverse powers of 1024 samples and more is up to 2e-3 too large in the first seconds.
        assert!((ratio - 1.0).abs() < 4.0 * error + 1e-3, "{pair}: {ratio} +- {error}");
    }
    for [first, second] in &runs {
        let (found, count) = chi_square(first, second);
        // As above; pairs share daughters, but not their noise; weights use powers accurate to half a percent.
        let error = ((2.0 + 3.0 / 400.0) / count).sqrt();
        eprintln!("chi square {found:.4} +- {error:.4} of {count} parts");
        assert!(count > 2e4 && (found - 1.0).abs() < 4.0 * error + 5e-3, "{found} +- {error}");
    }
}
