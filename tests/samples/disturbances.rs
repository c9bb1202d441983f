//! Instrumental errors and tones of the daughters, compared with closed forms.

use std::f64::consts::TAU;

use lunarray::array::ArrayConfig;
use lunarray::calibration::{
    AntennaGains, Calibration, ChannelGains, GainSolution, GainsFile, Interpolation,
};
use lunarray::daughters::{DaughtersConfig, ErrorTerms, Tones};
use lunarray::frames::{AntennaResponse, PlacedVisibilities, VisibilityBlock};
use lunarray::mother::correlator::Division;
use lunarray::units::constants::{DAY_S, SPEED_OF_LIGHT_M_S};
use lunarray::units::vector::{dot, sub};
use lunarray::units::{ChannelId, all_pairs};
use num_complex::Complex64;

use crate::craft::{Spacecraft, WIDTH_HZ, constant, stream};
use crate::delays::expected;

/// Time, value and weight of all visibilities of one pair and channel.
fn measured(
    blocks: &[VisibilityBlock],
    pair: lunarray::units::Pair,
    channel: u16,
) -> Vec<(f64, Complex64, f64)> {
    let mut all = Vec::new();
    for block in blocks.iter().filter(|b| b.pair == pair && b.channel == ChannelId(channel)) {
        for k in 0..block.len() {
            let value = block.value_k_sr[k];
            let value = Complex64::new(value.re.into(), value.im.into());
            all.push((block.middle_s(k), value, f64::from(block.weight[k])));
        }
    }
    all
}

/// Weighted mean of value over expectation, and its standard error in each part.
fn ratio(all: &[(f64, Complex64, f64)], expected: impl Fn(f64) -> Complex64) -> (Complex64, f64) {
    let (mut product, mut power) = (Complex64::ZERO, 0.0);
    for &(t_s, value, weight) in all {
        let expected = expected(t_s);
        product += value * expected.conj() * weight;
        power += expected.norm_sqr() * weight;
    }
    (product / power, power.sqrt().recip())
}

/// The daughters' noise is partly common: with a correlation r = 0.5 each part of a product has at most `1 + r^2` times
/// the noise of its weight, and both parts count.
const COMMON: f64 = 1.6;

/// An error that is a constant and a rate a day, by daughter.
fn terms(constant: impl IntoIterator<Item = f64>, rate_per_day: impl IntoIterator<Item = f64>) -> ErrorTerms {
    let (constant, rate_per_day) = (constant.into_iter().collect(), rate_per_day.into_iter().collect());
    ErrorTerms { constant, rate_per_day, ..ErrorTerms::default() }
}

