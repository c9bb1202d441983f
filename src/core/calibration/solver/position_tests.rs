//! Position errors of radians of phase, with errors of gains, in data summed here over the pixels of a sky.
#![allow(clippy::print_stderr)] // The tests print what they measured.

use std::f64::consts::{PI, TAU};

use num_complex::Complex64;
use rand_distr::{Distribution, StandardNormal};
use rayon::prelude::*;

use super::passes::PassTask;
use super::solution::solve_from;
use super::*;
use crate::array::{Array, ArrayConfig, ObservingWindows, hidden_by_moon};
use crate::frames::{AntennaResponse, Channel, Instrument, PlacedVisibilities};
use crate::sky::{Frame, SkyMap};
use crate::units::constants::SPEED_OF_LIGHT_M_S;
use crate::units::vector::{Vec3, add, cross, dot, norm, scale, sub, unit};
use crate::units::{ChannelId, StreamKind, all_pairs, random_stream};

const DAUGHTERS: usize = 8;
/// Number of instants of a pass.
const INSTANTS: usize = 120;
/// Maximum baseline: that of three to six daughters at 10 MHz.
const WAVELENGTHS_MAX: f64 = 100.0;
/// Standard deviations of phases (deg), amplitudes, clocks (ns) and positions (m).
const ERRORS: [f64; 4] = [60.0, 0.1, 30.0, 10.0];

/// A sky of a few hundred sources at the centres of pixels: sums over the pixels are exact on any baseline.
struct Scene {
    frequencies_hz: Vec<f64>,
    sky: SkyMap,
    directions: Vec<Vec3>,
    /// Sum of the squares of the visibilities over the sky, over their noise.
    signal_to_noise: f64,
    beacon_k_sr: f64,
}

/// True errors of all daughters.
struct Truth {
    gains: Vec<Vec<Complex64>>,
    position_m: Vec<[f64; 3]>,
}

const BEACON_DEG: [f64; 2] = [40.0, 10.0];

impl Scene {
    fn new(frequencies_hz: &[f64], signal_to_noise: f64) -> Self {
        let mut stream = random_stream(5, StreamKind::Probe, [0, 0]);
        let mut normal = || -> f64 { StandardNormal.sample(&mut stream) };
        // The sky has a few hundred sources, some of them strong, above a level.
        let values = (0..12 * 8 * 8).map(|_| 1e4 * (1.5 * normal()).exp()).collect();
        let sky = SkyMap::new(Frame::Ecliptic, values).unwrap();
        let directions = sky.directions_ecliptic();
        Self { frequencies_hz: frequencies_hz.to_vec(), sky, directions, signal_to_noise, beacon_k_sr: 0.0 }
    }

    fn instrument(&self) -> Instrument {
        let channel = |hz: &f64| Channel { frequency_hz: *hz, width_hz: 8e3 };
        Instrument {
            name: String::new(),
            epoch_tai_s: 0.0,
            moon_radius_m: array().moon_radius_m(),
            satellites: DAUGHTERS as u8,
            channels: self.frequencies_hz.iter().map(channel).collect(),
            response: AntennaResponse::Isotropic,
            seed: 0,
            configuration_hash: 0,
            spectrometer: None,
            noiseless: false,
        }
    }

    fn truth(&self, seed: u64, [phase_deg, amplitude, clock_ns, position_m]: [f64; 4]) -> Truth {
        let mut stream = random_stream(seed, StreamKind::Probe, [4, 4]);
        let mut normal = || -> f64 { StandardNormal.sample(&mut stream) };
        let clocks: Vec<f64> = (0..DAUGHTERS).map(|_| clock_ns * normal()).collect();
        let mut gain = |hz: f64, clock_ns: f64| {
            let phase = phase_deg.to_radians() * normal() - TAU * hz * 1e-9 * clock_ns;
            Complex64::from_polar((amplitude * normal()).exp(), phase)
        };
        let gains =
            self.frequencies_hz.iter().map(|hz| clocks.iter().map(|clock| gain(*hz, *clock)).collect());
        let gains = gains.collect();
        Truth { gains, position_m: (0..DAUGHTERS).map(|_| [0; 3].map(|_| position_m * normal())).collect() }
    }

