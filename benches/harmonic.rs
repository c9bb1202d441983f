//! Rates of the harmonic engine on the paper's array.
#![allow(clippy::expect_used, clippy::unwrap_used)] // Settings are the bench's own.

use std::f64::consts::TAU;
use std::time::Instant;

use lunarray::array::{Array, ArrayConfig, ObservingWindows};
use lunarray::frames::{AntennaResponse, ObservingWindow, PlacedVisibilities};
use lunarray::imaging::circle::{HarmonicEngine, HarmonicSetup, HarmonicSums, memory};
use lunarray::imaging::{NormalEngine, NormalSums};
use lunarray::response::harmonic::{
    GeometryLimits, HarmonicModel, ModelSettings, NominalOrbit, PairState, PatternGeometry,
};
use lunarray::sky::harmonics::Alm;
use lunarray::units::all_pairs;
use lunarray::units::constants::SPEED_OF_LIGHT_M_S;
use lunarray::units::vector::{norm, sub};
use num_complex::Complex64;
use rayon::prelude::*;

fn geometry(array: &Array, frequency_hz: f64) -> PatternGeometry {
    PatternGeometry {
        orbit_radius_m: array.orbit_radius_m(),
        moon_radius_m: array.moon_radius_m(),
        wavelength_m: SPEED_OF_LIGHT_M_S / frequency_hz,
        response: AntennaResponse::Isotropic,
    }
}

/// The states of every pair below `u_max` over a window, pair after pair.
fn states(array: &Array, window: ObservingWindow, wavelength_m: f64, u_max: f64, out: &mut Vec<PairState>) {
    let (radius, formation) = (array.orbit_radius_m(), array.formation().unwrap());
    let rate = TAU / array.orbital_period_s();
    for pair in all_pairs(array.satellites()) {
        let mut t = window.start.seconds();
        while t < window.end.seconds() {
            let arcs = [pair.i, pair.j].map(|n| formation.arc_m(usize::from(n), t).0 / radius);
            let u = 2.0 * radius * (0.5 * (arcs[1] - arcs[0])).sin() / wavelength_m;
            if u > u_max {
                break;
            }
            let dt = (1.0 / (8.0 * u * rate)).min(25.0);
            let turns = (t / array.orbital_period_s()).fract();
            out.push(PairState {
                node_rad: -TAU * t / (1.3 * 365.25 * 86_400.0),
                phase_rad: TAU * turns - 0.5 * (arcs[0] + arcs[1]),
                baseline_wavelengths: u,
                span_rad: rate * dt,
            });
            t += dt;
        }
    }
}

/// Wall-clock and processor time; the latter is comparable on a busy machine too.
struct Clock(Instant, f64);

impl Clock {
    fn start() -> Self {
        Self(Instant::now(), processor_seconds())
    }

    /// Wall-clock and processor seconds since the start.
    fn read(&self) -> (f64, f64) {
        (self.0.elapsed().as_secs_f64(), processor_seconds() - self.1)
    }
}

/// User and system time of this process where /proc tells it (in its ticks of 10 ms), else zero.
fn processor_seconds() -> f64 {
    let Ok(stat) = std::fs::read_to_string("/proc/self/stat") else { return 0.0 };
    let fields: Vec<&str> = stat.rsplit(')').next().unwrap_or_default().split_whitespace().collect();
    [11, 12].iter().filter_map(|k| fields.get(*k)?.parse::<f64>().ok()).sum::<f64>() / 100.0
}

fn falling_sky(l_max: usize) -> Alm {
    let mut alm = Alm::zeros(l_max);
    for m in 0..=l_max {
        for l in m..=l_max {
            let size = 1e5 / (l as f64 + 1.0).powf(1.35);
            let angle = (l * 7919 + m * 104_729) as f64;
            *alm.get_mut(l, m) =
                Complex64::new(size * angle.cos(), if m == 0 { 0.0 } else { size * angle.sin() });
        }
    }
    alm
}

fn forward(array: &Array, windows: &[ObservingWindow], l_max: usize, u_max: f64, at_once: usize) {
    let geometry = geometry(array, 1e7);
    let clock = Clock::start();
    let settings = ModelSettings::new(geometry, 30_f64.to_radians(), u_max);
    let mut model = HarmonicModel::new(falling_sky(l_max), settings).expect("settings in range");
    let set_up = clock.read();
    let clock = Clock::start();
    let mut count = 0;
    for windows in windows.chunks(at_once) {
        let mut batch = Vec::new();
        for window in windows {
            states(array, *window, geometry.wavelength_m, u_max, &mut batch);
        }
        let mut values = vec![Complex64::ZERO; batch.len()];
        model.visibilities(&batch, &mut values).expect("states in range");
        count += values.len();
    }
    let run = clock.read();
    let mission = 2.6e7 / (set_up.0 + 2.6e7 * run.0 / count as f64);
    println!(
        "forward l {l_max}, u < {u_max}, {at_once} windows at once: set-up {:.1} s ({:.1} s of processor), {count} \
         visibilities in {:.2} s ({:.2} s), {:.3e}/s; over 2.6e7 with set-up {mission:.3e}/s",
        set_up.0,
        set_up.1,
        run.0,
        run.1,
        count as f64 / run.0,
    );
}