#[test]
fn gains_and_phases_scale_visibilities_and_calibration_corrects_them() {
    let mut craft = Spacecraft::new(ArrayConfig::default(), vec![1e6], constant(0.5), 16.0);
    let start_s = craft.window.start.seconds();
    // Drifts since the epoch: phases change by a radian and gains by a quarter over the window.
    let drift = |n: usize| [0.25, 1.0].map(|most| most * (n as f64 - 3.5) / 3.5 / 16.0);
    let amplitude = |n: usize| 0.1 * (n as f64 - 4.0) - drift(n)[0] * start_s;
    let phase = |n: usize| 0.8 * n as f64 - drift(n)[1] * start_s;
    craft.instrument.amplitude = terms((0..8).map(amplitude), (0..8).map(|n| DAY_S * drift(n)[0]));
    craft.instrument.phase_deg =
        terms((0..8).map(|n| phase(n).to_degrees()), (0..8).map(|n| DAY_S * drift(n)[1].to_degrees()));
    craft.rule.duration_s_max = 0.5;
    let blocks = craft.run(21);
    let gain = |n: u8, t_s: f64| {
        let [grown, turned] = drift(usize::from(n)).map(|rate| rate * (t_s - start_s));
        let n = f64::from(n);
        Complex64::from_polar((0.1 * (n - 4.0) + grown).exp(), 0.8 * n + turned)
    };
    let solution = |t_s: f64| GainSolution {
        time_s: t_s,
        gains: (0..8).map(|n| gain(n, t_s)).map(|g| [g.re, g.im]).collect(),
        errors: None,
    };
    let solutions = (0..=64).map(|k| solution(start_s + 0.25 * f64::from(k))).collect();
    let mut calibration = AntennaGains::new(&GainsFile {
        interpolation: Interpolation::LogLinear,
        frequency_tolerance_hz: 1.0,
        channels: vec![ChannelGains { frequency_hz: 1e6, solutions }],
        positions: Vec::new(),
    })
    .unwrap();
    let (mut squares, mut count) = (0.0, 0.0);
    for pair in all_pairs(8) {
        let found = measured(&blocks, pair, 0);
        let (scaled, error) = ratio(&found, |t_s| 0.5 * gain(pair.i, t_s) * gain(pair.j, t_s).conj());
        assert!((scaled - 1.0).norm() < 4.0 * COMMON * error + 1e-3, "{pair}: {scaled} +- {error}");
        let mut placed = PlacedVisibilities {
            frequency_hz: 1e6,
            pair,
            time_s: found.iter().map(|f| f.0).collect(),
            r_i_m: vec![[0.0; 3]; found.len()],
            r_j_m: vec![[0.0; 3]; found.len()],
            value_k_sr: found.iter().map(|f| f.1).collect(),
            weight: found.iter().map(|f| f.2).collect(),
            ..PlacedVisibilities::default()
        };
        assert_eq!(calibration.apply(&mut placed).unwrap().kept, found.len());
        let restored: Vec<_> =
            (0..found.len()).map(|k| (placed.time_s[k], placed.value_k_sr[k], placed.weight[k])).collect();
        let (mean, error) = ratio(&restored, |_| Complex64::new(0.5, 0.0));
        assert!((mean - 1.0).norm() < 4.0 * COMMON * error + 1e-3, "{pair}: {mean} +- {error}");
        // Calibrated weights are those of unit noise power, whatever the gains.
        for (_, value, weight) in restored {
            squares += (value - 0.5).norm_sqr() * weight;
            count += 2.0;
        }
    }
    // (1 - r^2) + (1 + r^2) over two parts: the mean is one. The powers in the weights are averaged over ten seconds and lag
    // behind drifting gains: 10 %.
    let mean = squares / count;
    assert!((mean - 1.0).abs() < 0.15, "{mean}");
}

#[test]
fn errors_of_the_instrument_turn_samples_as_they_turn_visibilities() {
    let frequencies_hz = vec![1e6, 7e6];
    let mut craft = Spacecraft::new(ArrayConfig::default(), frequencies_hz.clone(), constant(0.5), 16.0);
    let given = |of: fn(f64) -> f64| (0..8).map(|n| of(f64::from(n))).collect::<Vec<f64>>();
    craft.instrument.amplitude.constant = given(|n| 0.1 * (n - 3.5));
    // Phases that turn by up to 48 deg over the window.
    craft.instrument.phase_deg.constant = given(|n| 50.0 * n);
    craft.instrument.phase_deg.rate_per_day = given(|n| 86_400.0 * (n - 3.5) * 6.0 / 7.0);
    craft.instrument.clock_ns.constant = given(|n| 40.0 * (n - 2.0));
    craft.rule.duration_s_max = 0.25;
    let blocks = craft.run(23);
    for (channel, hz) in frequencies_hz.iter().enumerate() {
        for pair in all_pairs(8) {
            // V' = g_i conj(g_j) V with g = exp(a + i p), p = phase - 2 pi nu tau.
            let gain = |n: u8, t_s: f64| {
                let k = f64::from(n);
                let phase_deg = 50.0 * k + (k - 3.5) * 6.0 / 7.0 * t_s;
                let clock_turns = hz * 40e-9 * (k - 2.0);
                Complex64::from_polar((0.1 * (k - 3.5)).exp(), phase_deg.to_radians() - TAU * clock_turns)
            };
            let wanted = |t_s: f64| 0.5 * gain(pair.i, t_s) * gain(pair.j, t_s).conj();
            let found = measured(&blocks, pair, channel as u16);
            assert!(found.len() >= 60, "{}", found.len());
            let (scaled, error) = ratio(&found, wanted);
            // 3e-3: synthesis; phases turn by 1.5 deg in an integration, whose mean loses 1e-4.
            assert!(
                (scaled - 1.0).norm() < 4.0 * COMMON * error + 3e-3,
                "{pair} {channel}: {scaled} +- {error}"
            );
        }
    }
}