    fn visibility(&self, r_i_m: Vec3, r_j_m: Vec3, hz: f64, with_beacon: bool) -> Complex64 {
        let moon_m = array().moon_radius_m();
        let u = scale(hz / SPEED_OF_LIGHT_M_S, sub(r_i_m, r_j_m));
        let area_sr = 4.0 * PI / self.directions.len() as f64;
        let seen =
            |n_hat: &Vec3| !hidden_by_moon(r_i_m, *n_hat, moon_m) && !hidden_by_moon(r_j_m, *n_hat, moon_m);
        let sky: Complex64 = self
            .directions
            .iter()
            .zip(self.sky.values())
            .filter(|(n_hat, _)| seen(n_hat))
            .map(|(n_hat, kelvin)| kelvin * area_sr * Complex64::cis(-TAU * dot(u, *n_hat)))
            .sum();
        let [longitude, latitude] = BEACON_DEG.map(f64::to_radians);
        let from_hat = [latitude.cos() * longitude.cos(), latitude.cos() * longitude.sin(), latitude.sin()];
        let beacon = self.beacon_k_sr * Complex64::cis(-TAU * dot(u, from_hat));
        if with_beacon { sky + beacon } else { sky }
    }

    /// Data of a pass with errors, with the positions in packets.
    fn pass(&self, truth: &Truth, seed: u64) -> (Vec<(PlacedVisibilities, bool)>, [f64; 2], Vec<Vec3>) {
        let array = array();
        let start_s = 2e4 + 86_400.0 * (seed % 7) as f64;
        let mut windows = ObservingWindows::new(&array, start_s, start_s + 4e4);
        let window = windows.find(|window| window.start.seconds() > start_s).unwrap();
        let span_s = [window.start.seconds(), window.end.seconds()];
        let time_s: Vec<f64> = (0..INSTANTS)
            .map(|k| span_s[0] + (span_s[1] - span_s[0]) * (k as f64 + 0.5) / INSTANTS as f64)
            .collect();
        let normal_hat: Vec<Vec3> =
            (0..DAUGHTERS).map(|n| array.normal_hat(n, 0.5 * (span_s[0] + span_s[1]))).collect();
        let reported_m = |n: usize, t_s: f64| {
            let r_m = array.position_m(n, t_s);
            let (up, normal) = (unit(r_m), normal_hat[n]);
            let [along_m, across_m, radial_m] = truth.position_m[n];
            let along = scale(along_m, unit(cross(normal, up)));
            add(r_m, add(along, add(scale(across_m, normal), scale(radial_m, up))))
        };
        let of = |(channel, pair): &(usize, crate::units::Pair)| {
            let hz = self.frequencies_hz[*channel];
            let [i, j] = [pair.i, pair.j].map(usize::from);
            let middle_s = 0.5 * (span_s[0] + span_s[1]);
            let baseline_m = norm(sub(array.position_m(i, middle_s), array.position_m(j, middle_s)));
            let mut parts: Vec<(PlacedVisibilities, bool)> = Vec::new();
            if baseline_m * hz / SPEED_OF_LIGHT_M_S > WAVELENGTHS_MAX {
                return parts;
            }
            let mut stream = random_stream(
                seed,
                StreamKind::VisibilityNoise,
                [*channel as u64, u64::from(pair.i) << 8 | u64::from(pair.j)],
            );
            let gain = truth.gains[*channel][i] * truth.gains[*channel][j].conj();
            for with_beacon in [false, true] {
                let mut placed = PlacedVisibilities {
                    channel: ChannelId(*channel as u16),
                    frequency_hz: hz,
                    pair: *pair,
                    ..PlacedVisibilities::default()
                };
                // The beacon is on in every tenth integration.
                let is_on = |k: usize| self.beacon_k_sr > 0.0 && k % 10 == 4;
                for (k, &t_s) in time_s.iter().enumerate().filter(|(k, _)| is_on(*k) == with_beacon) {
                    let _ = k;
                    let [r_i_m, r_j_m] = [i, j].map(|n| array.position_m(n, t_s));
                    let value = self.visibility(r_i_m, r_j_m, hz, with_beacon);
                    placed.time_s.push(t_s);
                    placed.r_i_m.push(reported_m(i, t_s));
                    placed.r_j_m.push(reported_m(j, t_s));
                    placed.value_k_sr.push(gain * value);
                }
                let power = placed.value_k_sr.iter().map(|value| value.norm_sqr()).sum::<f64>();
                let sigma = (0.5 * power / placed.len() as f64).sqrt() / self.signal_to_noise;
                for value in &mut placed.value_k_sr {
                    let [re, im]: [f64; 2] = std::array::from_fn(|_| StandardNormal.sample(&mut stream));
                    *value += sigma * Complex64::new(re, im);
                    placed.weight.push(sigma.powi(-2));
                }
                if !placed.is_empty() {
                    parts.push((placed, with_beacon));
                }
            }
            parts
        };
        let channels = 0..self.frequencies_hz.len();
        let all: Vec<_> =
            channels.flat_map(|c| all_pairs(DAUGHTERS).into_iter().map(move |pair| (c, pair))).collect();
        (all.par_iter().flat_map_iter(of).collect(), span_s, normal_hat)
    }

