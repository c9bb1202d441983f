//! Delays between daughters: decorrelation over a channel's width, and how delays and sub-bands recover it.

use std::f64::consts::{PI, TAU};

use lunarray::array::{Array, ArrayConfig, BreathingConfig, ObservingWindows};
use lunarray::frames::{SampleBlock, Samples, VisibilityBlock};
use lunarray::mother::correlator::Division;
use lunarray::units::constants::SPEED_OF_LIGHT_M_S;
use lunarray::units::vector::{Vec3, dot, sub, unit};
use lunarray::units::{ChannelId, Pair, all_pairs};
use num_complex::Complex64;

use crate::craft::{Spacecraft, WIDTH_HZ, block_by_block, constant, point, stream};

/// An array that hardly moves and does not breathe, at its largest extent.
fn still() -> ArrayConfig {
    let breathing = BreathingConfig { period_s: 1e12, ..BreathingConfig::default() };
    ArrayConfig { orbital_period_s: 8e8, breathing, ..ArrayConfig::default() }
}

/// Direction from the last daughter to the first when the array first observes, which has the longest delays.
fn along_track(config: &ArrayConfig) -> Vec3 {
    let array = Array::new(config).unwrap();
    let t_s = ObservingWindows::new(&array, 0.0, 1e9).next().unwrap().start.seconds();
    unit(sub(array.position_m(0, t_s), array.position_m(7, t_s)))
}

fn sinc(x: f64) -> f64 {
    if x.abs() < 1e-9 { 1.0 } else { x.sin() / x }
}

/// Delay of daughter j behind i for waves from `n_hat`, in samples.
fn delay_samples(array: &Array, pair: Pair, n_hat: Vec3, t_s: f64) -> f64 {
    let position_m = |n: u8| array.position_m(n.into(), t_s);
    dot(n_hat, sub(position_m(pair.i), position_m(pair.j))) / SPEED_OF_LIGHT_M_S * WIDTH_HZ
}

#[test]
fn delays_decorrelate_as_a_sinc_and_offsets_restore() {
    let n_hat = along_track(&still());
    let craft = Spacecraft::new(still(), vec![1e6], point(n_hat), 40.0);
    let t_s = craft.window.start.seconds() + 20.0;
    let (frames, _) = craft.sample(5);
    let streams: Vec<Vec<Complex64>> = (0..8).map(|n| stream(&frames, n)).collect();
    let mut greatest = 0.0_f64;
    for pair in all_pairs(8) {
        let (i, j) = (usize::from(pair.i), usize::from(pair.j));
        let delay = delay_samples(&craft.array, pair, n_hat, t_s);
        greatest = greatest.max(delay);
        for lag in [0, delay.floor() as usize, delay.round() as usize] {
            // The daughter nearer to the source receives the wave first: x_i(t) = x_j(t + tau).
            let pairs = streams[i].iter().zip(&streams[j][lag..]);
            let count = streams[i].len() - lag;
            let amplitude = (pairs.map(|(a, b)| a * b.conj()).sum::<Complex64>() / count as f64).norm();
            let expected = sinc(PI * (delay - lag as f64)).abs();
            // Noise 1/sqrt(n) of a complex mean; 1 - cos(pi lag / 128) from synthesis.
            let error = (1.0 / count as f64).sqrt();
            assert!(
                (amplitude - expected).abs() < 4.0 * error + 3e-3,
                "{pair} {lag}: {amplitude} {expected}"
            );
        }
    }
    // 333 us of 125 us samples.
    assert!((greatest - 333.5e-6 * WIDTH_HZ).abs() < 1e-2, "{greatest}");
}

/// Number of samples by which the first daughter of a pair is read later than the second, to align waves from `n_hat`.
fn lag(array: &Array, pair: Pair, n_hat: Vec3, t_s: f64) -> i32 {
    -delay_samples(array, pair, n_hat, t_s).round() as i32
}

