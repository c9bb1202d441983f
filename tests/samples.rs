//! Sample by sample: what comes out of daughters and correlator is what the model, the radiometer equation and
//! the literature on quantisers say.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)] // A test fails by panicking.

mod common;

use std::f64::consts::{FRAC_2_PI, PI, TAU};
use std::sync::Arc;

use lunarray::array::{Array, ArrayConfig, IntegrationRule, ObservingWindows};
use lunarray::calibration::VanVleck;
use lunarray::daughters::{DaughtersConfig, Sampler, SamplerCounts, Scene};
use lunarray::frames::{
    AntennaResponse, Channel, Flags, GroundFrame, Instrument, ObservingWindow, SampleBlock, Samples,
    SpaceFrame, VisibilityBlock,
};
use lunarray::mother::correlator::{Correlator, CorrelatorCounts, CorrelatorSetup};
use lunarray::mother::{DirectSum, ModelError, PairPosition, Prediction, Schedule, VisibilityModel};
use lunarray::runtime::{Flow, Outlet, Source, Stage};
use lunarray::sky::SkyMap;
use lunarray::sky::fits::{ReadOptions, read_map};
use lunarray::units::constants::SPEED_OF_LIGHT_M_S;
use lunarray::units::vector::{Vec3, dot, norm, sub, unit};
use lunarray::units::{ChannelId, MissionTime, all_pairs};
use num_complex::Complex64;

const WIDTH_HZ: f64 = 8e3;

/// Any pair but a daughter with itself sees `cross`, and each daughter power one.
struct Constant {
    cross: f64,
}

impl VisibilityModel for Constant {
    fn predict(&mut self, _: &[PairPosition], out: &mut [Prediction]) -> Result<(), ModelError> {
        out.fill(Prediction { visibility_k_sr: Complex64::new(self.cross, 0.0), zero_spacing_k_sr: 1.0 });
        Ok(())
    }
}

/// A source of flux one in one direction that nothing hides.
struct Point {
    n_hat: Vec3,
    frequency_hz: f64,
}

fn fringe(n_hat: Vec3, frequency_hz: f64, r_i_m: Vec3, r_j_m: Vec3) -> Complex64 {
    Complex64::cis(-TAU * frequency_hz / SPEED_OF_LIGHT_M_S * dot(n_hat, sub(r_i_m, r_j_m)))
}

impl VisibilityModel for Point {
    fn predict(&mut self, positions: &[PairPosition], out: &mut [Prediction]) -> Result<(), ModelError> {
        for (out, at) in out.iter_mut().zip(positions) {
            let visibility_k_sr = fringe(self.n_hat, self.frequency_hz, at.r_i_m, at.r_j_m);
            *out = Prediction { visibility_k_sr, zero_spacing_k_sr: 1.0 };
        }
        Ok(())
    }
}

/// The model of a channel at some frequency, Hz.
type Sky = Box<dyn Fn(f64) -> Box<dyn VisibilityModel> + Send + Sync>;

fn constant(cross: f64) -> Sky {
    Box::new(move |_| Box::new(Constant { cross }))
}

fn point(n_hat: Vec3) -> Sky {
    Box::new(move |frequency_hz| Box::new(Point { n_hat, frequency_hz }))
}

/// A spacecraft in sample fidelity, without links.
struct Spacecraft {
    array: Arc<Array>,
    sky: Sky,
    frequencies_hz: Vec<f64>,
    receiver_noise_k_sr: f64,
    rule: IntegrationRule,
    daughters: DaughtersConfig,
    window: ObservingWindow,
}

impl Spacecraft {
    fn new(array: ArrayConfig, frequencies_hz: Vec<f64>, sky: Sky, seconds: f64) -> Self {
        let array = Arc::new(Array::new(&array).unwrap());
        let start = ObservingWindows::new(&array, 0.0, 1e9).next().unwrap().start;
        let end = MissionTime::from_seconds(start.seconds() + seconds);
        Self {
            array,
            sky,
            frequencies_hz,
            receiver_noise_k_sr: 0.0,
            rule: IntegrationRule::default(),
            daughters: DaughtersConfig { bits: 32, ..DaughtersConfig::default() },
            window: ObservingWindow { index: 0, start, end },
        }
    }

    fn channels(&self) -> Vec<Channel> {
        self.frequencies_hz.iter().map(|&frequency_hz| Channel { frequency_hz, width_hz: WIDTH_HZ }).collect()
    }

