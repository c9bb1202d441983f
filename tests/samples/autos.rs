//! Auto-correlations.

use std::f64::consts::PI;
use std::path::Path;

use lunarray::array::ArrayConfig;
use lunarray::calibration::VanVleck;
use lunarray::frames::{AutoPower, Flags, VisibilityBlock};
use lunarray::mother::correlator::Division;
use lunarray::products::summarise;
use lunarray::sky::fits::{WriteOptions, write_map};
use lunarray::sky::{Frame, SkyMap};
use lunarray::units::{StreamKind, random_stream};
use rand_distr::{Distribution, Exp1};

use crate::craft::{Spacecraft, WIDTH_HZ, block_by_block, constant};

fn is_auto(block: &&VisibilityBlock) -> bool {
    block.pair.i == block.pair.j
}

#[test]
fn auto_correlations_have_the_power_and_noise_of_sky_and_receiver() {
    let mut craft = Spacecraft::new(ArrayConfig::default(), vec![1e6, 5e6], constant(0.2), 16.384);
    craft.receiver_noise_k_sr = 1.0;
    craft.auto_integration_s = 0.5;
    for (bits, bands) in [(32, 1), (2, 1), (32, 4)] {
        craft.daughters.bits = bits;
        craft.division = Division { sub_bands: bands, delay_centre: None };
        let mut blocks = craft.run(31);
        let (mut sum, mut weight, mut squares, mut count) = (0.0, 0.0, 0.0, 0.0);
        for block in blocks.iter_mut().filter(|block| is_auto(&&**block)) {
            if bits == 2 {
                VanVleck::new(2).unwrap().apply(block, WIDTH_HZ);
            }
            let ticks: u32 = block.duration_ticks.iter().sum();
            assert_eq!(ticks, 16_384_000, "{}", block.pair);
            assert!(block.flags.iter().all(|flags| *flags == Flags::GOOD));
            for k in 0..block.len() {
                // Whole blocks of 128 ms.
                assert!(block.duration_ticks[k] <= 500_000 && block.duration_ticks[k] >= 128_000);
                let (value, own) = (f64::from(block.value_k_sr[k].re), f64::from(block.weight[k]));
                assert_eq!(block.value_k_sr[k].im, 0.0);
                // P^2 / n, with the measured power.
                let samples = f64::from(block.duration_ticks[k]) * 1e-6 * WIDTH_HZ / bands as f64;
                assert!(bits == 2 || (own * value * value / samples - 1.0).abs() < 1e-3, "{own}");
                sum += value * samples;
                weight += samples;
                squares += (value - 2.0).powi(2) * samples / 4.0;
                count += 1.0;
            }
        }
        assert_eq!(count, 43.0 * 16.0 * bands as f64);
        let (mean, error) = (sum / weight, 2.0 / weight.sqrt());
        // Daughters share 0.1 of their power, so 0.01 of the noise of their powers. With two bits, powers are relative to
        // the level control's estimate of the first seconds: within 3 % of 2.
        let level = if bits == 2 { 0.06 } else { 0.0 };
        assert!((mean - 2.0).abs() < 4.0 * 1.05 * error + level, "{bits} bits, {bands}: {mean} +- {error}");
        // Two bits have less noise in their power, because most samples have one of two levels.
        let chi = squares / count;
        assert!(bits == 2 || (chi - 1.0).abs() < 4.0 * (2.0 / count).sqrt(), "{bands}: {chi}");
    }
}

