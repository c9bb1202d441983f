use std::f64::consts::TAU;

use proptest::prelude::*;
use rand_distr::{Distribution, StandardNormal};

use super::*;
use crate::calibration::{ChannelGains, GainErrors, GainSolution};
use crate::units::{ChannelId, StreamKind, random_stream};

const FREQUENCY_HZ: f64 = 10e6;

fn file(interpolation: Interpolation, solutions: Vec<(f64, Vec<Complex64>)>) -> GainsFile {
    let solutions = solutions
        .into_iter()
        .map(|(time_s, gains)| GainSolution {
            time_s,
            gains: gains.iter().map(|g| [g.re, g.im]).collect(),
            errors: None,
        })
        .collect();
    GainsFile {
        interpolation,
        frequency_tolerance_hz: 4e3,
        channels: vec![ChannelGains { frequency_hz: FREQUENCY_HZ, solutions }],
        positions: Vec::new(),
    }
}

/// A block of pair 1-3 with a different value in each element of its arrays.
fn block(time_s: Vec<f64>) -> PlacedVisibilities {
    let by_time = |f: fn(f64) -> f64| time_s.iter().map(|&t| f(t)).collect::<Vec<f64>>();
    PlacedVisibilities {
        channel: ChannelId(0),
        band: 0,
        frequency_hz: FREQUENCY_HZ,
        pair: Pair { i: 0, j: 2 },
        r_i_m: time_s.iter().map(|&t| [t, 1.0, 0.0]).collect(),
        r_j_m: time_s.iter().map(|&t| [t, 2.0, 0.0]).collect(),
        value_k_sr: time_s.iter().map(|&t| Complex64::new(1e5 + t, -3e4)).collect(),
        weight: by_time(|t| 1e-4 * (1.0 + t.abs())),
        duration_s: Vec::new(),
        gain_errors: Vec::new(),
        time_s,
    }
}

fn constant_gains(gains: [(f64, f64); 3]) -> AntennaGains {
    let gains = gains.map(|(re, im)| Complex64::new(re, im)).to_vec();
    AntennaGains::new(&file(Interpolation::LogLinear, vec![(0.0, gains)])).unwrap()
}

fn gain() -> impl Strategy<Value = Complex64> {
    (0.01_f64..100.0, 0.0..TAU).prop_map(|(amplitude, phase)| Complex64::from_polar(amplitude, phase))
}

fn solutions() -> impl Strategy<Value = Vec<(f64, Vec<Complex64>)>> {
    let solution = (1.0..1e5_f64, proptest::collection::vec(gain(), 3));
    proptest::collection::vec(solution, 1..6).prop_map(|mut solutions| {
        let mut time_s = -1e5;
        for solution in &mut solutions {
            time_s += solution.0;
            solution.0 = time_s;
        }
        solutions
    })
}

proptest! {
    #[test]
    fn apply_divides_by_the_gains(
        solutions in solutions(),
        nearest in any::<bool>(),
        mut times in proptest::collection::vec(-2e5..5e5_f64, 0..40),
    ) {
        times.sort_by(f64::total_cmp);
        let interpolation = if nearest { Interpolation::Nearest } else { Interpolation::LogLinear };
        let mut gains = AntennaGains::new(&file(interpolation, solutions)).unwrap();
        let truth = block(times);
        let mut measured = truth.clone();
        for k in 0..truth.len() {
            let factor = gains.factor(FREQUENCY_HZ, truth.pair, truth.time_s[k]).unwrap();
            measured.value_k_sr[k] *= factor;
            // Noise of the sky and receiver is multiplied by |factor|, too.
            measured.weight[k] /= factor.norm_sqr();
        }
        let report = gains.apply(&mut measured).unwrap();
        prop_assert_eq!(report, CalibrationReport { kept: truth.len(), unusable_gain: 0 });
        for k in 0..truth.len() {
            // One multiplication and one division of complex numbers: some units in the last place.
            let (found, expected) = (measured.value_k_sr[k], truth.value_k_sr[k]);
            prop_assert!((found - expected).norm() < 1e-14 * expected.norm());
            prop_assert!((measured.weight[k] / truth.weight[k] - 1.0).abs() < 1e-14);
        }
        prop_assert_eq!(measured.time_s, truth.time_s);
        prop_assert_eq!(measured.r_j_m, truth.r_j_m);
    }

    #[test]
    fn a_steady_drift_is_followed_exactly(
        rate in -0.9_f64..0.9,
        decay in -1e-2..1e-2_f64,
        time_s in 0.0..40.0_f64,
    ) {
        // g_3 = exp((decay + i rate) t), given every 3 s: the phase changes by less than pi between.
        let drift = Complex64::new(decay, rate);
        let unity = Complex64::new(1.0, 0.0);
        let times = (0..15).map(|k| 3.0 * f64::from(k));
        let solutions = times.map(|t| (t, vec![unity, unity, (drift * t).exp()]));
        let gains = AntennaGains::new(&file(Interpolation::LogLinear, solutions.collect())).unwrap();
        let found = gains.factor(FREQUENCY_HZ, Pair { i: 0, j: 2 }, time_s).unwrap();
        let expected = (drift * time_s).exp().conj();
        // Phases up to 40 rad keep 15 digits less two.
        prop_assert!((found - expected).norm() < 1e-13 * expected.norm(), "{} {}", found, expected);
    }
}

