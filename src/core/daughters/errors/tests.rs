//! Power kept by a coherent average over errors, against analytic laws.

use std::f64::consts::TAU;

use num_complex::Complex64;

use super::*;
use crate::array::ArrayConfig;
use crate::frames::AntennaResponse;
use crate::response::MeasuredAntennas;
use crate::units::all_pairs;
use crate::units::constants::SPEED_OF_LIGHT_M_S;
use crate::units::vector::{dot, sub, unit};

const CHANNELS: [Channel; 3] = [
    Channel { frequency_hz: 3e6, width_hz: 8e3 },
    Channel { frequency_hz: 10e6, width_hz: 8e3 },
    Channel { frequency_hz: 30e6, width_hz: 8e3 },
];

/// Number of passes of a test. The mean of cos over some 4 independent pairs of each of 20,000 passes is good to 0.5
/// / sqrt(80,000) = 0.002, its square to 0.4 %.
const PASSES: u64 = 20_000;

fn window(index: u64) -> ObservingWindow {
    let start = MissionTime::from_seconds(8248.68 * index as f64);
    ObservingWindow { index, start, end: start.plus_ticks(2_750_000_000) }
}

fn errors(config: InstrumentConfig) -> InstrumentErrors {
    errors_of(&config, &NavigationConfig::default())
}

fn with_navigation_errors(navigation: &NavigationConfig) -> InstrumentErrors {
    errors_of(&InstrumentConfig::default(), navigation)
}

fn errors_of(config: &InstrumentConfig, navigation: &NavigationConfig) -> InstrumentErrors {
    let array = Array::new(&ArrayConfig::default()).unwrap();
    InstrumentErrors::new(config, navigation, 11, &array, &CHANNELS).unwrap()
}

/// Fraction of the power kept by a coherent average over passes and pairs, by channel.
fn kept_power(errors: &InstrumentErrors, passes: u64) -> [f64; 3] {
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
fn random_phases_keep_exp_of_minus_their_variance() {
    for sigma_deg in [0.0, 5.0, 12.0, 20.0, 30.0, 40.0_f64] {
        // The variance is that of a baseline; an antenna has half of it.
        let pass_rms = sigma_deg / 2.0_f64.sqrt();
        let mut config =
            InstrumentConfig { outlier_probability: 1.0, outlier_sigma: 1.0, ..Default::default() };
        config.phase_deg.pass_rms = pass_rms;
        let law = (-sigma_deg.to_radians().powi(2)).exp();
        for kept_power in kept_power(&errors(config), PASSES) {
            assert!((kept_power / law - 1.0).abs() < 0.01, "{sigma_deg} deg: {kept_power} for {law}");
        }
    }
}

#[test]
fn constant_phases_and_clocks_keep_the_analytic_power() {
    // The averages are over realisations: 12 deg of a baseline, and 1.1 ns, which is 11.9 deg at 30 MHz.
    let sum = |change: &dyn Fn(&mut InstrumentConfig)| {
        let (mut kept_power, mut count) = ([Complex64::ZERO; 3], 0.0);
        for realisation in 0..PASSES as u32 {
            let mut config = InstrumentConfig { realisation, ..Default::default() };
            change(&mut config);
            let pass = errors(config).pass(window(3));
            for pair in all_pairs(8) {
                for (channel, kept_power) in kept_power.iter_mut().enumerate() {
                    let [i, j] = [pair.i, pair.j].map(|n| pass.gain(n.into(), channel, 3e4));
                    *kept_power += i * j.conj();
                }
                count += 1.0;
            }
        }
        kept_power.map(|sum| (sum / count).norm_sqr())
    };
    let half = 0.5_f64.sqrt();
    for kept_power in sum(&|config| config.phase_deg.constant_rms = 12.0 * half) {
        assert!((kept_power / (-12.0_f64.to_radians().powi(2)).exp() - 1.0).abs() < 0.01, "{kept_power}");
    }
    let of_clock = sum(&|config| config.clock_ns.constant_rms = 1.1 * half);
    for (kept_power, channel) in of_clock.into_iter().zip(CHANNELS) {
        let sigma = TAU * channel.frequency_hz * 1.1e-9;
        assert!(
            (kept_power / (-sigma * sigma).exp() - 1.0).abs() < 0.01,
            "{}: {kept_power}",
            channel.frequency_hz
        );
    }
    // The published tolerance keeps 95 % at 1.1 ns up to 30 MHz.
    assert!(of_clock[2] > 0.95 && of_clock[2] < 0.965, "{of_clock:?}");
}

#[test]
fn position_errors_keep_the_analytic_power() {
    // The error is 1 m of a baseline along each axis: 12 deg at 10 MHz in any direction.
    let mut config = NavigationConfig::default();
    for terms in [&mut config.along_m, &mut config.across_m, &mut config.radial_m] {
        terms.pass_rms = 0.5_f64.sqrt();
    }
    let errors = with_navigation_errors(&config);
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
        let (kept_power, law) = ((sum / count).norm_sqr(), (-sigma * sigma).exp());
        assert!((kept_power / law - 1.0).abs() < 0.01, "{}: {kept_power} for {law}", channel.frequency_hz);
    }
}