/// Rate of the library's matrix product, both cores, f32, floating-point operations a second.
fn matrix_product_flops() -> f64 {
    const N: usize = 1536;
    let (a, b) = (faer::Mat::<f32>::from_fn(N, N, |i, j| (i + j) as f32), faer::Mat::<f32>::identity(N, N));
    let mut c = faer::Mat::<f32>::zeros(N, N);
    let threads = rayon::current_num_threads();
    let mut best = f64::INFINITY;
    for _ in 0..5 {
        let since = Instant::now();
        faer::linalg::matmul::matmul(&mut c, faer::Accum::Replace, &a, &b, 1.0, faer::Par::rayon(threads));
        best = best.min(since.elapsed().as_secs_f64());
    }
    2.0 * (N * N * N) as f64 / best
}

/// Bytes a second that all threads together read from memory: the best of five sums over 1 GiB.
fn memory_bandwidth() -> f64 {
    let values = vec![1_u64; 1 << 27];
    let mut best = f64::INFINITY;
    for _ in 0..5 {
        let since = Instant::now();
        let sum: u64 = values.par_chunks(1 << 20).map(|chunk| chunk.iter().sum::<u64>()).sum();
        best = best.min(since.elapsed().as_secs_f64());
        assert_eq!(sum, 1 << 27);
    }
    size_of_val(&values[..]) as f64 / best
}

/// Visibilities of every pair below `length_m_max` over a window, as the ground places them.
fn placed(
    array: &Array,
    window: ObservingWindow,
    frequency_hz: f64,
    length_m_max: f64,
) -> Vec<PlacedVisibilities> {
    let rate = TAU / array.orbital_period_s();
    let wavelength_m = SPEED_OF_LIGHT_M_S / frequency_hz;
    let mut blocks = Vec::new();
    for pair in all_pairs(array.satellites()) {
        let mut block = PlacedVisibilities { frequency_hz, pair, ..PlacedVisibilities::default() };
        let mut t = window.start.seconds();
        while t < window.end.seconds() {
            let [r_i, r_j] = [pair.i, pair.j].map(|n| array.position_m(usize::from(n), t));
            let length_m = norm(sub(r_i, r_j));
            if length_m >= length_m_max {
                break;
            }
            block.time_s.push(t);
            block.r_i_m.push(r_i);
            block.r_j_m.push(r_j);
            block.value_k_sr.push(Complex64::new((0.1 * t).sin(), (0.1 * t).cos()));
            block.weight.push(1.0);
            t += (wavelength_m / (8.0 * length_m * rate)).min(25.0);
        }
        if !block.is_empty() {
            blocks.push(block);
        }
    }
    blocks
}

/// Accumulation, application and solution at the paper's 10 MHz, baselines up to 125 wavelengths.
fn engine(array: &Array, l_max: usize) {
    let frequency_hz = 1e7;
    let wavelength_m = SPEED_OF_LIGHT_M_S / frequency_hz;
    let baseline_m_max = 125.0 * wavelength_m;
    let year: Vec<_> = ObservingWindows::new(array, 0.0, 1.3 * 365.25 * 86_400.0).collect();
    let mut engine = HarmonicEngine::new(HarmonicSetup {
        l_max,
        frequency_hz,
        baseline_m_max,
        moon_radius_m: array.moon_radius_m(),
        response: AntennaResponse::Isotropic,
        orbit: NominalOrbit {
            inclination_rad: 30_f64.to_radians(),
            radius_m: array.orbit_radius_m(),
            limits: GeometryLimits::default(),
        },
        companion_seed: 1,
        // A thousand times that of the data, as for a thermal sky.
        weight_max: 1024.0,
    })
    .expect("settings in range");
    let memory = memory(l_max, 125.0, rayon::current_num_threads(), 2);
    println!(
        "engine l {l_max}: {:.2} GB of sums, {:.2} GB of tables",
        1e-9 * memory.sums as f64,
        1e-9 * memory.tables as f64
    );
    let chunks: Vec<Vec<PlacedVisibilities>> = year
        .chunks(year.len() / 20)
        .map(|windows| {
            windows
                .iter()
                .step_by(windows.len() / 12)
                .flat_map(|window| placed(array, *window, frequency_hz, baseline_m_max))
                .collect()
        })
        .collect();
    accumulate(&mut engine, &chunks);
    let clock = Clock::start();
    let sums = engine.into_sums();
    println!("  fold {:.2} s", clock.read().0);
    let clock = Clock::start();
    let right = sums.right_hand_side().to_vec();
    println!("  tables and right-hand side {:.2} s", clock.read().0);
    let y = products(&sums, &right);
    let clock = Clock::start();
    let factors = sums.order_blocks().factors(1e-3 * y[0].abs());
    println!("  preconditioner {:.2} s", clock.read().0);
    drop(factors);
}

