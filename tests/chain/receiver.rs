//! Receivers by channel, and the Moon's own emission, through the chain: over a sky of 0 K nothing else is there.

use std::f64::consts::{PI, TAU};
use std::path::Path;

use lunarray::array::{Array, ArrayConfig};
use lunarray::downlink::DownlinkReader;
use lunarray::frames::{GroundFrame, VisibilityBlock};
use lunarray::sky::fits::{WriteOptions, write_map};
use lunarray::sky::{Frame, SkyMap};
use lunarray::units::vector::{norm, sub};

use super::common::workplace::{Workplace, fail};

/// The whole mission, thinned out.
const DARK: &str = r#"
name = "dark"
seed = 4
[sky]
l_max = 16
[spacecraft]
channels_hz = [1.0e6, 3.0e6, 10.0e6]
every_nth_window = 400
every_nth_integration = 20
baseline_wavelengths_max = 16.0
thermal_noise = false
auto_powers = true
auto_integration_s = 500.0
[map]
engine = 'pixel'
nside = 4
"#;

const CHANNELS_HZ: [f64; 3] = [1e6, 3e6, 10e6];
const WIDTH_HZ: f64 = 8e3;

/// The blocks of a simulation of a sky of 0 K at this nside.
fn simulate(nside: usize, set: &[&str]) -> Vec<VisibilityBlock> {
    simulate_sky(nside, 0.0, set)
}

/// Of a sky with the same temperature everywhere.
fn simulate_sky(nside: usize, sky_k: f64, set: &[&str]) -> Vec<VisibilityBlock> {
    let place = Workplace::new(DARK);
    let sky = place.path("dark.fits");
    let map = SkyMap::new(Frame::Ecliptic, vec![sky_k; 12 * nside * nside]).unwrap();
    write_map(Path::new(&sky), &map, &WriteOptions::default()).unwrap();
    // One a channel, as the map says no frequency.
    let file = format!("sky.file={:?}", CHANNELS_HZ.map(|_| &sky));
    let set: Vec<&str> = [&[file.as_str()], set].concat().iter().flat_map(|set| ["--set", *set]).collect();
    let downlink = place.simulate("downlink.ccsds", &set);
    let mut reader = DownlinkReader::open(Path::new(&downlink)).unwrap();
    let mut found = Vec::new();
    while let Some(frame) = reader.next_frame().unwrap() {
        if let GroundFrame::Visibilities(block) = frame {
            found.push(block);
        }
    }
    found
}

#[test]
fn weights_are_those_of_the_radiometer_equation_in_each_channel() {
    let noise = [
        "spacecraft.receiver_noise_k_sr=[[1e6,2e4],[2e6,1e4],[4e6,2500.0],[20e6,100.0]]",
        "spacecraft.receiver_knee_hz=5e5",
        "spacecraft.interference_floor_k_sr=[0.0,50.0,7.0]",
    ];
    // Between 2 and 4 MHz the table falls as nu^-2, between 4 and 20 MHz as nu^-2 too: 4e16 / nu^2.
    let expected_k_sr = [2e4 * 1.5, 4e16 / 9e12 * (1.0 + 0.5 / 3.0) + 50.0, 400.0 * 1.05 + 7.0];
    let (mut pairs, mut autos) = ([0; 3], [0; 3]);
    for block in simulate(8, &noise) {
        let channel = usize::from(block.channel.0);
        let power: f64 = expected_k_sr[channel];
        for k in 0..block.len() {
            let samples = WIDTH_HZ * 1e-6 * f64::from(block.duration_ticks[k]);
            let is_auto = block.pair.i == block.pair.j;
            // Values and weights are f32. sigma^2 = P^2 / (2 dnu dt) of a part of a visibility, P^2 / (dnu dt) of a power.
            let (count, value, parts) = match is_auto {
                true => (&mut autos, power, 1.0),
                false => (&mut pairs, 0.0, 2.0),
            };
            count[channel] += 1;
            let weight = f64::from(block.weight[k]) * power * power / (parts * samples);
            assert!((weight - 1.0).abs() < 1e-6, "{channel}: {weight}");
            assert!((f64::from(block.value_k_sr[k].re) - value).abs() < 1e-6 * power);
        }
    }
    assert!(pairs.iter().chain(&autos).all(|&count| count > 50), "{pairs:?} {autos:?}");
}

