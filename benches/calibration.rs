//! Rate of the solver of gains, pass by pass, beside accumulation of the same visibilities in the same run.
//!
//! `cargo bench --bench calibration`. Processor time of all threads counts, so that other load matters little.
#![allow(clippy::unwrap_used)] // A program for people at a terminal.

use std::f64::consts::TAU;
use std::time::{SystemTime, UNIX_EPOCH};

use lunarray::array::{Array, ArrayConfig, Ephemeris, ObservingWindows, segments_for};
use lunarray::calibration::solver::{
    CalibrationMode, GainState, KnownSignal, Offsets, PassBlocks, PassSolver, SkyModel, SolverConfig,
};
use lunarray::frames::{
    AntennaResponse, Channel, Flags, Instrument, ObservingWindow, PlacedVisibilities, VisibilityBlock,
};
use lunarray::imaging::NormalEngine;
use lunarray::imaging::circle::{HarmonicEngine, HarmonicSetup};
use lunarray::response::harmonic::{GeometryLimits, NominalOrbit};
use lunarray::sky::{Frame, SkyMap};
use lunarray::units::constants::SPEED_OF_LIGHT_M_S;
use lunarray::units::vector::{norm, sub};
use lunarray::units::{ChannelId, StreamKind, all_pairs, random_stream};
use num_complex::{Complex32, Complex64};
use rand::RngExt;

const FREQUENCY_HZ: f64 = 10e6;
/// Passes of which each rate is the mean.
const PASSES: usize = 8;
/// Least processor time of a measurement, s: a hundred of its ticks.
const LEAST_S: f64 = 1.0;
const BEACON_K_SR: f64 = 1e10;

/// User and system time of this process where /proc tells it (in its ticks of 10 ms), else wall-clock time.
fn processor_seconds() -> f64 {
    let Ok(stat) = std::fs::read_to_string("/proc/self/stat") else {
        return SystemTime::now().duration_since(UNIX_EPOCH).unwrap().as_secs_f64();
    };
    let fields: Vec<&str> = stat.rsplit(')').next().unwrap_or_default().split_whitespace().collect();
    [11, 12].iter().filter_map(|k| fields.get(*k)?.parse::<f64>().ok()).sum::<f64>() / 100.0
}

/// What is solved, of visibilities up to so many wavelengths.
struct Case {
    name: &'static str,
    config: SolverConfig,
    sky: Option<SkyMap>,
    wavelengths_max: f64,
    every_s: f64,
}

/// A pass as it is sent, and the same as the ground places it.
struct Pass {
    span_s: [f64; 2],
    blocks: Vec<VisibilityBlock>,
    placed: Vec<PlacedVisibilities>,
    ephemeris: Ephemeris,
}

fn instrument(array: &Array) -> Instrument {
    Instrument {
        name: "bench".to_owned(),
        epoch_tai_s: 2.5e9,
        moon_radius_m: array.moon_radius_m(),
        satellites: 8,
        channels: vec![Channel { frequency_hz: FREQUENCY_HZ, width_hz: 8e3 }],
        response: AntennaResponse::Isotropic,
        seed: 0,
        configuration_hash: 0,
        spectrometer: None,
        noiseless: false,
    }
}

/// A generated sky of some strong pixels above a level, K.
fn sky(nside: usize) -> SkyMap {
    let mut stream = random_stream(1, StreamKind::Probe, [0, 0]);
    let values = (0..12 * nside * nside).map(|_| 1e5 * stream.random::<f64>().powi(4)).collect();
    SkyMap::new(Frame::Ecliptic, values).unwrap()
}