/// Adds all blocks twice, and prints the rate of the second time.
fn accumulate(engine: &mut HarmonicEngine, chunks: &[Vec<PlacedVisibilities>]) {
    let (mut rates, mut count, mut processor) = (Vec::new(), 0, 0.0);
    // The first pass touches the memory for the first time; a mission is like the second.
    for pass in 0..2 {
        for blocks in chunks {
            let of_chunk: usize = blocks.iter().map(PlacedVisibilities::len).sum();
            let clock = Clock::start();
            for block in blocks {
                let _ = engine.add(block).expect("one frequency");
            }
            engine.flush();
            let run = clock.read();
            if pass > 0 {
                rates.push(of_chunk as f64 / run.0);
                processor += run.1;
                count += of_chunk;
            }
        }
    }
    rates.sort_by(f64::total_cmp);
    println!(
        "  accumulate {count}: {:.3e}/s (median of {}), {:.3e} per second of processor",
        rates[rates.len() / 2],
        rates.len(),
        count as f64 / processor
    );
}

/// Measures products with the matrix; the last of them.
fn products(sums: &HarmonicSums, right: &[f64]) -> Vec<f64> {
    let mut y = vec![0.0; right.len()];
    let (mut times, mut processor) = (Vec::new(), 0.0);
    for _ in 0..5 {
        let clock = Clock::start();
        sums.apply(right, &mut y);
        let run = clock.read();
        times.push(run.0);
        processor += run.1 / 5.0;
    }
    times.sort_by(f64::total_cmp);
    let flops = sums.matrix_product_flops();
    println!(
        "  apply {:.3} s (median of 5; {processor:.3} s of processor); its matrix products {:.2e} flop, {:.1} Gflop/s if they were all",
        times[2],
        flops,
        1e-9 * flops / times[2]
    );
    let mut ratios: Vec<f64> = (0..5)
        .map(|_| {
            let clock = Clock::start();
            sums.apply(right, &mut y);
            let one = clock.read().0;
            let clock = Clock::start();
            sums.apply_all(&[right, &y]);
            clock.read().0 / one
        })
        .collect();
    ratios.sort_by(f64::total_cmp);
    println!("  two vectors at once take {:.2} times as long as one (median of 5 pairs)", ratios[2]);
    let (products, bandwidth) = (matrix_product_flops(), memory_bandwidth());
    println!(
        "  {:.3} products a second; reading its {:.2} GB of weights at the measured {:.1} GB/s alone would take {:.0} % of that, its matrix \
         products at the measured {:.0} Gflop/s {:.0} %",
        1.0 / times[2],
        1e-9 * sums.weight_bytes() as f64,
        1e-9 * bandwidth,
        100.0 * sums.weight_bytes() as f64 / bandwidth / times[2],
        1e-9 * products,
        100.0 * flops / products / times[2]
    );
    y
}

fn main() {
    let array = Array::new(&ArrayConfig::default()).expect("the fiducial array");
    let day = 86_400.0;
    let windows: Vec<_> = ObservingWindows::new(&array, 0.0, 7.0 * day).collect();
    let wanted: Vec<String> = std::env::args().skip(1).filter(|a| !a.starts_with('-')).collect();
    let runs = |name: &str| wanted.is_empty() || wanted.iter().any(|w| name.contains(w.as_str()));
    for l_max in [64, 128, 160, 191] {
        if runs(&format!("engine-{l_max}")) {
            engine(&array, l_max);
        }
    }
    for (l_max, u_max) in [(64, 125.0), (191, 125.0), (1023, 21.0), (1024, 125.0)] {
        if runs(&format!("forward-{l_max}")) {
            for at_once in [4, 16, 41] {
                forward(&array, &windows, l_max, u_max, at_once);
            }
        }
    }
}
