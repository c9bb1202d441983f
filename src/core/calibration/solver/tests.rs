//! The solver against data whose errors are known, and against bounds computed here.
#![allow(clippy::print_stderr)] // The tests print what they measured.

use std::f64::consts::TAU;

use num_complex::Complex64;
use rand::Rng;
use rand_distr::{Distribution, StandardNormal};

use super::*;
use crate::units::vector::Vec3;
use crate::units::{Pair, StreamKind, all_pairs, random_stream};

const SPAN_S: [f64; 2] = [0.0, 2700.0];

/// True errors of an array.
#[derive(Clone)]
struct True {
    /// By channel and daughter.
    gains: Vec<Vec<Complex64>>,
    clock_ns: Vec<f64>,
}

/// An array that observes a known signal.
struct Scene {
    satellites: usize,
    frequencies_hz: Vec<f64>,
    /// Number of visibilities of a pair in a pass.
    count: usize,
    /// Noise of the real and imaginary part, by pair.
    noise: fn(Pair) -> f64,
}

impl Scene {
    fn normal(&self) -> Vec<Vec3> {
        vec![[0.0, 0.0, 1.0]; self.satellites]
    }

    /// Model of visibility k: of unit power on average, with a rotating phase.
    fn model(&self, channel: usize, pair: Pair, k: usize) -> Complex64 {
        let identity = (channel as u64) << 40 | u64::from(pair.i) << 32 | u64::from(pair.j) << 24 | k as u64;
        let mut stream = random_stream(77, StreamKind::Probe, [identity, 0]);
        let [re, im]: [f64; 2] = std::array::from_fn(|_| StandardNormal.sample(&mut stream));
        // Longer baselines have weaker signals.
        let length = f64::from(pair.j - pair.i);
        Complex64::new(re, im) / length
    }

    /// Data with errors, and with the noise of a seed.
    fn blocks(&self, truth: &True, seed: u64) -> Vec<ModelledBlock> {
        let mut blocks = Vec::new();
        for (channel, hz) in self.frequencies_hz.iter().enumerate() {
            for pair in all_pairs(self.satellites) {
                let mut stream = random_stream(
                    seed,
                    StreamKind::VisibilityNoise,
                    [channel as u64, u64::from(pair.i) << 8 | u64::from(pair.j)],
                );
                let gain = |n: u8| {
                    let turns = hz * truth.clock_ns[usize::from(n)] * 1e-9;
                    truth.gains[channel][usize::from(n)] * Complex64::cis(-TAU * turns)
                };
                let factor = gain(pair.i) * gain(pair.j).conj();
                let sigma = (self.noise)(pair);
                let mut block = ModelledBlock { channel, pair, ..ModelledBlock::default() };
                for k in 0..self.count {
                    let mut terms = [Complex64::ZERO; MODEL_TERMS];
                    terms[0] = self.model(channel, pair, k);
                    let [re, im]: [f64; 2] = std::array::from_fn(|_| StandardNormal.sample(&mut stream));
                    block.time_s.push(SPAN_S[1] * k as f64 / self.count as f64);
                    block.value_k_sr.push(factor * terms[0] + sigma * Complex64::new(re, im));
                    block.weight.push(sigma.powi(-2));
                    block.model.push(terms);
                    block.is_out.push(false);
                }
                blocks.push(block);
            }
        }
        blocks
    }

    fn solve(&self, config: &SolverConfig, blocks: &mut [ModelledBlock]) -> PassSolution {
        let data = PassData { pass: 0, span_s: SPAN_S, blocks, normal_hat: self.normal() };
        solve_pass(config, &self.frequencies_hz, data)
    }

    fn no_errors(&self) -> True {
        let gains = vec![vec![Complex64::ONE; self.satellites]; self.frequencies_hz.len()];
        True { gains, clock_ns: vec![0.0; self.satellites] }
    }

    /// Random gains and clocks.
    fn errors(&self, seed: u64, [amplitude, phase_deg, clock_ns]: [f64; 3]) -> True {
        let mut stream = random_stream(seed, StreamKind::Probe, [1, 1]);
        let mut draw = |sigma: f64| {
            let value: f64 = StandardNormal.sample(&mut stream);
            sigma * value
        };
        let mut truth = self.no_errors();
        for gain in truth.gains.iter_mut().flatten() {
            *gain = Complex64::from_polar(draw(amplitude).exp(), draw(phase_deg.to_radians()));
        }
        truth.clock_ns.iter_mut().for_each(|clock| *clock = draw(clock_ns));
        truth
    }
}

fn scene(frequencies_hz: &[f64]) -> Scene {
    Scene {
        satellites: 8,
        frequencies_hz: frequencies_hz.to_vec(),
        count: 60,
        noise: |pair| 0.1 * (0.5 + f64::from(pair.j)),
    }
}