    fn solve(&self, config: &SolverConfig, truth: &Truth, seed: u64) -> PassSolution {
        self.solve_with(&self.sky, config, truth, seed)
    }

    /// Solves with another sky as the known one.
    fn solve_with(&self, sky: &SkyMap, config: &SolverConfig, truth: &Truth, seed: u64) -> PassSolution {
        let (placed, span_s, normal_hat) = self.pass(truth, seed);
        let mut signal = self.signal(sky, config);
        let task = PassTask { config, frequencies: &self.frequencies_hz, number: 0, span_s, normal_hat };
        task.solve(&placed, &mut signal).unwrap().remove(0)
    }

    fn signal(&self, sky: &SkyMap, config: &SolverConfig) -> KnownSignal {
        let maps = vec![sky.clone(); self.frequencies_hz.len()];
        KnownSignal::new(config, &self.instrument(), &maps).unwrap()
    }

    /// Solves starting with the positions of daughters 2, 3 and 4 off by shifts.
    fn solve_off(
        &self,
        config: &SolverConfig,
        truth: &Truth,
        seed: u64,
        shifts_m: [Vec3; 3],
    ) -> PassSolution {
        let (placed, span_s, normal_hat) = self.pass(truth, seed);
        let mut signal = self.signal(&self.sky, config);
        let mut offset_m = relative(truth);
        for (offset_m, shift_m) in offset_m[1..].iter_mut().zip(shifts_m) {
            *offset_m = add(*offset_m, shift_m);
        }
        let offsets = Offsets { offset_m, normal_hat: normal_hat.clone() };
        let placed: Vec<(&PlacedVisibilities, bool)> =
            placed.iter().map(|(block, on)| (block, *on)).collect();
        let mut blocks = super::positions::modelled(&placed, &mut signal, &offsets).unwrap();
        let data = PassData { pass: 0, span_s: [0.0, f64::INFINITY], blocks: &mut blocks, normal_hat };
        let _ = span_s;
        solve_from(config, &self.frequencies_hz, data, &offsets.offset_m)
    }
}

/// Positions relative to those of the first daughter.
fn relative(truth: &Truth) -> Vec<[f64; 3]> {
    truth.position_m.iter().map(|position_m| sub(*position_m, truth.position_m[0])).collect()
}

fn array() -> Array {
    Array::new(&ArrayConfig::default()).unwrap()
}

fn config() -> SolverConfig {
    SolverConfig {
        position_sigma_m: 15.0,
        clock_sigma_ns: 45.0,
        amplitude_sigma: 0.2,
        ..SolverConfig::default()
    }
}

/// For each daughter that is used in the highest channel: whether it is good there, and whether its position is
/// right, in units of its stated error, and within a tenth of a wavelength.
fn right(scene: &Scene, truth: &Truth, found: &PassSolution) -> Vec<(bool, bool, f64)> {
    let highest = scene.frequencies_hz.len() - 1;
    let wavelength_m = SPEED_OF_LIGHT_M_S / scene.frequencies_hz[highest];
    let of = |n: usize| {
        let daughter = &found.daughters[n];
        if daughter.gains[highest].visibilities == 0 {
            return None;
        }
        let error_m = sub(daughter.position_m, relative(truth)[n]);
        let sigmas =
            (0..3).map(|axis| error_m[axis].abs() / daughter.position_sigma_m[axis]).fold(0.0, f64::max);
        let is_good = daughter.gains[highest].state == GainState::Good;
        Some((is_good, norm(error_m) < 0.1 * wavelength_m, sigmas))
    };
    (1..DAUGHTERS).filter_map(of).collect()
}