#[test]
fn the_first_satellite_is_not_conjugated() {
    // E'_1 = i E_1, E'_3 = 2 E_3: V' = 2 i V.
    let mut gains = constant_gains([(0.0, 1.0), (7.0, 0.0), (2.0, 0.0)]);
    let mut block = block(vec![0.0]);
    block.value_k_sr[0] = Complex64::new(0.0, 6.0);
    block.weight[0] = 0.5;
    assert_eq!(gains.apply(&mut block).unwrap().kept, 1);
    assert_eq!(block.value_k_sr[0], Complex64::new(3.0, 0.0));
    assert_eq!(block.weight[0], 2.0);
}

#[test]
fn interpolation_is_right_between_and_beyond_solutions() {
    let at = |re| vec![Complex64::new(1.0, 0.0), Complex64::new(1.0, 0.0), Complex64::new(re, 0.0)];
    let solutions = vec![(0.0, at(2.0)), (10.0, at(4.0)), (20.0, at(8.0))];
    let pair = Pair { i: 0, j: 2 };
    let nearest = AntennaGains::new(&file(Interpolation::Nearest, solutions.clone())).unwrap();
    let smooth = AntennaGains::new(&file(Interpolation::LogLinear, solutions)).unwrap();
    for (time_s, by_nearest, by_smooth) in [
        (-1e9, 2.0, 2.0),
        (0.0, 2.0, 2.0),
        (5.0, 2.0, 8_f64.sqrt()),
        (5.1, 4.0, 2.0 * 2_f64.powf(0.51)),
        (10.0, 4.0, 4.0),
        (19.0, 8.0, 4.0 * 2_f64.powf(0.9)),
        (1e9, 8.0, 8.0),
    ] {
        assert_eq!(nearest.factor(FREQUENCY_HZ, pair, time_s).unwrap().re, by_nearest);
        let found = smooth.factor(FREQUENCY_HZ, pair, time_s).unwrap().re;
        // exp and ln to the last place or two.
        assert!((found / by_smooth - 1.0).abs() < 1e-14, "{found} at {time_s}");
    }
}

#[test]
fn visibilities_with_unusable_gains_are_removed() {
    let good = Complex64::new(1.0, 0.0);
    for bad in [0.0, f64::NAN, f64::INFINITY, 1e-200, 1e200].map(|re| Complex64::new(re, 0.0)) {
        // Unusable at 10 s, and between there and the solutions beside it.
        let solutions = [(0.0, good), (10.0, bad), (20.0, good), (30.0, good)]
            .map(|(time_s, g_3)| (time_s, vec![good, good, g_3]));
        let mut nearest = AntennaGains::new(&file(Interpolation::Nearest, solutions.to_vec())).unwrap();
        let truth = block(vec![0.0, 4.0, 10.0, 14.0, 16.0, 20.0, 25.0]);
        let mut found = truth.clone();
        let report = nearest.apply(&mut found).unwrap();
        assert_eq!(report, CalibrationReport { kept: 5, unusable_gain: 2 });
        assert_eq!(report.removed()[0].1, 2);
        assert_eq!(found.time_s, [0.0, 4.0, 16.0, 20.0, 25.0]);
        for (k, &time_s) in found.time_s.iter().enumerate() {
            let was = truth.time_s.iter().position(|&t| t == time_s).unwrap();
            assert_eq!(found.value_k_sr[k], truth.value_k_sr[was]);
            assert_eq!(found.weight[k], truth.weight[was]);
            assert_eq!((found.r_i_m[k], found.r_j_m[k]), (truth.r_i_m[was], truth.r_j_m[was]));
        }
    }
    for bad in [0.0, f64::NAN, f64::INFINITY].map(|re| Complex64::new(re, 0.0)) {
        let solutions = [(0.0, good), (10.0, bad), (20.0, good), (30.0, good)]
            .map(|(time_s, g_3)| (time_s, vec![good, good, g_3]));
        let mut smooth = AntennaGains::new(&file(Interpolation::LogLinear, solutions.to_vec())).unwrap();
        let mut found = block(vec![-1.0, 0.0, 4.0, 10.0, 14.0, 20.0, 25.0, 31.0]);
        assert_eq!(smooth.apply(&mut found).unwrap().unusable_gain, 3);
        assert_eq!(found.time_s, [-1.0, 0.0, 20.0, 25.0, 31.0]);
    }
}

