//! Noise of correlations, of perfect samples and of quantised ones.

use std::f64::consts::FRAC_2_PI;

use lunarray::array::ArrayConfig;
use lunarray::calibration::VanVleck;

use crate::craft::{Spacecraft, WIDTH_HZ, constant, frequencies, moments, values};

#[test]
fn noise_is_what_the_radiometer_equation_says_for_any_integration_time() {
    // An empty sky and receivers of 2 K sr.
    let mut craft = Spacecraft::new(ArrayConfig::default(), frequencies(30), constant(0.0), 4.0);
    craft.receiver_noise_k_sr = 1.0;
    let frames = craft.sample(1).0;
    for dt_s in [0.008, 0.08, 0.16, 0.4] {
        // No baseline of these moves far enough in this time to shorten it, or it is left out by `values`.
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
        // The empty sky: nothing is there.
        assert!(mean.norm() < 4.0 * (2.0 * expected / values.len() as f64).sqrt(), "{mean}");
    }
}

#[test]
fn quantisers_lose_what_they_are_known_to_lose() {
    // Signal to noise of a correlation of 0.05, against that of perfect samples (Thompson, Moran & Swenson).
    for (bits, efficiency) in [(1, FRAC_2_PI), (2, 0.881), (4, 0.9881), (8, 1.0), (32, 1.0)] {
        let sky = constant(0.05);
        let mut craft = Spacecraft::new(ArrayConfig::default(), frequencies(30), sky, 4.0);
        let dt_s = 0.04;
        craft.rule.duration_s_max = dt_s;
        craft.daughters.bits = bits;
        let values = values(&craft.run(2), dt_s);
        let (mean, variance) = moments(&values);
        let (n, samples) = (values.len() as f64, WIDTH_HZ * dt_s);
        // At a correlation of 0.05 in power, 0.05 of a power of one; perfect noise has 1 / (2 samples).
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

/// Of the real or the imaginary parts: mean square about zero, as a part of what is expected.
fn part_ratio(parts: impl Iterator<Item = f64>, expected: f64) -> (f64, f64) {
    let (sum, count) = parts.fold((0.0, 0.0), |(sum, count), x| (sum + x * x, count + 1.0));
    (sum / count / expected, count)
}

#[test]
fn quantised_noise_is_the_radiometers_over_the_efficiency_for_any_integration_time() {
    // The efficiency is that of a signal-to-noise ratio (Thompson, Emerson & Schwab 2007; Thompson, Moran & Swenson
    // 2017, Sect. 8.3), in amplitudes: the variance of a correlation that is told right grows with its square.
    // Table 8.2, for even steps: 2/pi, 0.88115 and 0.98846.
    for (bits, efficiency) in [(1, FRAC_2_PI), (2, 0.88115), (4, 0.98846), (32, 1.0)] {
        let relation = VanVleck::new(bits).ok();
        // No baseline of these moves far enough in 0.4 s to shorten it.
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
                // A quantiser tells powers by its level, known from the 8192 samples of a first block to 1.1 %: of 240
                // of them, each in both factors of a variance, 0.15 %. The curved relation takes 2.5 / (2 n) off the
                // variance of one bit's noise at n samples, less of the others'.
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
            // All integrations are of the same 0.4 s: no baseline moves far enough in it at these frequencies.
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
            // Each pair shares a daughter with 12 others, and all have the common signal's own noise.
            let samples = 16.0 * 4.0 * WIDTH_HZ;
            let error = ((1.0 + 12.0 * cross) / weight + cross * cross / samples).sqrt();
            // Noise passes a curved relation: 3200 samples leave half its curvature times a variance of 1/6400.
            let curvature = 2e-4 * cross;
            assert!(
                (found - cross).abs() < 4.0 * error + curvature,
                "{bits} bits, {cross}: {found} +- {error}"
            );
        }
    }
}
