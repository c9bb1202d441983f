//! Power that is left of a coherent average over errors, against its laws.

use std::f64::consts::TAU;

use num_complex::Complex64;

use super::*;
use crate::array::ArrayConfig;
use crate::units::all_pairs;
use crate::units::constants::SPEED_OF_LIGHT_M_S;
use crate::units::vector::{dot, sub, unit};

const CHANNELS: [Channel; 3] = [
    Channel { frequency_hz: 3e6, width_hz: 8e3 },
    Channel { frequency_hz: 10e6, width_hz: 8e3 },
    Channel { frequency_hz: 30e6, width_hz: 8e3 },
];

/// Passes of a test. The mean of cos over some 4 independent pairs of each of 20,000 passes is good to
/// 0.5 / sqrt(80,000) = 0.002, its square to 0.4 %.
const PASSES: u64 = 20_000;

fn window(index: u64) -> ObservingWindow {
    let start = MissionTime::from_seconds(8248.68 * index as f64);
    ObservingWindow { index, start, end: start.plus_ticks(2_750_000_000) }
}

fn errors(config: InstrumentConfig) -> InstrumentErrors {
    let array = Array::new(&ArrayConfig::default()).unwrap();
    InstrumentErrors::new(&config, 11, &array, &CHANNELS).unwrap()
}

/// Power that a coherent average over passes and pairs keeps, by channel.
fn kept(errors: &InstrumentErrors, passes: u64) -> [f64; 3] {
    let pairs = all_pairs(8);
    let mut sums = [Complex64::ZERO; 3];
    for index in 0..passes {
        let (window, t_s) = (window(index), window(index).start.seconds() + 1000.0);
        let pass = errors.pass(window);
        for (channel, sum) in sums.iter_mut().enumerate() {
            let gains: Vec<Complex64> = (0..8).map(|n| pass.gain(n, channel, t_s)).collect();
            *sum += pairs
                .iter()
                .map(|p| gains[usize::from(p.i)] * gains[usize::from(p.j)].conj())
                .sum::<Complex64>();
        }
    }
    sums.map(|sum| (sum / (passes * pairs.len() as u64) as f64).norm_sqr())
}

#[test]
fn random_phases_keep_exp_of_less_their_variance() {
    for sigma_deg in [0.0, 5.0, 12.0, 20.0, 30.0, 40.0_f64] {
        // Of a baseline: that of an antenna is the root of one half of it.
        let pass_rms = sigma_deg / 2.0_f64.sqrt();
        let mut config =
            InstrumentConfig { outlier_probability: 1.0, outlier_sigma: 1.0, ..Default::default() };
        config.phase_deg.pass_rms = pass_rms;
        let law = (-sigma_deg.to_radians().powi(2)).exp();
        for kept in kept(&errors(config), PASSES) {
            assert!((kept / law - 1.0).abs() < 0.01, "{sigma_deg} deg: {kept} for {law}");
        }
    }
}

#[test]
fn constant_phases_and_clocks_keep_what_their_laws_say() {
    // Over realisations: 12 deg of a baseline, and 1.1 ns, which is 11.9 deg at 30 MHz.
    let sum = |change: &dyn Fn(&mut InstrumentConfig)| {
        let (mut kept, mut count) = ([Complex64::ZERO; 3], 0.0);
        for realisation in 0..PASSES as u32 {
            let mut config = InstrumentConfig { realisation, ..Default::default() };
            change(&mut config);
            let pass = errors(config).pass(window(3));
            for pair in all_pairs(8) {
                for (channel, kept) in kept.iter_mut().enumerate() {
                    let [i, j] = [pair.i, pair.j].map(|n| pass.gain(n.into(), channel, 3e4));
                    *kept += i * j.conj();
                }
                count += 1.0;
            }
        }
        kept.map(|sum| (sum / count).norm_sqr())
    };
    let half = 0.5_f64.sqrt();
    for kept in sum(&|config| config.phase_deg.constant_rms = 12.0 * half) {
        assert!((kept / (-12.0_f64.to_radians().powi(2)).exp() - 1.0).abs() < 0.01, "{kept}");
    }
    let of_clock = sum(&|config| config.clock_ns.constant_rms = 1.1 * half);
    for (kept, channel) in of_clock.into_iter().zip(CHANNELS) {
        let sigma = TAU * channel.frequency_hz * 1.1e-9;
        assert!((kept / (-sigma * sigma).exp() - 1.0).abs() < 0.01, "{}: {kept}", channel.frequency_hz);
    }
    // The published tolerance: 95 % are kept at 1.1 ns up to 30 MHz.
    assert!(of_clock[2] > 0.95 && of_clock[2] < 0.965, "{of_clock:?}");
}