#[test]
fn weights_are_inverse_variances_after_correction() {
    const COUNT: usize = 40_000;
    const SIGMA_K_SR: f64 = 250.0;
    let mut random = random_stream(7, StreamKind::Probe, [0, 0]);
    let mut normal = || -> f64 { StandardNormal.sample(&mut random) };
    let mut gains = constant_gains([(0.3, -0.8), (1.0, 0.0), (1.7, 0.4)]);
    let mut measured = block((0..COUNT).map(|k| k as f64).collect());
    let truth = Complex64::new(2e5, -7e4);
    for k in 0..COUNT {
        let factor = gains.factor(FREQUENCY_HZ, measured.pair, measured.time_s[k]).unwrap();
        let noise = Complex64::new(normal(), normal()) * SIGMA_K_SR;
        measured.value_k_sr[k] = factor * truth + noise;
        measured.weight[k] = SIGMA_K_SR.powi(-2);
    }
    assert_eq!(gains.apply(&mut measured).unwrap().kept, COUNT);
    let errors: Vec<Complex64> = measured.value_k_sr.iter().map(|value| value - truth).collect();
    let mean_of = |f: &dyn Fn(&Complex64) -> f64| errors.iter().map(f).sum::<f64>() / COUNT as f64;
    let weight = measured.weight[0];
    // The relative error of a variance from n values is sqrt(2 / n), the error of a correlation 1 / sqrt(n), that of
    // a mean sigma / sqrt(n); the limits are five times these.
    let scatter = 5.0 / (COUNT as f64).sqrt();
    assert!((mean_of(&|e| e.re * e.re) * weight - 1.0).abs() < scatter * 2_f64.sqrt());
    assert!((mean_of(&|e| e.im * e.im) * weight - 1.0).abs() < scatter * 2_f64.sqrt());
    assert!((mean_of(&|e| e.re * e.im) * weight).abs() < scatter);
    assert!(mean_of(&|e| e.re).abs() * weight.sqrt() < scatter);
}

#[test]
fn blocks_of_another_array_are_refused() {
    let mut gains = constant_gains([(1.0, 0.0); 3]);
    let mut other_channel = block(vec![0.0]);
    other_channel.frequency_hz += 4_001.0;
    let error = gains.apply(&mut other_channel).unwrap_err();
    assert!(matches!(error, CalibrationError::Channel { nearest_hz: FREQUENCY_HZ, .. }), "{error}");
    other_channel.frequency_hz -= 2.0;
    assert!(gains.apply(&mut other_channel).is_ok());

    let mut other_pair = block(vec![0.0]);
    other_pair.pair = Pair { i: 0, j: 3 };
    let error = gains.apply(&mut other_pair).unwrap_err();
    assert!(error.to_string().contains("1-4") && error.to_string().contains("3 satellites"), "{error}");
}

#[test]
fn invalid_values_are_reported_with_their_file() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("gains.toml");
    std::fs::write(&path, "channels = []").unwrap();
    let error = AntennaGains::read(&path, 0).unwrap_err();
    assert!(matches!(error, CalibrationError::Values { .. }), "{error}");
    let text = error.to_string();
    assert!(text.contains("gains.toml") && text.contains("at least one channel"), "{text}");
}

/// Draws of a channel whose errors are not stated are zero: visibilities carry none.
#[test]
fn only_channels_with_stated_errors_have_draws() {
    let unity = Complex64::new(1.0, 0.0);
    let mut file = file(Interpolation::LogLinear, vec![(0.0, vec![unity; 3])]);
    let sigma = vec![[0.1, 0.1]; 3];
    let errors = GainErrors { solution_s: 0.0, sigma, correlations: Vec::new() };
    let mut other = file.channels[0].clone();
    other.frequency_hz = 2.0 * FREQUENCY_HZ;
    other.solutions[0].errors = Some(errors);
    file.channels.push(other);
    let mut gains = AntennaGains::new(&file).unwrap().with_error_draws(&file, 8, 1);
    for (hz, draws) in [(FREQUENCY_HZ, 0), (2.0 * FREQUENCY_HZ, 8)] {
        let mut block = PlacedVisibilities { frequency_hz: hz, ..block(vec![1.0, 2.0]) };
        assert_eq!(gains.apply(&mut block).unwrap().kept, 2);
        assert_eq!(block.gain_errors.len(), 2 * draws);
    }
}