/// Solves passes with the errors; counts solutions of daughters (all, good, right, good but wrong), and the median of
/// the worst component's error in its standard deviations.
fn solve_passes(scene: &Scene, config: &SolverConfig, passes: u64) -> ([usize; 4], f64) {
    let all: Vec<(bool, bool, f64)> = (0..passes)
        .flat_map(|seed| {
            let truth = scene.truth(seed, ERRORS);
            let found = scene.solve(config, &truth, seed);
            let right = right(scene, &truth, &found);
            eprintln!(
                "pass {seed}: chi-square {:.3}, converged {}, {right:.1?}",
                found.chi_square, found.converged
            );
            right
        })
        .collect();
    let count = |of: fn(&(bool, bool, f64)) -> bool| all.iter().filter(|one| of(one)).count();
    let mut sigmas: Vec<f64> = all.iter().filter(|one| one.1).map(|one| one.2).collect();
    sigmas.sort_unstable_by(f64::total_cmp);
    let numbers = [all.len(), count(|one| one.0), count(|one| one.1), count(|one| one.0 && !one.1)];
    (numbers, sigmas.get(sigmas.len() / 2).copied().unwrap_or(f64::NAN))
}

#[test]
fn positions_of_ten_metres_are_found_from_the_lowest_channel_upwards() {
    let scene = Scene::new(&[3e6, 10e6, 30e6], 1.0);
    let ([all, good, right, wrong], sigmas) = solve_passes(&scene, &config(), 6);
    eprintln!("{good} good and {right} right of {all}, {wrong} good but wrong; median {sigmas:.2} sigma");
    assert!(
        all >= 8 && right * 20 >= all * 19 && wrong == 0,
        "{good} good, {right} right, {wrong} wrong of {all}"
    );
    // The largest of three absolute Gaussian numbers has a median of 1.26.
    assert!((0.9..1.6).contains(&sigmas), "{sigmas}");
}

#[test]
fn positions_of_two_radians_are_found_in_one_channel() {
    let scene = Scene::new(&[10e6], 1.0);
    let ([all, good, right, wrong], sigmas) = solve_passes(&scene, &config(), 6);
    eprintln!("{good} good and {right} right of {all}, {wrong} good but wrong; median {sigmas:.2} sigma");
    assert!(
        all >= 16 && right * 20 >= all * 19 && wrong == 0,
        "{good} good, {right} right, {wrong} wrong of {all}"
    );
}

#[test]
fn a_strong_beacon_does_not_mislead_positions() {
    let scene = Scene { beacon_k_sr: 1e10, ..Scene::new(&[3e6, 10e6, 30e6], 30.0) };
    let config = SolverConfig {
        mode: CalibrationMode::Joint,
        beacon_k_sr: scene.beacon_k_sr,
        beacon_direction_deg: BEACON_DEG,
        ..config()
    };
    let ([all, good, right, wrong], _) = solve_passes(&scene, &config, 6);
    eprintln!("{good} good and {right} right of {all}, {wrong} good but wrong");
    assert!(
        all >= 8 && right * 20 >= all * 19 && wrong == 0,
        "{good} good, {right} right, {wrong} wrong of {all}"
    );
}