#[test]
fn positions_keep_what_their_law_says() {
    // 1 m of a baseline along each axis: 12 deg at 10 MHz in any direction.
    let mut config = InstrumentConfig::default();
    for terms in [&mut config.along_m, &mut config.across_m, &mut config.radial_m] {
        terms.pass_rms = 0.5_f64.sqrt();
    }
    let errors = errors(config);
    let n_hat = [0.48, 0.6, 0.64];
    let (mut sums, mut count) = ([Complex64::ZERO; 3], 0.0);
    for index in 0..PASSES {
        let pass = errors.pass(window(index));
        let t_s = window(index).start.seconds();
        for pair in all_pairs(8) {
            let [i, j] = [pair.i, pair.j].map(|n| pass.offset_m(n.into(), t_s));
            let path_m = dot(n_hat, sub(i, j));
            for (sum, channel) in sums.iter_mut().zip(CHANNELS) {
                *sum += Complex64::cis(TAU * channel.frequency_hz / SPEED_OF_LIGHT_M_S * path_m);
            }
            count += 1.0;
        }
    }
    for (sum, channel) in sums.into_iter().zip(CHANNELS) {
        let sigma = TAU * channel.frequency_hz / SPEED_OF_LIGHT_M_S;
        let (kept, law) = ((sum / count).norm_sqr(), (-sigma * sigma).exp());
        assert!((kept / law - 1.0).abs() < 0.01, "{}: {kept} for {law}", channel.frequency_hz);
    }
}

#[test]
fn packets_say_positions_that_are_off_along_the_named_axes() {
    let array = Array::new(&ArrayConfig::default()).unwrap();
    let mut config = InstrumentConfig::default();
    config.along_m.constant = (0..8).map(f64::from).collect();
    config.radial_m.constant = vec![2.0; 8];
    config.across_m.constant = vec![-3.0; 8];
    let window = window(5);
    let pass = errors(config).pass(window);
    for flown in crate::array::segments_for(&array, window.start, window.end, 60.0) {
        let mut said = flown.clone();
        pass.mislead(&mut said, &array);
        for (k, (said, flown_m)) in said.positions_m.iter().zip(&flown.positions_m).enumerate() {
            let (node, n) = (k / 8, k % 8);
            let t_s = flown.start.plus_ticks(node as i64 * i64::from(flown.step_ticks)).seconds();
            let off = sub(*said, *flown_m);
            // The velocity is along the track but for the breathing, some 1e-4 of it.
            let along = unit(array.state(n, t_s).velocity_m_s);
            assert!((dot(off, along) - n as f64).abs() < 2e-3, "{off:?}");
            assert!((dot(off, unit(*flown_m)) - 2.0).abs() < 1e-6);
            assert!((dot(off, array.normal_hat(n, t_s)) + 3.0).abs() < 1e-6);
        }
    }
}

#[test]
fn dipoles_lean_by_the_angles_that_are_given() {
    let array = std::sync::Arc::new(Array::new(&ArrayConfig::default()).unwrap());
    let mut config = InstrumentConfig::default();
    config.tilt_along_deg.constant = (0..8).map(|n| 2.0 * f64::from(n)).collect();
    config.tilt_radial_deg.pass_rms = 5.0;
    config.pattern.constant = (0..8).map(|n| 0.01 * f64::from(n)).collect();
    let errors = errors(config);
    let windows = [window(0), window(1), window(4)];
    let antennas = AntennaErrors::new(&errors, std::sync::Arc::clone(&array), &windows, true).unwrap();
    for window in windows {
        let (t_s, pass) = (window.start.seconds() + 1000.0, errors.pass(window));
        for n in 0..8_u8 {
            let found = crate::response::model::AntennaPatterns::antenna(&antennas, n, t_s);
            let [along_deg, radial_deg, distortion] = pass.antenna(n.into(), t_s);
            assert!(along_deg == 2.0 * f64::from(n) && distortion == 0.01 * f64::from(n));
            assert!(found.is_dipole && found.distortion == distortion);
            // Seen along the radius the axis is off by one angle, seen along the track by the other.
            let (up, normal) = (unit(array.position_m(n.into(), t_s)), array.normal_hat(n.into(), t_s));
            let track = unit(array.state(n.into(), t_s).velocity_m_s);
            let seen_deg = |axis| dot(found.axis_hat, axis).atan2(dot(found.axis_hat, normal)).to_degrees();
            // The velocity is along the track but for precession and breathing, some 1e-4 of it.
            assert!((seen_deg(track) - along_deg).abs() < 0.02, "{n}: {}", seen_deg(track));
            assert!((seen_deg(up) - radial_deg).abs() < 1e-6, "{n}: {}", seen_deg(up));
        }
    }
    assert!(errors.pass(window(0)).antenna(3, 0.0)[1] != errors.pass(window(1)).antenna(3, 0.0)[1]);
    let straight = self::errors(InstrumentConfig { leak_k_sr: 1.0, ..Default::default() });
    assert!(AntennaErrors::new(&straight, array, &windows, true).is_none());
}