#[test]
fn reported_positions_are_off_along_the_configured_axes() {
    let array = Array::new(&ArrayConfig::default()).unwrap();
    let mut config = NavigationConfig::default();
    config.along_m.constant = (0..8).map(f64::from).collect();
    config.radial_m.constant = vec![2.0; 8];
    config.across_m.constant = vec![-3.0; 8];
    let window = window(5);
    let pass = with_navigation_errors(&config).pass(window);
    for flown in crate::array::segments_for(&array, window.start, window.end, 60.0) {
        let mut said = flown.clone();
        pass.add_errors(&mut said, &array);
        for (k, (said, flown_m)) in said.positions_m.iter().zip(&flown.positions_m).enumerate() {
            let (node, n) = (k / 8, k % 8);
            let t_s = flown.start.plus_ticks(node as i64 * i64::from(flown.step_ticks)).seconds();
            let off = sub(*said, *flown_m);
            // The velocity is along the track, except for breathing, some 1e-4 of it.
            let along = unit(array.state(n, t_s).velocity_m_s);
            assert!((dot(off, along) - n as f64).abs() < 2e-3, "{off:?}");
            assert!((dot(off, unit(*flown_m)) - 2.0).abs() < 1e-6);
            assert!((dot(off, array.normal_hat(n, t_s)) + 3.0).abs() < 1e-6);
        }
    }
}

#[test]
fn dipoles_are_tilted_by_the_configured_angles() {
    let array = std::sync::Arc::new(Array::new(&ArrayConfig::default()).unwrap());
    let mut config = InstrumentConfig::default();
    config.tilt_along_deg.constant = (0..8).map(|n| 2.0 * f64::from(n)).collect();
    config.tilt_radial_deg.pass_rms = 5.0;
    config.pattern.constant = (0..8).map(|n| 0.01 * f64::from(n)).collect();
    let errors = errors(config);
    let windows = [window(0), window(1), window(4)];
    let elements = AntennaResponse::DipoleNormal;
    let nothing = || (MeasuredAntennas::default(), 0.0);
    let antennas = AntennaErrors::new(&errors, std::sync::Arc::clone(&array), &windows, elements, nothing());
    let antennas = antennas.unwrap().at(1e7);
    for window in windows {
        let (t_s, pass) = (window.start.seconds() + 1000.0, errors.pass(window));
        for n in 0..8_u8 {
            let found = crate::response::model::AntennaPatterns::antenna(&antennas, n, t_s);
            let [along_deg, radial_deg, distortion] = pass.antenna(n.into(), t_s);
            assert!(along_deg == 2.0 * f64::from(n) && distortion == 0.01 * f64::from(n));
            assert!(found.elements == AntennaResponse::DipoleNormal);
            // Along the axis P_2 is 1.
            let along = found.forms.map_or(1.0, |forms| forms[0].value(found.axes[0]));
            assert!((along - 1.0 - distortion).abs() < 1e-14);
            // Seen along the radius the axis is off by one angle, seen along the track by the other.
            let (up, normal) = (unit(array.position_m(n.into(), t_s)), array.normal_hat(n.into(), t_s));
            let track = unit(array.state(n.into(), t_s).velocity_m_s);
            let seen_deg = |axis| dot(found.axes[0], axis).atan2(dot(found.axes[0], normal)).to_degrees();
            // The velocity is along the track but for precession and breathing, some 1e-4 of it.
            assert!((seen_deg(track) - along_deg).abs() < 0.02, "{n}: {}", seen_deg(track));
            assert!((seen_deg(up) - radial_deg).abs() < 1e-6, "{n}: {}", seen_deg(up));
        }
    }
    assert!(errors.pass(window(0)).antenna(3, 0.0)[1] != errors.pass(window(1)).antenna(3, 0.0)[1]);
    let straight = self::errors(InstrumentConfig { leak_k_sr: 1.0, ..Default::default() });
    assert!(AntennaErrors::new(&straight, array, &windows, elements, nothing()).is_none());
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
        assert_eq!(earth_deg < disc_deg, array.earth_depth_for_m(2, t_s) > 0.0);
        (hidden, seen) = if earth_deg < disc_deg { (hidden + 1, seen) } else { (hidden, seen + 1) };
    }
    assert!(hidden > 100 && seen > 100);
}