/// Solves starting off by what `shifts_m` makes of a seed and a shift. Counts wrong solutions, wrong ones that are
/// good, right ones, and right ones that are not good.
fn solve_passes_off(shifts_m: impl Fn(u64, Vec3) -> [Vec3; 3]) -> [u32; 4] {
    let scene = Scene::new(&[10e6], 1.0);
    let (mut wrong, mut missed, mut right_ones, mut refused) = (0, 0, 0, 0);
    let (mut undisturbed, mut undisturbed_refused) = (0, 0);
    for seed in 0..6 {
        let truth = scene.truth(seed, ERRORS);
        // Shifts range from a hundredth to a half of a wavelength.
        for shift_m in
            [[0.3, 0.0, 0.0], [0.0, 0.3, 0.3], [9.0, -5.0, 0.0], [0.0, 9.0, 9.0], [-12.0, 0.0, 9.0]]
        {
            let found = scene.solve_off(&config(), &truth, seed, shifts_m(seed, shift_m));
            // Where positions are not known better, a tenth of a wavelength may be noise.
            let daughters: Vec<(bool, bool)> = right(&scene, &truth, &found)
                .into_iter()
                .map(|(is_good, is_near, sigmas)| (is_good, is_near || sigmas < 4.0))
                .collect();
            if daughters.iter().all(|(_, is_right)| *is_right) {
                undisturbed += daughters.len() as u32;
                undisturbed_refused += daughters.iter().filter(|(is_good, _)| !is_good).count() as u32;
            }
            for (is_good, is_right) in daughters {
                (wrong, right_ones) = (wrong + u32::from(!is_right), right_ones + u32::from(is_right));
                missed += u32::from(is_good && !is_right);
                refused += u32::from(!is_good && is_right);
            }
        }
    }
    eprintln!(
        "{missed} of {wrong} wrong ones are good, {refused} of {right_ones} right ones are not, {undisturbed_refused} of {undisturbed} in passes \
         without a wrong one"
    );
    [wrong, missed, right_ones, refused]
}

#[test]
fn wrong_minima_are_not_good_solutions() {
    // First one daughter is off.
    let [wrong, missed, right_ones, refused] = solve_passes_off(|seed, shift_m| {
        std::array::from_fn(|k| if k as u64 == seed % 3 { shift_m } else { [0.0; 3] })
    });
    assert!(wrong >= 5 && right_ones >= 30);
    // A wrong daughter misleads others: those with smaller errors leave less of their signal unexplained.
    assert!(
        missed * 4 <= wrong && refused * 4 <= right_ones,
        "{missed} of {wrong}, {refused} of {right_ones}"
    );
}

#[test]
fn three_wrong_daughters_contradict_one_another() {
    let [wrong, missed, right_ones, refused] = solve_passes_off(|seed, shift_m| {
        let mut stream = random_stream(seed, StreamKind::Probe, [7, (shift_m[0] * 10.0 + 500.0) as u64]);
        let size_m = norm(shift_m) / 3.0_f64.sqrt();
        std::array::from_fn(|_| {
            std::array::from_fn(|_| {
                let by: f64 = StandardNormal.sample(&mut stream);
                size_m * by
            })
        })
    });
    assert!(wrong >= 15 && right_ones >= 30);
    // Where daughters contradict one another, right ones are rejected too.
    assert!(
        missed * 6 <= wrong && refused * 3 <= right_ones,
        "{missed} of {wrong}, {refused} of {right_ones}"
    );
}

#[test]
fn a_sky_that_is_right_within_a_fifth_is_good_enough() {
    let scene = Scene::new(&[3e6, 10e6, 30e6], 3.0);
    let mut stream = random_stream(8, StreamKind::Probe, [0, 0]);
    let values = scene.sky.values().iter().map(|kelvin| {
        let error: f64 = StandardNormal.sample(&mut stream);
        kelvin * (1.0 + 0.2 * error)
    });
    let sky = SkyMap::new(Frame::Ecliptic, values.collect()).unwrap();
    let (mut all, mut good_and_right, mut good_and_wrong) = (0, 0, 0);
    for seed in 0..6 {
        let truth = scene.truth(seed, ERRORS);
        let found = scene.solve_with(&sky, &config(), &truth, seed);
        let right = right(&scene, &truth, &found);
        eprintln!("pass {seed}: chi-square {:.3}, {right:.1?}", found.chi_square);
        all += right.len();
        good_and_right += right.iter().filter(|one| one.0 && one.1).count();
        good_and_wrong += right.iter().filter(|one| one.0 && !one.1).count();
    }
    eprintln!("{good_and_right} good and right, {good_and_wrong} good and wrong, of {all}");
    assert!(all >= 8 && good_and_right * 10 >= all * 9 && good_and_wrong == 0);
}