/// Expected visibility of a point source of unit flux in sub-band `k` of `bands`. Daughters' samples correlate as
/// `<x_i(t + l) conj x_j(t)> = exp(-2 pi i nu tau) sinc(pi (W tau + l))`; a frame of N samples has N - |l| products
/// at lag l; and samples of daughter i read `lag` later than those of j have advanced by that many turns of the sub-band's
/// frequency, which the correlator removes.
pub fn expected(delay: f64, lag: i32, [k, bands]: [usize; 2], frequency_hz: f64) -> Complex64 {
    let turns = (k as f64 + 0.5) / bands as f64 - 0.5;
    let carrier = Complex64::cis(-TAU * (frequency_hz / WIDTH_HZ * delay).fract());
    let count = bands as i32;
    let frame = (1 - count..count).map(|l| {
        let kept = f64::from(count - l.abs()) / f64::from(count);
        kept * sinc(PI * (delay + f64::from(l + lag))) * Complex64::cis(TAU * turns * f64::from(l + lag))
    });
    carrier * frame.sum::<Complex64>()
}

/// Weighted mean over time of measured over expected visibilities, with its error from the weights.
fn ratio(
    blocks: &[VisibilityBlock],
    (channel, pair): (usize, Pair),
    expected: impl Fn(f64) -> Complex64,
) -> (Complex64, f64) {
    let (mut product, mut power) = (Complex64::ZERO, 0.0);
    for block in blocks.iter().filter(|b| b.pair == pair && usize::from(b.channel.0) == channel) {
        for k in 0..block.len() {
            let (expected, weight) = (expected(block.middle_s(k)), f64::from(block.weight[k]));
            let found = Complex64::new(block.value_k_sr[k].re.into(), block.value_k_sr[k].im.into());
            product += found * expected.conj() * weight;
            power += expected.norm_sqr() * weight;
        }
    }
    (product / power, power.sqrt().recip())
}

#[test]
fn sub_bands_and_delays_keep_the_expected_fraction_on_every_baseline() {
    let n_hat = along_track(&still());
    let frequency_hz = 1e6;
    let mut craft = Spacecraft::new(still(), vec![frequency_hz], point(n_hat), 40.0);
    craft.receiver_noise_k_sr = 0.2;
    let frames = craft.sample(15).0;
    let t_s = craft.window.start.seconds() + 20.0;
    for (bands, centred) in [(1, false), (1, true), (2, true), (8, false), (16, true), (64, false)] {
        craft.division = Division { sub_bands: bands, delay_centre: centred.then_some(n_hat) };
        let blocks = craft.correlate(frames.clone()).0;
        let (mut least, mut greatest_error) = (1.0_f64, 0.0_f64);
        for pair in all_pairs(8) {
            let lag = if centred { lag(&craft.array, pair, n_hat, t_s) } else { 0 };
            let delay = delay_samples(&craft.array, pair, n_hat, t_s);
            let mut amplitudes = 0.0;
            for k in 0..bands {
                let wanted = expected(delay, lag, [k, bands], frequency_hz);
                let (found, error) = ratio(&blocks, (k, pair), |_| wanted);
                greatest_error = greatest_error.max(error * wanted.norm());
                amplitudes += (found * wanted).norm() / bands as f64;
                // 1.5: the source's noise is common to both daughters. 3e-3: synthesis, as documented.
                // 5.5: the worst of 2604 complex numbers exceeds 4 errors almost always, exp(-4^2 / 2) each, and 5.5 errors
                // once in a thousand.
                assert!(
                    (found - 1.0).norm() * wanted.norm() < 5.5 * 1.5 * error * wanted.norm() + 3e-3,
                    "{bands} {centred} {pair} {k}: {found} of {wanted} +- {error}"
                );
            }
            least = least.min(amplitudes);
        }
        eprintln!("{bands} sub-bands, delays {centred}: {least:.3} left, errors to {greatest_error:.4}");
        // Half a sample of rounding, or 2.67 samples without delays, as fractions of a frame; aliasing lowers the outermost
        // sub-bands.
        let floor = match (bands, centred) {
            (1, false) => 0.0,
            (1, true) => 0.63,
            (2, true) => 0.7,
            (8, false) => 0.6,
            (16, true) => 0.93,
            _ => 0.93,
        };
        assert!(least > floor, "{bands} {centred}: {least}");
        // Of a whole channel nothing is left at a delay of two samples, and 0.10 at the longest.
        assert!(bands > 1 || centred || least < 0.12, "{least}");
    }
}