#[test]
fn all_invalid_values_of_the_section_are_reported() {
    let text = "dead_daughters = [9]\ndead_channels = [[1, 4]]\noutlier_probability = 2.0\nburst_every_s = 1.0\nburst_s = 2.0\n\
        phase_deg = { constant = [1.0], pass_rms = -1.0, drift_time_s = 1.0 }\n\
        tilt_along_deg = { constant_rms = 60.0 }\npattern = { step_rms = 1.0 }\nclock_allan_deviation = 1.0\n\
        clock_steering_s = 1.0\nleak_depth_deg = 0.0\nleak_k_sr = -1.0\n\
        beacon = { k_sr = -1.0, direction_deg = [0.0, 91.0] }\n\
        antenna_files = { table_error_max = 1.0 }";
    let config: InstrumentConfig = toml::from_str(text).unwrap();
    let keys: Vec<String> = config.problems(8, 3, false).into_iter().map(|problem| problem.key).collect();
    let expected = [
        "phase_deg.constant",
        "phase_deg.pass_rms",
        "phase_deg.drift_time_s",
        "tilt_along_deg.constant_rms",
        "pattern.step_rms",
        "antenna_files.table_error_max",
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
    let twice = "dead_daughters = [5, 5]\ndead_channels = [[5, 1], [5, 2], [5, 1]]";
    let twice: InstrumentConfig = toml::from_str(twice).unwrap();
    let told: Vec<String> = twice.problems(8, 3, false).iter().map(ToString::to_string).collect();
    assert_eq!(told.len(), 2, "{told:?}");
    assert!(
        told[0].starts_with("instrument.dead_daughters[1] = 5: expected every daughter once"),
        "{told:?}"
    );
    assert!(told[1].starts_with("instrument.dead_channels[2] = [5, 1]: "), "{told:?}");
    let dead: InstrumentConfig = toml::from_str("dead_daughters = [1]").unwrap();
    assert!(dead.problems(8, 3, false).is_empty() && dead.problems(8, 3, true).len() == 1);
}

#[test]
fn orbital_terms_are_sines_of_the_given_rms() {
    let array = Array::new(&ArrayConfig::default()).unwrap();
    let mut config = NavigationConfig::default();
    config.radial_m.orbit_rms = 3.0;
    let window = window(5);
    let rad_per_s = TAU / array.orbital_period_s();
    let (mut squares, mut count) = (0.0, 0.0);
    for realisation in 0..500 {
        let instrument = InstrumentConfig { realisation, ..InstrumentConfig::default() };
        let pass = errors_of(&instrument, &config).pass(window);
        for segment in crate::array::segments_for(&array, window.start, window.end, 60.0) {
            let mut said = segment.clone();
            pass.add_errors(&mut said, &array);
            let radial_m = |node: usize| {
                let flown_m = segment.positions_m[node * 8 + 2];
                dot(sub(said.positions_m[node * 8 + 2], flown_m), unit(flown_m))
            };
            let t_s =
                |node: usize| segment.start.plus_ticks(node as i64 * i64::from(segment.step_ticks)).seconds();
            // Two nodes determine cosine and sine; all others follow.
            let [(s0, c0), (s1, c1)] = [0, 20].map(|node| (rad_per_s * t_s(node)).sin_cos());
            let (e0, e1) = (radial_m(0), radial_m(20));
            let det = c0 * s1 - c1 * s0;
            let (cosine, sine) = ((e0 * s1 - e1 * s0) / det, (c0 * e1 - c1 * e0) / det);
            for node in 0..segment.nodes() {
                let (s, c) = (rad_per_s * t_s(node)).sin_cos();
                // Positions of 2e6 m are rounded to 2e-10 m in f64; the two nodes are 50 deg apart.
                assert!((radial_m(node) - cosine * c - sine * s).abs() < 1e-7, "{node}");
            }
            (squares, count) = (squares + cosine * cosine + sine * sine, count + 2.0);
        }
    }
    // Four standard deviations of the mean square of 1000 Gaussians: 4 sqrt(2 / 1000) = 18 %.
    assert!((squares / count / 9.0 - 1.0).abs() < 0.18, "{}", squares / count);
}

#[test]
fn time_tags_are_off_by_a_constant_and_a_drift() {
    let mut config = NavigationConfig::default();
    config.time_tag_ms.constant = vec![250.0];
    config.time_tag_ms.rate_per_day = vec![-864.0]; // 10 us/s
    let pass = with_navigation_errors(&config).pass(window(3));
    let start = window(3).start;
    let count = 2000_u32;
    let true_block = VisibilityBlock {
        start,
        offset_ticks: (0..count).map(|k| k * 1_300_000).collect(),
        duration_ticks: vec![1_300_000; count as usize],
        value_k_sr: vec![num_complex::Complex32::ZERO; count as usize],
        weight: vec![1.0; count as usize],
        flags: vec![crate::frames::Flags::GOOD; count as usize],
        ..VisibilityBlock::default()
    };
    let mut said = true_block.clone();
    pass.tag(&mut said);
    for k in 0..count as usize {
        let t_s = true_block.middle_s(k);
        let late_s = 0.25 - 1e-5 * t_s;
        // The tolerance is half a tick each for the start, the offset and the rate's whole ticks.
        assert!((said.middle_s(k) - t_s - late_s).abs() < 2e-6, "{k}");
    }
    assert_eq!((said.duration_ticks, said.value_k_sr), (true_block.duration_ticks, true_block.value_k_sr));
}

#[test]
fn a_clock_that_is_set_back_keeps_the_order_of_tags() {
    let mut config = NavigationConfig::default();
    config.time_tag_ms.step_rms = 3000.0;
    config.time_tag_ms.step_every_s = 100.0;
    let pass = with_navigation_errors(&config).pass(window(3));
    let count = 5000_u32;
    let true_block = VisibilityBlock {
        start: window(3).start,
        offset_ticks: (0..count).map(|k| k * 500_000).collect(),
        duration_ticks: vec![500_000; count as usize],
        value_k_sr: vec![num_complex::Complex32::ZERO; count as usize],
        weight: vec![1.0; count as usize],
        flags: vec![crate::frames::Flags::GOOD; count as usize],
        ..VisibilityBlock::default()
    };
    let mut said = true_block.clone();
    pass.tag(&mut said);
    let late_s = |k: usize| said.middle_s(k) - true_block.middle_s(k);
    let stood = (1..count as usize).filter(|&k| said.middle_s(k) - said.middle_s(k - 1) < 1e-5).count();
    let off =
        (0..count as usize).filter(|&k| (late_s(k) - pass.time_tag_s(true_block.middle_s(k))).abs() > 2e-6);
    assert!((1..count as usize).all(|k| said.middle_s(k) > said.middle_s(k - 1)));
    // About twelve of 25 jumps are backwards, by seconds, which is a few integrations each.
    assert!(stood > 10 && off.count() < 400, "{stood}");
    assert!((0..count as usize).any(|k| late_s(k) > 1.0) && (0..count as usize).any(|k| late_s(k) < -1.0));
}

#[test]
fn all_invalid_values_of_navigation_are_reported() {
    let text = "along_m = { drift_rms = 1.0 }\nacross_m = { constant = [1.0, 2.0] }\nradial_m = { step_rms = 1.0 }\n\
        time_tag_ms = { constant = [2e4], rate_per_day = [1.0, 1.0], drift_rms = 5.0 }";
    let config: NavigationConfig = toml::from_str(text).unwrap();
    let keys: Vec<String> = config.problems(8).into_iter().map(|problem| problem.key).collect();
    let expected = [
        "along_m.drift_rms",
        "across_m.constant",
        "radial_m.step_rms",
        "time_tag_ms.rate_per_day",
        "time_tag_ms",
    ];
    assert_eq!(keys, expected.map(|key| format!("navigation.{key}")));
}