#[test]
fn a_leak_falls_with_the_angle_below_the_limb() {
    let array = Array::new(&ArrayConfig::default()).unwrap();
    let config = InstrumentConfig { leak_k_sr: 1e6, leak_depth_deg: 2.0, ..Default::default() };
    let errors = errors(config);
    let (mut hidden, mut seen) = (0, 0);
    for k in 0..400 {
        let t_s = 20.7 * f64::from(k);
        // The Moon's disc has the angular radius asin(R / r); the Earth's distance from its centre is that from the nadir.
        let r_m = array.position_m(2, t_s);
        let nadir = unit([-r_m[0], -r_m[1], -r_m[2]]);
        let earth_deg = dot(nadir, array.earth_hat(t_s)).acos().to_degrees();
        let disc_deg = (1737.1e3 / 2037.1e3_f64).asin().to_degrees();
        let expected = if earth_deg < disc_deg { (-(disc_deg - earth_deg) / 2.0).exp() } else { 1.0 };
        let found = errors.leak_k_sr(&array, 2, t_s) / 1e6;
        assert!((found / expected - 1.0).abs() < 1e-9, "{t_s}: {found} {expected}");
        assert_eq!(earth_deg < disc_deg, array.earth_depth_of_m(2, t_s) > 0.0);
        (hidden, seen) = if earth_deg < disc_deg { (hidden + 1, seen) } else { (hidden, seen + 1) };
    }
    assert!(hidden > 100 && seen > 100);
}

#[test]
fn everything_wrong_with_the_section_is_said() {
    let text = "dead_daughters = [9]\ndead_channels = [[1, 4]]\noutlier_probability = 2.0\nburst_every_s = 1.0\nburst_s = 2.0\n\
        phase_deg = { constant = [1.0], pass_rms = -1.0, drift_time_s = 1.0 }\nalong_m = { drift_rms = 1.0 }\n\
        tilt_along_deg = { constant_rms = 60.0 }\npattern = { step_rms = 1.0 }\nclock_allan_deviation = 1.0\n\
        clock_steering_s = 1.0\nleak_depth_deg = 0.0\nleak_k_sr = -1.0\n\
        beacon = { k_sr = -1.0, direction_deg = [0.0, 91.0] }";
    let config: InstrumentConfig = toml::from_str(text).unwrap();
    let keys: Vec<String> = config.problems(8, 3, false).into_iter().map(|problem| problem.key).collect();
    let expected = [
        "phase_deg.constant",
        "phase_deg.pass_rms",
        "phase_deg.drift_time_s",
        "along_m.drift_rms",
        "pattern.step_rms",
        "tilt_along_deg",
        "clock_allan_deviation",
        "clock_steering_s",
        "leak_depth_deg",
        "dead_daughters[0]",
        "dead_channels[0]",
        "outlier_probability",
        "leak_k_sr",
        "burst_s",
        "beacon.k_sr",
        "beacon.direction_deg",
    ];
    assert_eq!(keys, expected.map(|key| format!("instrument.{key}")));
    let dead: InstrumentConfig = toml::from_str("dead_daughters = [1]").unwrap();
    assert!(dead.problems(8, 3, false).is_empty() && dead.problems(8, 3, true).len() == 1);
}