#[test]
fn tilted_dipoles_act_on_samples_as_on_visibilities() {
    // One source that all see; powers and products of the samples are those of the projections of the dipoles.
    let nside = 1;
    let array = lunarray::array::Array::new(&ArrayConfig::default()).unwrap();
    let start_s = lunarray::array::ObservingWindows::new(&array, 0.0, 1e9).next().unwrap().start.seconds();
    let up = array.position_m(0, start_s);
    let directions = lunarray::sky::healpix::pixel_directions(nside);
    let height = |k: &usize| dot(directions[*k], up);
    let place = (0..12).max_by(|a, b| height(a).total_cmp(&height(b))).unwrap();
    let mut values = vec![0.0; 12];
    values[place] = 12.0 / (4.0 * std::f64::consts::PI); // 1 K sr
    let map = lunarray::sky::SkyMap::new(lunarray::sky::Frame::Ecliptic, values).unwrap();
    let n_hat = directions[place];
    let mut errors = lunarray::daughters::InstrumentConfig::default();
    errors.tilt_along_deg.constant = (0..8).map(|n| 5.0 * f64::from(n)).collect();
    errors.pattern.constant = (0..8).map(|n| 0.05 * f64::from(n)).collect();
    let mut craft = Spacecraft::new(ArrayConfig::default(), vec![1e6], constant(0.5), 16.0);
    craft.instrument = errors;
    let drawn = craft.errors(24).unwrap();
    let shared = std::sync::Arc::clone(&craft.array);
    let elements = AntennaResponse::DipoleNormal;
    let antennas: std::sync::Arc<dyn lunarray::response::model::AntennaPatterns> = std::sync::Arc::new(
        lunarray::daughters::AntennaErrors::new(
            &drawn,
            shared,
            &[craft.window],
            elements,
            (Default::default(), 0.0),
        )
        .unwrap()
        .at(1e6),
    );
    let moon_m = craft.array.moon_radius_m();
    craft.sky = Box::new(move |frequency_hz| {
        let response = AntennaResponse::DipoleNormal;
        let sum = lunarray::response::model::DirectSum::new(&map, frequency_hz, moon_m, response);
        Box::new(lunarray::response::model::AntennaSum::new(sum, std::sync::Arc::clone(&antennas)))
    });
    // Noise far above the source, so that products of samples scatter by their weights.
    craft.receiver_noise_k_sr = 1.0;
    craft.rule.duration_s_max = 0.5;
    let blocks = craft.run(24);
    for pair in all_pairs(8) {
        let voltage = |n: u8, t_s: f64| {
            let (r_m, k) = (array.position_m(n.into(), t_s), f64::from(n));
            let (normal, up) = (array.orbit_normal_hat(t_s), lunarray::units::vector::unit(r_m));
            let track = lunarray::units::vector::cross(normal, up);
            let angle = (5.0 * k).to_radians();
            let axis: [f64; 3] = std::array::from_fn(|m| angle.cos() * normal[m] + angle.sin() * track[m]);
            let factor = 1.0 + 0.05 * k * (1.5 * dot(axis, n_hat).powi(2) - 0.5);
            // The part across the direction of the wave.
            let along = dot(axis, n_hat);
            (0..3).map(|m| factor * (axis[m] - along * n_hat[m])).collect::<Vec<f64>>()
        };
        let wanted = |t_s: f64| {
            let (a, b) = (voltage(pair.i, t_s), voltage(pair.j, t_s));
            let [r_i, r_j] = [pair.i, pair.j].map(|n| array.position_m(n.into(), t_s));
            let response: f64 = a.iter().zip(&b).map(|(a, b)| a * b).sum();
            response * crate::craft::fringe(n_hat, 1e6, r_i, r_j)
        };
        let (found, error) = ratio(&measured(&blocks, pair, 0), wanted);
        // 8e-3: synthesis. Fringes turn by up to an eighth of a wavelength in an integration, which the longest baselines reach: sinc(pi / 8).
        let turned = std::f64::consts::FRAC_PI_8;
        let most = 8e-3 + 1.0 - turned.sin() / turned;
        assert!((found - 1.0).norm() < 4.0 * COMMON * error + most, "{pair}: {found} +- {error}");
    }
}