#[test]
fn means_of_powers_weight_all_samples_equally_however_short_an_integration() {
    // 1 s in a band of 16 Hz; every third integration is cut to half.
    let (count, mut samples, power_k_sr) = (30_000_u32, 0.0, 3.0);
    let mut rng = random_stream(5, StreamKind::Spectrometer, [0, 0]);
    let mut power = |k: u32| {
        let n = if k.is_multiple_of(3) { 8 } else { 16 };
        samples += f64::from(n);
        // |x|^2 of a complex Gaussian; its noise is estimated from the measured power, as the mother does.
        let sum: f64 = (0..n).map(|_| -> f64 { Exp1.sample(&mut rng) }).sum();
        let found_k_sr = power_k_sr * sum / f64::from(n);
        AutoPower {
            daughter: 0,
            frequency_hz: 1e6,
            width_hz: 16.0,
            time_s: f64::from(k),
            power_k_sr: found_k_sr,
            sigma_k_sr: found_k_sr / f64::from(n).sqrt(),
        }
    };
    let powers: Vec<AutoPower> = (0..count).map(&mut power).collect();
    let summaries = summarise(&powers);
    let [own] = &summaries[..] else { panic!("{summaries:?}") };
    let sigma_k_sr = power_k_sr / samples.sqrt();
    assert!((own.mean_k_sr - power_k_sr).abs() < 4.0 * sigma_k_sr, "{own:?}");
    // Standard error of the mean.
    assert!((own.sigma_k_sr / sigma_k_sr - 1.0).abs() < 4.0 / samples.sqrt(), "{own:?}");
    // The mean of n such squares has kurtosis 3 + 6 / n.
    let error = ((2.0 + 6.0 / 8.0) / f64::from(count)).sqrt();
    assert!((own.chi_square - 1.0).abs() < 4.0 * error, "{own:?}");
}

#[test]
fn powers_with_missing_blocks_are_flagged_and_weigh_less() {
    let mut craft = Spacecraft::new(ArrayConfig::default(), vec![1e6], constant(0.0), 2.048);
    craft.auto_integration_s = 0.256;
    let frames = block_by_block(craft.sample(32).0, |block| {
        let lost = block.daughter == 3 && [4, 8, 9].contains(&block.number);
        (!lost).then_some(block)
    });
    let blocks = craft.correlate(frames).0;
    let autos: Vec<&VisibilityBlock> = blocks.iter().filter(is_auto).collect();
    assert_eq!(autos.len(), 8);
    for block in autos {
        // Two blocks per integration; an integration without blocks is omitted.
        let lost = block.pair.i == 3;
        assert_eq!(block.len(), if lost { 7 } else { 8 }, "{}", block.pair);
        for k in 0..block.len() {
            let half = lost && block.offset_ticks[k] == 2 * 256_000;
            let flags = if half { Flags::INCOMPLETE } else { Flags::GOOD };
            let samples = if half { 1024.0 } else { 2048.0 };
            assert_eq!(block.flags[k], flags, "{} {k}", block.pair);
            let found = f64::from(block.weight[k]) * f64::from(block.value_k_sr[k].re).powi(2);
            assert!((found / samples - 1.0).abs() < 1e-5, "{} {k}: {found}", block.pair);
        }
    }
}

/// Runs the program with an output folder and settings.
fn lunarray(command: &[&str], out: &Path, sets: &[String]) {
    let mut run = assert_cmd::Command::cargo_bin("lunarray").unwrap();
    run.args(command).args(["--out", out.to_str().unwrap()]);
    let done = run.args(sets.iter().flat_map(|set| ["--set", set])).output().unwrap();
    assert!(done.status.success(), "{}", String::from_utf8_lossy(&done.stderr));
}

fn table(folder: &Path) -> String {
    std::fs::read_to_string(folder.join("autos.csv")).unwrap()
}

const TEMPERATURE_K: f64 = 1e6;
const RECEIVER_K_SR: f64 = 1e6;
const MAP: [&str; 4] =
    ["map.nside=4", "map.epsilon=1e-2", "map.snapshot_every_s=0.0", "calibration.sub_bands=2"];