/// Inverse of a symmetric matrix by Gauss-Jordan elimination, independent of the solver.
fn inverse(mut a: Vec<Vec<f64>>) -> Vec<Vec<f64>> {
    let n = a.len();
    for (k, row) in a.iter_mut().enumerate() {
        row.extend((0..n).map(|m| f64::from(u8::from(k == m))));
    }
    for k in 0..n {
        let pivot = a[k][k];
        a[k].iter_mut().for_each(|x| *x /= pivot);
        let row = a[k].clone();
        for (m, other) in a.iter_mut().enumerate().filter(|(m, _)| *m != k) {
            let factor = other[k];
            other.iter_mut().zip(&row).for_each(|(x, y)| *x -= factor * y);
            let _ = m;
        }
    }
    a.into_iter().map(|row| row[n..].to_vec()).collect()
}

/// Cramer-Rao bound of the phases relative to daughter 1, rad: the Fisher information of phases is the Laplacian of
/// the pairs with weights sum |M|^2 / sigma^2; amplitudes are orthogonal to phases.
fn bounds(scene: &Scene, channel: usize) -> Vec<f64> {
    let n = scene.satellites;
    let mut fisher = vec![vec![0.0; n - 1]; n - 1];
    for pair in all_pairs(n) {
        let power: f64 = (0..scene.count).map(|k| scene.model(channel, pair, k).norm_sqr()).sum();
        let weight = power / (scene.noise)(pair).powi(2);
        let [i, j] = [pair.i, pair.j].map(usize::from);
        for k in [i, j].into_iter().filter(|k| *k > 0) {
            fisher[k - 1][k - 1] += weight;
        }
        if i > 0 {
            fisher[i - 1][j - 1] -= weight;
            fisher[j - 1][i - 1] -= weight;
        }
    }
    let inverse = inverse(fisher);
    (0..n - 1).map(|k| inverse[k][k].sqrt()).collect()
}

fn turned(deg: f64) -> f64 {
    (deg + 180.0).rem_euclid(360.0) - 180.0
}

#[test]
fn phases_reach_the_cramer_rao_bound_and_state_their_errors() {
    let scene = scene(&[10e6]);
    let bounds = bounds(&scene, 0);
    let config = SolverConfig { phase_sigma_deg_max: 1e3, ..SolverConfig::default() };
    let solutions = 1000;
    let (mut squares, mut inside, mut count) = (vec![0.0; 7], 0, 0);
    for seed in 0..solutions {
        let truth = scene.errors(seed, [0.1, 60.0, 0.0]);
        let solution = scene.solve(&config, &mut scene.blocks(&truth, seed));
        assert!(solution.converged, "{seed}: {solution:?}");
        let of = |n: usize| truth.gains[0][n].arg().to_degrees();
        for n in 1..8 {
            let gain = solution.daughters[n].gains[0];
            // Gains other than one change the weights, by some 10 % either way in units of the bound.
            let error_deg = turned(gain.phase_deg - (of(n) - of(0)));
            squares[n - 1] += error_deg * error_deg;
            inside += usize::from(error_deg.abs() < 3.0 * gain.phase_sigma_deg);
            count += 1;
        }
    }
    for (n, (square, bound)) in squares.iter().zip(&bounds).enumerate() {
        let rms_deg = (square / solutions as f64).sqrt();
        let ratio = rms_deg / bound.to_degrees();
        eprintln!("daughter {}: {rms_deg:.3} deg, bound {:.3}, ratio {ratio:.3}", n + 2, bound.to_degrees());
        assert!(ratio < 1.2, "daughter {}: {rms_deg} deg, bound {}", n + 2, bound.to_degrees());
    }
    let coverage = inside as f64 / f64::from(count);
    eprintln!("3-sigma coverage {coverage:.4}");
    assert!(coverage >= 0.99, "{coverage}");
}

#[test]
fn clocks_are_found_jointly_over_channels() {
    // The prior of the phases is 2 deg; a clock of 30 ns shifts the phase by most of a turn at 30 MHz.
    let scene = scene(&[3e6, 10e6, 21e6, 30e6]);
    let config = SolverConfig {
        phase_sigma_deg: 2.0,
        clock_sigma_ns: 60.0,
        amplitude_sigma: 0.2,
        ..SolverConfig::default()
    };
    for seed in 0..20 {
        let truth = scene.errors(100 + seed, [0.1, 2.0, 30.0]);
        let solution = scene.solve(&config, &mut scene.blocks(&truth, seed));
        assert!(solution.converged);
        for n in 1..8 {
            let daughter = &solution.daughters[n];
            let error_ns = daughter.clock_ns - (truth.clock_ns[n] - truth.clock_ns[0]);
            // Relative to the reference, whose phases are unknown too.
            assert!(
                error_ns.abs() < 4.0 * daughter.clock_sigma_ns + 1.0,
                "{seed}, {n}: {error_ns} {daughter:?}"
            );
        }
    }
}