    /// Everything that the daughters send.
    fn sample(&self, seed: u64) -> (Vec<SpaceFrame>, SamplerCounts) {
        let scene = Scene {
            array: Arc::clone(&self.array),
            models: self.frequencies_hz.iter().map(|&frequency_hz| (self.sky)(frequency_hz)).collect(),
            channels: self.channels(),
            receiver_noise_k_sr: self.receiver_noise_k_sr,
            seed,
        };
        let counts = Arc::default();
        let mut sampler = Sampler::new(scene, self.daughters.clone(), vec![self.window], Arc::clone(&counts));
        let mut out = Outlet::collect();
        while sampler.next(&mut out).unwrap() == Flow::Continue {}
        let counts = *counts.lock().unwrap();
        (out.into_vec(), counts)
    }

    fn correlate(&self, frames: Vec<SpaceFrame>) -> (Vec<VisibilityBlock>, CorrelatorCounts) {
        let schedule = |&frequency_hz: &f64| Schedule {
            rule: self.rule,
            frequency_hz,
            baseline_wavelengths_max: 0.0,
            every_nth: 1,
            every_nth_window: 1,
        };
        let setup = CorrelatorSetup {
            array: Arc::clone(&self.array),
            instrument: Instrument {
                name: String::new(),
                epoch_tai_s: 0.0,
                moon_radius_m: self.array.moon_radius_m(),
                satellites: 8,
                channels: self.channels(),
                response: AntennaResponse::Isotropic,
                seed: 0,
                configuration_hash: 0,
            },
            schedules: self.frequencies_hz.iter().map(schedule).collect(),
            block_samples: self.daughters.block_samples,
            wait_blocks: 4,
        };
        let counts = Arc::default();
        let mut correlator = Correlator::new(setup, Arc::clone(&counts));
        let mut out = Outlet::collect();
        for frame in frames {
            correlator.step(frame, &mut out).unwrap();
        }
        correlator.finish(&mut out).unwrap();
        let visibilities = out.into_vec().into_iter().filter_map(|frame| match frame {
            GroundFrame::Visibilities(block) => Some(block),
            _ => None,
        });
        let counts = counts.lock().unwrap().clone();
        (visibilities.collect(), counts)
    }

    fn run(&self, seed: u64) -> Vec<VisibilityBlock> {
        self.correlate(self.sample(seed).0).0
    }
}

fn frequencies(count: usize) -> Vec<f64> {
    (0..count).map(|k| 1e6 * (k + 1) as f64).collect()
}

/// Values of all visibilities that last exactly `dt_s`.
fn values(blocks: &[VisibilityBlock], dt_s: f64) -> Vec<Complex64> {
    let ticks = (dt_s * 1e6).round() as u32;
    let each = |block: &VisibilityBlock| {
        let wanted = |k: &usize| block.duration_ticks[*k] == ticks;
        let value = |k: usize| Complex64::new(block.value_k_sr[k].re.into(), block.value_k_sr[k].im.into());
        (0..block.len()).filter(wanted).map(value).collect::<Vec<_>>()
    };
    blocks.iter().flat_map(each).collect()
}

/// Mean, and variance about it of the real and imaginary parts together.
fn moments(values: &[Complex64]) -> (Complex64, f64) {
    let n = values.len() as f64;
    let mean = values.iter().sum::<Complex64>() / n;
    (mean, values.iter().map(|v| (v - mean).norm_sqr()).sum::<f64>() / (2.0 * n - 2.0))
}