/// Checks samples of a uniform sky with one antenna, in two sub-bands; the expected power of a daughter is `expected_k_sr`.
fn check_uniform(folder: &Path, antenna: &str, expected_k_sr: f64) {
    let sky = folder.join("sky.fits");
    let map = SkyMap::new(Frame::Ecliptic, vec![TEMPERATURE_K; 12 * 32 * 32]).unwrap();
    write_map(&sky, &map, &WriteOptions::default()).unwrap();
    let out = folder.join(antenna);
    let mut sets: Vec<String> = MAP.map(str::to_owned).to_vec();
    let own = [
        "spacecraft.fidelity=samples",
        "spacecraft.channels_hz=[2e6]",
        "spacecraft.duration_s=9e3",
        "spacecraft.window_s_max=8.0",
        // The last daughters see the Earth for 64 s of a window.
        "spacecraft.flag_earth=false",
        "spacecraft.every_nth_window=1",
        "spacecraft.every_nth_integration=1",
        "spacecraft.baseline_wavelengths_max=10.0",
        "spacecraft.sub_bands=2",
    ];
    sets.extend(own.map(str::to_owned));
    sets.push(format!("spacecraft.antenna={antenna}"));
    sets.push(format!("spacecraft.receiver_noise_k_sr={RECEIVER_K_SR:e}"));
    sets.push(format!("sky.file={:?}", sky.to_str().unwrap()));
    lunarray(&["run"], &out, &sets);
    let text = std::fs::read_to_string(out.join("autos.json")).unwrap();
    let summaries: Vec<serde_json::Value> = serde_json::from_str(&text).unwrap();
    assert_eq!(summaries.len(), 16);
    for (k, own) in summaries.iter().enumerate() {
        let at = |key: &str| own[key].as_f64().unwrap();
        assert_eq!((at("frequency_hz"), at("width_hz")), (2e6 - 2e3 + 4e3 * (k / 8) as f64, 4e3));
        assert_eq!(at("daughter"), (k % 8 + 1) as f64);
        // At nside 32, pixels on the limb count whole: some 100 of 12288, each wrong by half a pixel at random, 5 in the
        // mean square.
        let (mean, sigma) = (at("mean_k_sr"), at("sigma_k_sr"));
        assert!((mean - expected_k_sr).abs() < 4.0 * sigma + 2e-3 * expected_k_sr, "{own} {expected_k_sr}");
        // 32000 frames of two samples.
        assert!((sigma * 32_000.0_f64.sqrt() / expected_k_sr - 1.0).abs() < 0.05, "{own}");
    }
    assert!(out.join("autos.png").exists());
    let table_k = table(&out);
    let head = "frequency_hz,width_hz,daughter,time_s,power_k_sr,sigma_k_sr";
    // Seven blocks per integration, 62.5 in the window.
    assert_eq!((table_k.lines().next(), table_k.lines().count()), (Some(head), 1 + 16 * 9));
    // The ground segment alone gets it from the downlink bytes.
    let ground = folder.join("ground");
    let downlink = out.join("downlink.ccsds");
    lunarray(&["replay", downlink.to_str().unwrap()], &ground, &MAP.map(str::to_owned));
    assert_eq!(table_k, table(&ground));
}

#[test]
fn the_mean_of_a_uniform_sky_arrives_as_a_table() {
    let folder = tempfile::tempdir().unwrap();
    // The sphere without the Moon's cap, sin a = R / r.
    let sin = 1737.1_f64 / 2037.1;
    let cos = (1.0 - sin * sin).sqrt();
    check_uniform(folder.path(), "isotropic", TEMPERATURE_K * 2.0 * PI * (1.0 + cos) + RECEIVER_K_SR);
    // Dipoles normal to the orbit, perpendicular to the Moon's direction: the integral of 1 - sin^2 t cos^2 p.
    let dipole = PI * ((1.0 + cos) + (1.0 + cos.powi(3)) / 3.0);
    check_uniform(folder.path(), "dipole-normal", TEMPERATURE_K * dipole + RECEIVER_K_SR);
}