#[test]
fn outliers_are_counted_and_rejected() {
    let scene = scene(&[10e6]);
    let truth = scene.errors(3, [0.1, 60.0, 0.0]);
    let clean = scene.solve(&SolverConfig::default(), &mut scene.blocks(&truth, 3));
    let mut blocks = scene.blocks(&truth, 3);
    let mut stream = random_stream(1, StreamKind::Probe, [9, 9]);
    let mut spoilt = 0;
    for block in &mut blocks {
        for k in 0..block.value_k_sr.len() {
            if stream.next_u32().is_multiple_of(50) {
                let turn = Complex64::cis(f64::from(stream.next_u32() % 628) * 0.01);
                block.value_k_sr[k] += 40.0 * block.weight[k].powf(-0.5) * turn;
                spoilt += 1;
            }
        }
    }
    let found = scene.solve(&SolverConfig::default(), &mut blocks);
    assert!(found.outliers >= spoilt && found.outliers < spoilt + 5, "{} of {spoilt}", found.outliers);
    assert_eq!(found.outliers + found.visibilities, clean.visibilities + clean.outliers);
    for (one, other) in clean.daughters.iter().zip(&found.daughters).skip(1) {
        // Losing two percent of the data costs a tenth of a standard deviation, typically.
        let apart = turned(one.gains[0].phase_deg - other.gains[0].phase_deg);
        assert!(apart.abs() < 1.0 * one.gains[0].phase_sigma_deg, "{apart}");
    }
}

#[test]
fn dead_and_missing_daughters_are_identified() {
    let scene = scene(&[10e6]);
    let mut truth = scene.errors(4, [0.1, 60.0, 0.0]);
    truth.gains[0][3] = Complex64::ZERO;
    let mut blocks = scene.blocks(&truth, 4);
    blocks.retain(|block| block.pair.i != 5 && block.pair.j != 5);
    let config = SolverConfig { dead_amplitude: 0.3, amplitude_sigma: 1.0, ..SolverConfig::default() };
    let solution = scene.solve(&config, &mut blocks);
    let states: Vec<GainState> = solution.daughters.iter().map(|daughter| daughter.gains[0].state).collect();
    assert_eq!((states[3], states[5]), (GainState::Dead, GainState::NoData), "{states:?}");
    let others = [0, 1, 2, 4, 6, 7].map(|n| states[n]);
    assert!(others.iter().all(|state| *state == GainState::Good), "{states:?}");
    let channel = crate::frames::Channel { frequency_hz: 10e6, width_hz: 8e3 };
    let file = gains_file(&[solution], &[channel], false);
    assert!(file.problems().is_empty());
    assert_eq!(file.channels[0].solutions[0].gains[3], [0.0, 0.0]);
    assert_ne!(file.channels[0].solutions[0].gains[2], [0.0, 0.0]);
}

#[test]
fn the_scale_of_amplitudes_is_as_configured() {
    let scene = scene(&[10e6]);
    let mut truth = scene.errors(8, [0.1, 10.0, 0.0]);
    truth.gains[0].iter_mut().for_each(|gain| *gain *= 1.3);
    let mean = |scale: AmplitudeScale| {
        let config = SolverConfig { amplitude_scale: scale, ..SolverConfig::default() };
        let found = scene.solve(&config, &mut scene.blocks(&truth, 8));
        found.daughters.iter().map(|daughter| daughter.gains[0].amplitude.ln()).sum::<f64>() / 8.0
    };
    let expected = truth.gains[0].iter().map(|gain| gain.norm().ln()).sum::<f64>() / 8.0;
    let found = mean(AmplitudeScale::Model);
    assert!((found - expected).abs() < 0.1, "{found} {expected}");
    assert!(mean(AmplitudeScale::UnitMean).abs() < 1e-6);
}

#[test]
fn a_solution_depends_on_the_data_alone() {
    let scene = scene(&[3e6, 10e6]);
    let truth = scene.errors(5, [0.1, 60.0, 20.0]);
    let solve = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| scene.solve(&SolverConfig::default(), &mut scene.blocks(&truth, 5)))
    };
    assert_eq!(solve(1), solve(3));
}