#[test]
fn late_clocks_shift_each_frequency_by_its_own_phase() {
    let (frequency_hz, bands) = (1e6, 8);
    let mut craft = Spacecraft::new(ArrayConfig::default(), vec![frequency_hz], constant(0.5), 16.0);
    let start_s = craft.window.start.seconds();
    // Offsets up to 60 us, 0.48 samples; drifts of half a turn at 1 MHz over the window.
    let late_us = [0.0, 5.0, -20.0, 60.0, 1.3, -60.0, 33.0, 0.1];
    let drift = [0.0, 3e-8, -3e-8, 0.0, 1e-8, 0.0, 2e-8, 0.0];
    craft.instrument.clock_ns = terms(
        (0..8).map(|n| 1e9 * (late_us[n] * 1e-6 - drift[n] * start_s)),
        (0..8).map(|n| 1e9 * DAY_S * drift[n]),
    );
    craft.rule.duration_s_max = 0.25;
    craft.division = Division { sub_bands: bands, delay_centre: None };
    let blocks = craft.run(22);
    for pair in all_pairs(8) {
        let late_s = |t_s: f64| {
            let of = |n: usize| late_us[n] * 1e-6 + drift[n] * (t_s - start_s);
            of(pair.i.into()) - of(pair.j.into())
        };
        for k in 0..bands {
            // A late clock has the effect of a longer path.
            let wanted = |t_s: f64| 0.5 * expected(late_s(t_s) * WIDTH_HZ, 0, [k, bands], frequency_hz);
            let (found, error) = ratio(&measured(&blocks, pair, k as u16), wanted);
            // 2e-3: a frequency's phase turns by 0.05 in an integration of 0.25 s; 3e-3 of one: synthesis.
            assert!((found - 1.0).norm() < 4.0 * COMMON * error + 8e-3, "{pair} {k}: {found} +- {error}");
        }
    }
}

#[test]
fn a_calibration_tone_keeps_its_amplitude_and_phase() {
    let mut craft = Spacecraft::new(ArrayConfig::default(), vec![2e6], constant(0.0), 8.0);
    craft.rule.duration_s_max = 0.5;
    let (power, offset_hz, phase_rad) = (0.3, 1.3e3, 2.1);
    craft.daughters.tones = Tones {
        calibration_k_sr: power,
        calibration_offset_hz: offset_hz,
        calibration_phase_rad: phase_rad,
        ..Tones::default()
    };
    craft.instrument.phase_deg = terms((0..8).map(|n| (0.5 * f64::from(n)).to_degrees()), []);
    craft.instrument.clock_ns = terms((0..8).map(|n| 1e4 * f64::from(n)), []);
    let frames = craft.sample(23).0;
    // Response of daughter n to the tone: its phase, and its clock at the tone's frequency.
    let turned = |n: f64| 0.5 * n - TAU * (2e6 + offset_hz) * 1e-5 * n;
    for n in 0..8_u8 {
        let samples = stream(&frames, n);
        let count = samples.len() as f64;
        let turn = |k: usize| Complex64::cis(TAU * (offset_hz / WIDTH_HZ * k as f64).fract());
        let mean = samples.iter().enumerate().map(|(k, x)| x * turn(k)).sum::<Complex64>() / count;
        let expected = Complex64::from_polar(power.sqrt(), phase_rad + turned(f64::from(n)));
        // Unit noise power.
        assert!((mean - expected).norm() < 4.0 / count.sqrt(), "{n}: {mean} {expected}");
    }
    let blocks = craft.correlate(frames).0;
    for pair in all_pairs(8) {
        let expected = Complex64::from_polar(power, turned(pair.i.into()) - turned(pair.j.into()));
        let (found, error) = ratio(&measured(&blocks, pair, 0), |_| expected);
        // Weights are those of the total power, but the tone is not noise.
        assert!((found - 1.0).norm() < 4.0 * 2.0_f64.sqrt() * error, "{pair}: {found} +- {error}");
    }
}