/// A pass with gains of 60 deg, and noise of half the signal; with positions errors of 10 m.
fn pass(array: &Array, window: ObservingWindow, case: &Case, signal: &mut KnownSignal) -> Pass {
    let mut ephemeris = Ephemeris::default();
    for segment in segments_for(array, window.start, window.end, 60.0) {
        ephemeris.insert(segment);
    }
    let is_beacon = case.config.mode == CalibrationMode::Beacon;
    let mut stream = random_stream(2, StreamKind::Probe, [window.start.0 as u64, 0]);
    let mut draw = || 3.4641 * (stream.random::<f64>() - 0.5);
    let gains: Vec<Complex64> = (0..8).map(|_| Complex64::cis(1.05 * draw())).collect();
    let size_m = if case.config.position_sigma_m > 0.0 { 10.0 } else { 0.0 };
    let middle_s = 0.5 * (window.start.seconds() + window.end.seconds());
    let offsets = Offsets {
        offset_m: (0..8).map(|_| [0; 3].map(|_| size_m * draw())).collect(),
        normal_hat: (0..8).map(|n| array.normal_hat(n, middle_s)).collect(),
    };
    let (mut blocks, mut all) = (Vec::new(), Vec::new());
    for pair in all_pairs(8) {
        let [i, j] = [pair.i, pair.j].map(usize::from);
        let length_m = norm(sub(array.position_m(i, middle_s), array.position_m(j, middle_s)));
        if length_m * FREQUENCY_HZ / SPEED_OF_LIGHT_M_S > case.wavelengths_max {
            continue;
        }
        let count = ((window.end.seconds() - window.start.seconds()) / case.every_s) as u32;
        let ticks = ((window.end.0 - window.start.0) / i64::from(count)) as u32;
        let flags = if is_beacon { Flags::BEACON } else { Flags::GOOD };
        let mut block = VisibilityBlock {
            channel: ChannelId(0),
            pair,
            start: window.start,
            offset_ticks: (0..count).map(|k| ticks * k).collect(),
            duration_ticks: vec![ticks; count as usize],
            value_k_sr: vec![Complex32::ZERO; count as usize],
            weight: vec![1.0; count as usize],
            flags: vec![Flags::GOOD; count as usize],
        };
        let (placed, _) = ephemeris.place(&block, FREQUENCY_HZ);
        // What is flown is what packets say less the offsets: the value of the model, and its terms times them.
        let terms = signal.models(&[(&placed, is_beacon)], &offsets).unwrap().remove(0);
        let (a, b) = (offsets.offset_m[i], offsets.offset_m[j]);
        let factors = [1.0, a[0], a[1], a[2], b[0], b[1], b[2]];
        let of = |terms: &[Complex64; 7]| terms.iter().zip(factors).map(|(term, factor)| term * factor).sum();
        let values: Vec<Complex64> = terms.iter().map(of).collect();
        let power = values.iter().map(Complex64::norm_sqr).sum::<f64>() / f64::from(count);
        let sigma = 0.5 * (0.5 * power).sqrt();
        for (k, value) in values.iter().enumerate() {
            let value = gains[i] * gains[j].conj() * value + sigma * Complex64::new(draw(), draw());
            block.value_k_sr[k] = Complex32::new(value.re as f32, value.im as f32);
        }
        block.weight.fill(sigma.powi(-2) as f32);
        all.push(ephemeris.place(&block, FREQUENCY_HZ).0);
        block.flags.fill(flags);
        blocks.push(block);
    }
    Pass { span_s: [window.start, window.end].map(|t| t.seconds()), blocks, placed: all, ephemeris }
}

/// Visibilities a second of processor time of accumulation to l = 160, as for a map of nside 64.
fn accumulate(array: &Array, passes: &[Pass], wavelengths_max: f64) -> f64 {
    let weight_max = passes.iter().flat_map(|pass| &pass.placed).flat_map(|block| &block.weight);
    let mut engine = HarmonicEngine::new(HarmonicSetup {
        l_max: 160,
        frequency_hz: FREQUENCY_HZ,
        baseline_m_max: wavelengths_max.min(125.0) * SPEED_OF_LIGHT_M_S / FREQUENCY_HZ,
        moon_radius_m: array.moon_radius_m(),
        response: AntennaResponse::Isotropic,
        orbit: NominalOrbit {
            inclination_rad: 30_f64.to_radians(),
            radius_m: array.orbit_radius_m(),
            limits: GeometryLimits::default(),
        },
        companion_seed: 1,
        weight_max: 1024.0 * weight_max.copied().fold(0.0, f64::max),
    })
    .unwrap();
    let mut add = || {
        let mut count = 0;
        for block in passes.iter().flat_map(|pass| &pass.placed) {
            count += engine.add(block).unwrap().visibilities;
        }
        engine.flush();
        count
    };
    // The first round touches the memory for the first time; a mission is like the second.
    add();
    let (since, mut count) = (processor_seconds(), 0);
    while processor_seconds() - since < LEAST_S {
        count += add();
    }
    count as f64 / (processor_seconds() - since)
}