#[test]
fn noise_is_what_the_radiometer_equation_says_for_any_integration_time() {
    // An empty sky and receivers of 2 K sr.
    let mut craft = Spacecraft::new(ArrayConfig::default(), frequencies(30), constant(0.0), 4.0);
    craft.receiver_noise_k_sr = 1.0;
    let frames = craft.sample(1).0;
    for dt_s in [0.008, 0.08, 0.4] {
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

/// The model's mean over an integration and the channel, by the midpoint rule.
fn smeared(
    array: &Array,
    (i, j): (usize, usize),
    (from_s, dt_s): (f64, f64),
    frequency_hz: f64,
    visibility: impl Fn(f64, Vec3, Vec3) -> Complex64,
) -> Complex64 {
    const TIMES: usize = 16;
    const OFFSETS: usize = 64;
    let mut sum = Complex64::ZERO;
    for k in 0..TIMES {
        let t_s = from_s + dt_s * (k as f64 + 0.5) / TIMES as f64;
        let (r_i_m, r_j_m) = (array.position_m(i, t_s), array.position_m(j, t_s));
        for m in 0..OFFSETS {
            let offset = (m as f64 + 0.5) / OFFSETS as f64 - 0.5;
            sum += visibility(frequency_hz + WIDTH_HZ * offset, r_i_m, r_j_m);
        }
    }
    sum / (TIMES * OFFSETS) as f64
}

#[test]
fn a_point_source_has_the_visibilities_of_the_model() {
    let frequencies_hz = vec![1e6, 10e6, 30e6];
    let n_hat = unit([0.3, -0.8, 0.4]);
    let sky = point(n_hat);
    let mut craft = Spacecraft::new(ArrayConfig::default(), frequencies_hz, sky, 30.0);
    craft.receiver_noise_k_sr = 1.0;
    let blocks = craft.run(3);
    let (mut squares, mut count) = (0.0, 0.0);
    for channel in 0..3 {
        for pair in all_pairs(8) {
            let (mut product, mut power, mut weight) = (Complex64::ZERO, 0.0, 0.0);
            for block in blocks.iter().filter(|b| b.pair == pair && usize::from(b.channel.0) == channel) {
                for k in 0..block.len() {
                    let from_s = block.start.seconds() + f64::from(block.offset_ticks[k]) * 1e-6;
                    let dt_s = f64::from(block.duration_ticks[k]) * 1e-6;
                    let ends = (usize::from(pair.i), usize::from(pair.j));
                    let at = craft.frequencies_hz[channel];
                    let expected =
                        smeared(&craft.array, ends, (from_s, dt_s), at, |frequency_hz, r_i_m, r_j_m| {
                            fringe(n_hat, frequency_hz, r_i_m, r_j_m)
                        });
                    let found = Complex64::new(block.value_k_sr[k].re.into(), block.value_k_sr[k].im.into());
                    let w = f64::from(block.weight[k]);
                    product += found * expected.conj() * w;
                    power += expected.norm_sqr() * w;
                    weight += expected.norm_sqr() * w;
                    squares += (found - expected).norm_sqr() * w;
                    count += 2.0;
                }
            }
            let ratio = product / power;
            // The weights are those of the noise; 2e-3 is what interpolation may leave, as documented.
            let error = (1.0 / weight).sqrt();
            assert!((ratio - 1.0).norm() < 4.0 * 1.5 * error + 2e-3, "{channel} {pair}: {ratio} +- {error}");
        }
    }
    // The source's own noise: half of the power is common to all, so that parts differ; on the mean they have
    // P_i P_j / (2 n), and neighbouring pairs share it: fewer independent ones than counted.
    let mean = squares / count;
    eprintln!("{count} parts, mean square {mean:.4}");
    assert!((mean - 1.0).abs() < 0.02, "{mean}");
}

#[test]
fn the_real_sky_has_the_visibilities_of_the_model() {
    let Some(path) = common::shared("sky/ulsa_1mhz_galactic_nside64.fits") else { return };
    let sky: SkyMap = read_map(&path, &ReadOptions::default()).unwrap();
    let array = Array::new(&ArrayConfig::default()).unwrap();
    let moon_radius_m = array.moon_radius_m();
    let model =
        move |frequency_hz| DirectSum::new(&sky, frequency_hz, moon_radius_m, AntennaResponse::Isotropic);
    let frequency_hz = 1e6;
    let centre = model(frequency_hz);
    let sky: Sky = Box::new(move |_| Box::new(centre.clone()));
    let craft = Spacecraft::new(ArrayConfig::default(), vec![frequency_hz], sky, 16.0);
    let (frames, counts) = craft.sample(4);
    assert!(f64::from(counts.repairs.change_max) < 1e-3, "{:?}", counts.repairs);
    let (blocks, _) = craft.correlate(frames);
    // Frequencies over the channel as channels of their own.
    let offsets: Vec<f64> =
        (0..16).map(|k| frequency_hz + WIDTH_HZ * ((k as f64 + 0.5) / 16.0 - 0.5)).collect();
    let mut positions = Vec::new();
    for block in &blocks {
        for k in 0..block.len() {
            let from_s = block.start.seconds() + f64::from(block.offset_ticks[k]) * 1e-6;
            let dt_s = f64::from(block.duration_ticks[k]) * 1e-6;
            positions.extend((0..4).map(|m| {
                let t_s = from_s + dt_s * (f64::from(m) + 0.5) / 4.0;
                PairPosition {
                    r_i_m: array.position_m(block.pair.i.into(), t_s),
                    r_j_m: array.position_m(block.pair.j.into(), t_s),
                    span_rad: 0.0,
                }
            }));
        }
    }
    let mut expected = vec![Complex64::ZERO; positions.len() / 4];
    let mut predicted = vec![Prediction::default(); positions.len()];
    for frequency_hz in offsets {
        model(frequency_hz).predict(&positions, &mut predicted).unwrap();
        for (sum, four) in expected.iter_mut().zip(predicted.chunks_exact(4)) {
            *sum += four.iter().map(|p| p.visibility_k_sr).sum::<Complex64>() / 64.0;
        }
    }
    let (mut squares, mut count, mut strongest) = (0.0, 0.0, 0.0_f64);
    let mut expected = expected.into_iter();
    for block in &blocks {
        for k in 0..block.len() {
            let expected = expected.next().unwrap();
            let found = Complex64::new(block.value_k_sr[k].re.into(), block.value_k_sr[k].im.into());
            let deviation = f64::from(block.weight[k]).sqrt();
            let sigmas = (found - expected).norm() * deviation;
            // Four standard errors of a complex number: once in 3000, and these are hundreds.
            assert!(sigmas < 4.0 * 2.0_f64.sqrt(), "{} {k}: {sigmas}", block.pair);
            strongest = strongest.max(expected.norm() * deviation);
            squares += sigmas * sigmas;
            count += 2.0;
        }
    }
    eprintln!("{count} parts, mean square {:.3}, strongest {strongest:.0} sigma", squares / count);
    // The sky is there, not its noise alone.
    assert!(strongest > 8.0, "{strongest}");
    // Parts are correlated from pair to pair; a quarter of them as independent is cautious.
    assert!((squares / count - 1.0).abs() < 4.0 * (2.0 / (count / 4.0)).sqrt(), "{}", squares / count);
}

/// Samples of one daughter, one block after another.
fn stream(frames: &[SpaceFrame], daughter: u8) -> Vec<Complex64> {
    let mut all = Vec::new();
    for frame in frames {
        if let SpaceFrame::Samples(SampleBlock { daughter: d, samples: Samples::Float { re, im }, .. }) =
            frame
            && *d == daughter
        {
            all.extend(re.iter().zip(im).map(|(&re, &im)| Complex64::new(re.into(), im.into())));
        }
    }
    all
}

#[test]
fn delays_decorrelate_as_a_sinc_and_offsets_restore() {
    // An array that hardly moves, and a source along its track: delays up to 333 us.
    let slow = ArrayConfig { orbital_period_s: 8e6, ..ArrayConfig::default() };
    let start = {
        let array = Array::new(&slow).unwrap();
        let t_s = ObservingWindows::new(&array, 0.0, 1e9).next().unwrap().start.seconds();
        unit(sub(array.position_m(0, t_s), array.position_m(7, t_s)))
    };
    let sky = point(start);
    // At 1 MHz breathing turns the longest baseline's fringe by 0.015 in this time: 4e-4 of the amplitude.
    let craft = Spacecraft::new(slow, vec![1e6], sky, 40.0);
    let t_s = craft.window.start.seconds() + 20.0;
    let (frames, _) = craft.sample(5);
    let streams: Vec<Vec<Complex64>> = (0..8).map(|n| stream(&frames, n)).collect();
    let mut greatest = 0.0_f64;
    for pair in all_pairs(8) {
        let (i, j) = (usize::from(pair.i), usize::from(pair.j));
        let tau_s = dot(start, sub(craft.array.position_m(i, t_s), craft.array.position_m(j, t_s)))
            / SPEED_OF_LIGHT_M_S;
        let delay = tau_s * WIDTH_HZ;
        greatest = greatest.max(delay);
        for lag in [0, delay.round() as usize] {
            // The daughter nearer to the source is ahead: x_i(t) = x_j(t + tau).
            let pairs = streams[i].iter().zip(&streams[j][lag..]);
            let count = streams[i].len() - lag;
            let amplitude = (pairs.map(|(a, b)| a * b.conj()).sum::<Complex64>() / count as f64).norm();
            let x = PI * (delay - lag as f64);
            let expected = if x.abs() < 1e-9 { 1.0 } else { (x.sin() / x).abs() };
            // Noise of 1/sqrt(n) a complex mean; 1 - cos(pi lag / 128) and rounding of the lag at the window's rim.
            let error = (1.0 / count as f64).sqrt();
            assert!(
                (amplitude - expected).abs() < 4.0 * error + 3e-3,
                "{pair} {lag}: {amplitude} {expected}"
            );
        }
    }
    assert!(greatest > 2.0, "{greatest}");
}

#[test]
fn no_baseline_moves_more_than_an_eighth_of_a_wavelength() {
    let frequencies_hz = vec![3e6, 10e6, 30e6];
    let craft = Spacecraft::new(ArrayConfig::default(), frequencies_hz, constant(0.0), 60.0);
    for (channel, frequency_hz) in craft.frequencies_hz.iter().enumerate() {
        // Silence costs nothing to correlate: what is missing is integrated all the same.
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
                    // Whole dumps, of an eighth of the shortest integration or 2 ms: up to so much shorter.
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
    // Some blocks are lost, some come again, and some come too late.
    let (mut frames, mut late, mut arrived) = (Vec::new(), Vec::new(), std::collections::HashMap::new());
    let (mut lost, mut again) = (0, 0);
    for frame in craft.sample(6).0 {
        let SpaceFrame::Samples(block) = frame else {
            if matches!(frame, SpaceFrame::WindowEnd(_)) {
                frames.extend(late.drain(..).map(SpaceFrame::Samples));
            }
            frames.push(frame);
            continue;
        };
        let block = ones(block);
        let key = block.number * 16 + u64::from(block.channel.0) * 8 + u64::from(block.daughter);
        match key % 37 {
            0 => lost += 1,
            1 if block.number < 80 => late.push(block),
            more => {
                arrived.insert((block.channel, block.daughter, block.number), block.samples.len() as u64);
                if more == 2 {
                    again += 1;
                    frames.push(SpaceFrame::Samples(block.clone()));
                }
                frames.push(SpaceFrame::Samples(block));
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
                        // What is missing is left out of the mean, and not counted as nothing.
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
fn the_same_seed_gives_the_same_samples_whatever_the_threads() {
    let sky = point(unit([1.0, 2.0, 3.0]));
    let mut craft = Spacecraft::new(ArrayConfig::default(), frequencies(5), sky, 6.0);
    craft.receiver_noise_k_sr = 1.0;
    craft.daughters.bits = 4;
    let with = |threads: usize, seed: u64| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| craft.run(seed))
    };
    let first = with(1, 7);
    assert_eq!(first, with(3, 7));
    assert_ne!(first, with(1, 8));
}

/// A run of the whole chain in one of the fidelities: map, noise-only map.
fn mapped(folder: &std::path::Path, fidelity: &str, more: &[&str]) -> (Vec<f64>, Vec<f64>) {
    const PIPELINE: &str = r#"
        name = "small"
        seed = 3
        sky.nside = 8
        [spacecraft]
        channels_hz = [1.0e6]
        duration_s = 4.1e7
        every_nth_window = 100
        window_s_max = 30.0
        baseline_wavelengths_max = 24.0
        [map]
        nside = 8
        epsilon = 1e-3
        [products]
        pictures = false
    "#;
    let pipeline = folder.join("small.toml");
    std::fs::write(&pipeline, PIPELINE).unwrap();
    let out = folder.join(fidelity);
    let fidelity = format!("spacecraft.fidelity={fidelity}");
    let done = assert_cmd::Command::cargo_bin("lunarray")
        .unwrap()
        .args(["run", pipeline.to_str().unwrap(), "--out", out.to_str().unwrap(), "--set", &fidelity])
        .args(more.iter().flat_map(|set| ["--set", set]))
        .output()
        .unwrap();
    assert!(done.status.success(), "{}", String::from_utf8_lossy(&done.stderr));
    let mut maps = [Vec::new(), Vec::new()];
    for (map, name) in maps.iter_mut().zip(["map.fits", "noise.fits"]) {
        let path = out.join("1.000MHz").join(name);
        *map = read_map(&path, &ReadOptions::default()).unwrap().values().to_vec();
    }
    let [map, noise] = maps;
    (map, noise)
}

fn rms(values: impl ExactSizeIterator<Item = f64>) -> f64 {
    let count = values.len() as f64;
    (values.map(|x| x * x).sum::<f64>() / count).sqrt()
}

#[test]
fn a_map_of_samples_is_the_map_of_visibilities_within_its_noise() {
    let folder = tempfile::tempdir().unwrap();
    let (visibilities, noise) = mapped(folder.path(), "visibilities", &[]);
    let (samples, _) = mapped(folder.path(), "samples", &[]);
    let noise = rms(noise.iter().copied());
    let difference = rms(samples.iter().zip(&visibilities).map(|(a, b)| a - b));
    let sky = rms(visibilities.iter().copied());
    eprintln!("noise {noise:.3e}, difference {difference:.3e}, sky {sky:.3e} K rms");
    // Two independent noises; 768 pixels, of which a regularised map has fewer degrees of freedom.
    let ratio = difference / (2.0_f64.sqrt() * noise);
    assert!((0.7..1.4).contains(&ratio), "{ratio}");
    assert!(sky > 5.0 * noise, "{sky} {noise}");
}