/// Visibilities per second of sums and robust rounds; printed, as machines differ.
#[test]
fn the_solver_rate_is_printed() {
    let scene = Scene { count: 10_000, ..scene(&[10e6]) };
    let truth = scene.errors(6, [0.1, 60.0, 0.0]);
    let mut blocks = scene.blocks(&truth, 6);
    let from = std::time::Instant::now();
    let solution = scene.solve(&SolverConfig::default(), &mut blocks);
    let seconds = from.elapsed().as_secs_f64();
    let count = (solution.visibilities + solution.outliers) as f64;
    eprintln!("{count:.0} visibilities in {seconds:.3} s: {:.2e} a second", count / seconds);
    assert_eq!(count, 280_000.0);
}

/// Six passes with constant errors, except for the changes that `disturb` makes to the truth and the data of one pass.
fn monitored(
    disturb: impl Fn(u64, &mut True, &mut dyn FnMut(&dyn Fn(&mut ModelledBlock))),
) -> Vec<InstrumentEvent> {
    let scene = scene(&[3e6, 10e6, 21e6, 30e6]);
    let mut solutions = Vec::new();
    for pass in 0..6 {
        let mut truth = scene.errors(9, [0.1, 60.0, 0.0]);
        let mut changes: Vec<ModelledBlock> = Vec::new();
        disturb(pass, &mut truth, &mut |_| {});
        let mut blocks = scene.blocks(&truth, pass);
        disturb(pass, &mut truth, &mut |change| blocks.iter_mut().for_each(change));
        changes.append(&mut blocks);
        let data = PassData { pass, span_s: SPAN_S, blocks: &mut changes, normal_hat: scene.normal() };
        solutions.push(solve_pass(&SolverConfig::default(), &scene.frequencies_hz, data));
    }
    instrument_events(&solutions)
}

#[test]
fn a_stable_instrument_has_no_events() {
    assert_eq!(monitored(|_, _, _| {}), []);
}

#[test]
fn a_clock_jump_is_distinguished_from_other_events() {
    let jump = |daughter: usize| {
        monitored(move |pass, truth, _| {
            if pass >= 3 {
                truth.clock_ns[daughter] = 8.0;
            }
        })
    };
    for daughter in [2, 0] {
        let events = jump(daughter);
        let [InstrumentEvent::ClockJump { pass: 3, daughter: told, change_ns, .. }] = events[..] else {
            panic!("{events:?}")
        };
        assert!(told == daughter as u32 + 1 && (change_ns - 8.0).abs() < 1.0, "{events:?}");
    }
}

#[test]
fn gain_and_phase_steps_are_reported_with_their_channels() {
    let events = monitored(|pass, truth, _| {
        if pass >= 2 {
            truth.gains[1][1] *= 1.5;
        }
    });
    let [InstrumentEvent::GainStep { pass: 2, daughter: 2, ref channels, .. }] = events[..] else {
        panic!("{events:?}")
    };
    assert!(channels.len() == 1 && channels[0].0 == 1 && (channels[0].1 - 1.5).abs() < 0.15, "{events:?}");
    let events = monitored(|pass, truth, _| {
        if pass >= 2 {
            truth.gains[3][1] *= Complex64::cis(2.0);
        }
    });
    let [InstrumentEvent::PhaseStep { pass: 2, daughter: 2, ref channels, .. }] = events[..] else {
        panic!("{events:?}")
    };
    assert!(channels.len() == 1 && channels[0].0 == 3, "{events:?}");
}

#[test]
fn interference_and_bursts_are_distinguished() {
    // First a channel with one disturbed visibility in four, then all channels for three minutes.
    let disturb = |block: &mut ModelledBlock, is_hit: &dyn Fn(usize, f64) -> bool| {
        for k in 0..block.time_s.len() {
            if is_hit(k + usize::from(block.pair.i + 2 * block.pair.j), block.time_s[k]) {
                block.value_k_sr[k] += 100.0 * block.weight[k].powf(-0.5);
            }
        }
    };
    let events = monitored(|pass, _, blocks| {
        blocks(&|block| {
            if pass == 4 && block.channel == 2 {
                disturb(block, &|k, _| k % 4 == 0);
            }
        });
    });
    let of_pass =
        |event: &InstrumentEvent| matches!(event, InstrumentEvent::Interference { pass: 4, channel: 2, .. });
    assert!(events.len() == 1 && of_pass(&events[0]), "{events:?}");
    let events = monitored(|pass, _, blocks| {
        blocks(&|block| {
            if pass == 4 {
                disturb(block, &|_, time_s| (900.0..1080.0).contains(&time_s));
            }
        });
    });
    let [InstrumentEvent::Burst { pass: 4, from_s, until_s }] = events[..] else { panic!("{events:?}") };
    assert!((from_s - 900.0).abs() < 60.0 && (until_s - 1080.0).abs() < 60.0, "{events:?}");
}