fn run(array: &Array, windows: &[ObservingWindow], case: &Case) {
    let maps: Vec<SkyMap> = case.sky.iter().cloned().collect();
    let instrument = instrument(array);
    let mut signal = KnownSignal::new(&case.config, &instrument, &maps).unwrap();
    let passes: Vec<Pass> = windows.iter().map(|window| pass(array, *window, case, &mut signal)).collect();
    let accumulated = accumulate(array, &passes, case.wavelengths_max);
    let mut solver = PassSolver::new(&case.config, None, maps);
    solver.describe(&instrument, "model").unwrap();
    let (mut visibilities, mut good) = (0, [0, 0]);
    let mut round = || {
        let sent: Vec<PassBlocks> = passes
            .iter()
            .map(|pass| PassBlocks { number: 0, span_s: pass.span_s, blocks: pass.blocks.clone() })
            .collect();
        let since = processor_seconds();
        for (pass, sent) in passes.iter().zip(sent) {
            for solution in solver.solve(sent, &pass.ephemeris).unwrap().solutions {
                visibilities += solution.visibilities + solution.outliers;
                let gains = solution.daughters.iter().map(|daughter| daughter.gains[0]);
                for gain in gains.filter(|gain| gain.state != GainState::NoData) {
                    good = [good[0] + usize::from(gain.state == GainState::Good), good[1] + 1];
                }
            }
        }
        processor_seconds() - since
    };
    // Tables of harmonics are made in the first round, as at the start of a mission.
    let first_s = round();
    let (mut seconds, mut rounds) = (0.0, 0);
    while seconds < LEAST_S {
        seconds += round();
        rounds += 1;
    }
    let visibilities = visibilities as f64 * f64::from(rounds) / f64::from(rounds + 1);
    let rate = visibilities / seconds;
    println!(
        "{:<34} {visibilities:>8.0} visibilities {:>8.3} us each, {rate:.2e}/s of a core; accumulation {accumulated:.2e}/s, ratio {:.3}; \
         {:.2} s more in the first round; {} of {} gains good",
        case.name,
        1e6 / rate,
        rate / accumulated,
        first_s - seconds / f64::from(rounds),
        good[0],
        good[1]
    );
}

fn main() {
    let array = Array::new(&ArrayConfig::default()).unwrap();
    let windows: Vec<ObservingWindow> =
        ObservingWindows::new(&array, 0.0, 30.0 * 86_400.0).step_by(20).take(PASSES).collect();
    let base = SolverConfig { mode: CalibrationMode::Sky, amplitude_sigma: 0.15, ..SolverConfig::default() };
    let beacon = SolverConfig { mode: CalibrationMode::Beacon, beacon_k_sr: BEACON_K_SR, ..base.clone() };
    let moves = SolverConfig { position_sigma_m: 15.0, ..base.clone() };
    // An eighth of a turn of the fringe of 31 wavelengths: period / (2 pi 8 31.25).
    let every_s = array.orbital_period_s() / TAU / 250.0;
    let with_sky = |name, config: &SolverConfig, nside| Case {
        name,
        config: config.clone(),
        sky: Some(sky(nside)),
        wavelengths_max: 31.25,
        every_s,
    };
    let direct = SolverConfig { sky_model: SkyModel::Direct, ..base.clone() };
    let known = Case { name: "beacon", config: beacon, sky: None, wavelengths_max: 125.0, every_s: 0.1 };
    // All that a map of nside 64 takes, as often as the mother sends the longest of it.
    let whole = Case { wavelengths_max: 125.0, every_s: 0.25 * every_s, ..with_sky("", &base, 64) };
    println!("10 MHz, means of {PASSES} passes, {} threads", rayon::current_num_threads());
    run(&array, &windows, &known);
    run(&array, &windows, &Case { name: "sky, nside 64, to 125 wavelengths", ..whole });
    run(&array, &windows, &with_sky("sky, nside 64, to 31 wavelengths", &base, 64));
    run(&array, &windows, &with_sky("the same by sums over pixels", &direct, 64));
    run(&array, &windows, &with_sky("sky, nside 16, sums over pixels", &base, 16));
    run(&array, &windows, &with_sky("sky with positions, nside 16", &moves, 16));
    run(&array, &windows, &with_sky("sky with positions, nside 64", &moves, 64));
}