#[test]
fn fringes_of_sub_bands_rotate_at_their_own_frequency() {
    // The fiducial array in motion; a source well off the delay centre.
    let (frequency_hz, bands) = (10e6, 8);
    let (n_hat, centre) = (unit([0.3, -0.8, 0.4]), unit([0.2, -0.9, 0.1]));
    let mut craft = Spacecraft::new(ArrayConfig::default(), vec![frequency_hz], point(n_hat), 16.0);
    craft.receiver_noise_k_sr = 0.2;
    craft.division = Division { sub_bands: bands, delay_centre: Some(centre) };
    let blocks = craft.run(16);
    for pair in all_pairs(8) {
        let lag = lag(&craft.array, pair, centre, craft.window.start.seconds() + 8.0);
        for k in 0..bands {
            let wanted =
                |t_s| expected(delay_samples(&craft.array, pair, n_hat, t_s), lag, [k, bands], frequency_hz);
            let (found, error) = ratio(&blocks, (k, pair), wanted);
            // A motion of lambda / 8 in an integration costs 1 - sinc(pi / 8) = 2.6 % at most.
            assert!((found - 1.0).norm() < 4.0 * 1.5 * error + 0.03, "{pair} {k}: {found} +- {error}");
        }
    }
}

#[test]
fn weights_of_sub_bands_add_up_to_the_frames_that_arrived_whole() {
    let (bands, n_hat) = (4, along_track(&ArrayConfig::default()));
    let mut craft = Spacecraft::new(ArrayConfig::default(), vec![5e6], constant(0.0), 12.288);
    craft.division = Division { sub_bands: bands, delay_centre: Some(n_hat) };
    let mut lost = std::collections::HashSet::new();
    let frames = block_by_block(craft.sample(6).0, |block| {
        if (block.number * 8 + u64::from(block.daughter)) % 37 == 0 {
            lost.insert((block.daughter, block.number));
            return None;
        }
        let length = block.samples.len();
        let samples = Samples::Float { re: vec![1.0; length], im: vec![0.0; length] };
        Some(SampleBlock { samples, ..block })
    });
    let blocks = craft.correlate(frames).0;
    // The first daughter receives the wave first; the others are read later, by samples rounded down or up.
    let later =
        |n: u8| delay_samples(&craft.array, Pair { i: 0, j: n }, n_hat, craft.window.start.seconds() + 6.0);
    assert!(lost.len() > 10 && later(7) > 2.0);
    let whole = |daughter: u8, late: u64, number: u64| {
        let (here, next) = (!lost.contains(&(daughter, number)), !lost.contains(&(daughter, number + 1)));
        // No block follows the last one.
        let samples = 1024 - if next && number < 95 { 0 } else { late };
        if here { samples / bands as u64 } else { 0 }
    };
    for pair in all_pairs(8) {
        let [mut i, mut j] = [pair.i, pair.j].map(|n| later(n) as u64);
        let left = later(pair.i).fract() - later(pair.j).fract();
        i += u64::from(left > 0.5);
        j += u64::from(left < -0.5);
        let both = |number| whole(pair.i, i, number).min(whole(pair.j, j, number));
        let expected: u64 = (0..96).map(both).sum();
        for k in 0..bands {
            let of_band = |b: &&VisibilityBlock| b.pair == pair && b.channel == ChannelId(k as u16);
            let weights = blocks.iter().filter(of_band).flat_map(|block| &block.weight);
            let found: f64 = weights.map(|weight| f64::from(*weight)).sum();
            // Power of a sub-band when all samples are one.
            let turns = PI * ((k as f64 + 0.5) / bands as f64 - 0.5);
            let power = ((bands as f64 * turns).sin() / turns.sin()).powi(2) / bands as f64;
            let ratio = 0.5 * found * power * power / expected as f64;
            // Weights and powers are f32.
            assert!((ratio - 1.0).abs() < 1e-4, "{pair} {k}: {ratio}");
        }
    }
}