#[test]
fn samples_have_the_noise_of_their_channel() {
    let set = [
        "spacecraft.fidelity=\"samples\"",
        "spacecraft.thermal_noise=true",
        "spacecraft.window_s_max=4.0",
        "spacecraft.every_nth_window=100000",
        "spacecraft.auto_integration_s=1.0",
        "spacecraft.flag_earth=false",
        "spacecraft.receiver_noise_k_sr=[3e5,2e5,1e5]",
        "spacecraft.receiver_knee_hz=1e6",
        "spacecraft.interference_floor_k_sr=4e4",
        "daughters.bits=32",
    ];
    let (mut sums, mut weights) = ([0.0; 3], [0.0; 3]);
    for block in simulate(8, &set).iter().filter(|block| block.pair.i == block.pair.j) {
        for k in 0..block.len() {
            let samples = WIDTH_HZ * 1e-6 * f64::from(block.duration_ticks[k]);
            sums[usize::from(block.channel.0)] += f64::from(block.value_k_sr[k].re) * samples;
            weights[usize::from(block.channel.0)] += samples;
        }
    }
    let expected_k_sr = [6e5 + 4e4, 2e5 * (1.0 + 1.0 / 3.0) + 4e4, 1e5 * 1.1 + 4e4];
    for (k, expected) in expected_k_sr.into_iter().enumerate() {
        let power: f64 = sums[k] / weights[k] / expected;
        // Eight daughters of some 4 s; consecutive samples are not quite independent: five times the noise, and as much again.
        assert!(
            weights[k] > 1e5 && (power - 1.0).abs() < 10.0 / f64::sqrt(weights[k]),
            "{k}: {power} {}",
            weights[k]
        );
    }
}

#[test]
fn a_table_that_does_not_cover_a_channel_is_refused() {
    let place = Workplace::new(DARK);
    let set = "spacecraft.receiver_noise_k_sr=[[2e6,1e4],[30e6,100.0]]";
    let refused = fail(&["check", &place.pipeline, "--set", set]);
    let expected = "spacecraft.receiver_noise_k_sr = (2000000 Hz to 30000000 Hz): expected a table that covers \
                    channels_hz[0] = 1000000";
    assert!(refused.contains(expected), "{refused}");
}

const MOON_K: f64 = 250.0;

/// The Moon's disc for a baseline of `u` wavelengths across the line to its centre, K sr: `T Int exp(-2 pi i u sin(theta) cos(phi))`
/// over the cap of half angle theta_m; and what is hidden from one daughter alone, to first order in half the angle between their
/// caps, `tilt`: strips `tilt |cos(phi)|` wide along the limb.
fn disc_k_sr(theta_m: f64, u: f64, tilt: f64) -> f64 {
    let (rings, places) = (400, 720);
    let phi = |k: usize| TAU * (k as f64 + 0.5) / places as f64;
    let mut sum = 0.0;
    for ring in 0..rings {
        let theta = theta_m * (ring as f64 + 0.5) / rings as f64;
        let mean: f64 = (0..places).map(|k| (TAU * u * theta.sin() * phi(k).cos()).cos()).sum();
        sum += mean * theta.sin() * theta_m / rings as f64;
    }
    let limb = |k: usize| phi(k).cos().abs() * (TAU * u * theta_m.sin() * phi(k).cos()).cos();
    sum += tilt * theta_m.sin() * (0..places).map(limb).sum::<f64>();
    MOON_K * sum * TAU / places as f64
}