#[test]
fn interference_from_the_earth_is_at_the_limb_and_at_its_frequency() {
    let mut craft = Spacecraft::new(ArrayConfig::default(), vec![5e6], constant(0.0), 24.0);
    craft.rule.duration_s_max = 0.5;
    let (power, offset_hz, depth_m) = (100.0, -2.1e3, 2e3);
    craft.daughters.tones = Tones {
        interference_k_sr: power,
        interference_offset_hz: offset_hz,
        interference_depth_m: depth_m,
        ..Tones::default()
    };
    let frames = craft.sample(24).0;
    let leak =
        |n: u8, t_s: f64| power * (-craft.array.earth_depth_for_m(n.into(), t_s).max(0.0) / depth_m).exp();
    let start_s = craft.window.start.seconds();
    // It fades for the first daughter; the last one, 100 km behind, still sees the Earth at the end.
    for n in [0, 1, 7] {
        let samples = stream(&frames, n);
        for (k, block) in samples.chunks_exact(4096).enumerate() {
            let seconds = |sample: f64| start_s + (4096.0 * k as f64 + sample) / WIDTH_HZ;
            let expected: f64 =
                (0..64).map(|m| leak(n, seconds(64.0 * f64::from(m) + 32.0))).sum::<f64>() / 64.0;
            let found = block.iter().map(|x| x.norm_sqr()).sum::<f64>() / 4096.0 - 1.0;
            // Unit noise power and its beat with the tone. A block has the power at its first sample: 0.13 s at 1.3 km/s or
            // less, 4 % of a mean.
            let error = ((1.0 + 2.0 * expected) / 4096.0).sqrt();
            assert!((found - expected).abs() < 4.5 * error + 0.06 * expected, "{n} {k}: {found} {expected}");
        }
    }
    assert!(leak(0, start_s + 24.0) < 1e-3 && leak(7, start_s + 24.0) > 99.0);
    // Its frequency: the offset plus the Doppler shift of the daughter's motion.
    let samples = &stream(&frames, 7)[..8192];
    let along_m = |t_s: f64| dot(craft.array.earth_hat(t_s), craft.array.position_m(7, t_s));
    let speed_m_s = along_m(start_s + 1.0) - along_m(start_s);
    let expected_hz = offset_hz + (5e6 + offset_hz) / SPEED_OF_LIGHT_M_S * speed_m_s;
    let amplitude = |frequency_hz: f64| {
        let turned =
            |(k, x): (usize, &Complex64)| x * Complex64::cis(TAU * frequency_hz / WIDTH_HZ * k as f64);
        (samples.iter().enumerate().map(turned).sum::<Complex64>() / 8192.0).norm()
    };
    // The spectral line is 1 Hz wide, and its peak is found within a tenth of that.
    let peak = (-40..=40)
        .map(|k| 0.1 * f64::from(k))
        .max_by(|a, b| amplitude(expected_hz + a).total_cmp(&amplitude(expected_hz + b)));
    assert!(peak.unwrap().abs() < 0.15, "{peak:?}");
    assert!((amplitude(expected_hz) / power.sqrt() - 1.0).abs() < 0.01, "{}", amplitude(expected_hz));
    // It correlates like a source in the Earth's direction while both receive it.
    let blocks = craft.correlate(frames).0;
    for pair in all_pairs(8).into_iter().filter(|pair| pair.i >= 4) {
        let fringe = |t_s: f64| {
            let [i, j] = [pair.i, pair.j].map(|n| craft.array.position_m(n.into(), t_s));
            let turns = (5e6 + offset_hz) / SPEED_OF_LIGHT_M_S * dot(craft.array.earth_hat(t_s), sub(i, j));
            (leak(pair.i, t_s) * leak(pair.j, t_s)).sqrt() * Complex64::cis(-TAU * turns)
        };
        let all = measured(&blocks, pair, 0);
        let early: Vec<_> = all.into_iter().filter(|(t_s, ..)| *t_s < start_s + 8.0).collect();
        let (found, _) = ratio(&early, fringe);
        // A hundred times the noise; a motion of lambda / 8 costs up to 2.6 %, a block's power 4 %.
        assert!((found - 1.0).norm() < 0.06, "{pair}: {found}");
    }
}

#[test]
fn tones_outside_the_channel_are_refused() {
    for (offset_hz, refused) in [(3999.0, false), (-4000.0, false), (4001.0, true), (-9e3, true)] {
        let tones = |calibration_offset_hz, interference_offset_hz| DaughtersConfig {
            tones: Tones { calibration_offset_hz, interference_offset_hz, ..Tones::default() },
            ..DaughtersConfig::default()
        };
        for config in [tones(offset_hz, 0.0), tones(0.0, offset_hz)] {
            assert_eq!(!config.problems(WIDTH_HZ).is_empty(), refused, "{offset_hz}");
        }
    }
}