#[test]
fn the_moon_shines_for_pairs_and_powers_with_every_model() {
    let array = Array::new(&ArrayConfig::default()).unwrap();
    let theta_m = (array.moon_radius_m() / array.orbit_radius_m()).asin();
    let receiver_k_sr = 1.0;
    let power_k_sr = receiver_k_sr + MOON_K * TAU * (1.0 - theta_m.cos());
    assert!((power_k_sr - 751.3).abs() < 0.5);
    // Pixels of the limb, 3.07 nside sin(theta_m) = 167, are in or out as a whole: rms sqrt(1 / 12) of a pixel each, 0.24 K sr
    // in all, of which five. The others: 5e-5 of the disc and of the rule of rings.
    let pixels_k_sr = MOON_K * 4.0 * PI / (12.0 * 64.0 * 64.0) * (167.0_f64 / 12.0).sqrt();
    for (model, tolerance_k_sr) in [("direct", 5.0 * pixels_k_sr), ("harmonic", 0.05), ("general", 0.05)] {
        let set = [
            format!("spacecraft.model={model}"),
            format!("spacecraft.moon_temperature_k={MOON_K}"),
            format!("spacecraft.receiver_noise_k_sr={receiver_k_sr:?}"),
            "spacecraft.every_nth_window=1500".to_owned(),
        ];
        let set: Vec<&str> = set.iter().map(String::as_str).collect();
        let (mut worst, mut worst_power, mut strongest, mut counted) = (0.0_f64, 0.0_f64, 0.0_f64, 0);
        for block in simulate(64, &set) {
            for k in 0..block.len() {
                let (t_s, value) = (block.middle_s(k), block.value_k_sr[k]);
                if block.pair.i == block.pair.j {
                    worst_power = worst_power.max((f64::from(value.re) - power_k_sr).abs());
                    continue;
                }
                let at = |n: u8| array.position_m(n.into(), t_s);
                let baseline_m = norm(sub(at(block.pair.i), at(block.pair.j)));
                let u = baseline_m * CHANNELS_HZ[usize::from(block.channel.0)] / 299_792_458.0;
                let expected = disc_k_sr(theta_m, u, 0.5 * baseline_m / array.orbit_radius_m());
                let off = f64::hypot(f64::from(value.re) - expected, f64::from(value.im));
                (worst, strongest, counted) = (worst.max(off), strongest.max(expected.abs()), counted + 1);
            }
        }
        println!("{model}: {counted}, {worst} of {strongest}, powers {worst_power}");
        assert!(counted > 300 && strongest > 10.0, "{counted} {strongest}");
        assert!(worst < tolerance_k_sr, "{model}: {worst} K sr, of at most {strongest}");
        let of_powers = if model == "harmonic" { 0.05 } else { 5.0 * pixels_k_sr };
        assert!(worst_power < of_powers, "{model}: {worst_power}");
    }
}

#[test]
fn a_round_moon_reflects_into_its_disc() {
    let array = Array::new(&ArrayConfig::default()).unwrap();
    let disc_sr = TAU * (1.0 - (1.0 - (array.moon_radius_m() / array.orbit_radius_m()).powi(2)).sqrt());
    let set = ["spacecraft.moon_reflection=0.07", "spacecraft.moon_mirror=sphere", "spacecraft.model=direct"];
    let set =
        [&set[..], &["spacecraft.every_nth_window=3000", "spacecraft.every_nth_integration=200"]].concat();
    // In a sky of 100 K everywhere the mirror shows 7 K; pixels of the limb as above.
    let expected_k_sr = 100.0 * (4.0 * PI - disc_sr) + 7.0 * disc_sr;
    let tolerance_k_sr = 5.0 * 100.0 * 4.0 * PI / (12.0 * 64.0 * 64.0) * (167.0_f64 / 12.0).sqrt();
    let mut counted = 0;
    for block in simulate_sky(64, 100.0, &set).iter().filter(|block| block.pair.i == block.pair.j) {
        for value in &block.value_k_sr {
            counted += 1;
            let off = f64::from(value.re) - expected_k_sr;
            assert!(off.abs() < tolerance_k_sr, "{} {expected_k_sr}", value.re);
        }
    }
    assert!(counted > 50, "{counted}");
}
