//! Spherical harmonic transforms: rate, fraction of the machine's multiply-add peak, ratio to healpy's time.
//!
//! `cargo bench --bench harmonics [-- NSIDE..]`; healpy is timed too if `LUNARRAY_PYTHON` is set.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)] // A program for people at a terminal.

use std::hint::black_box;
use std::path::Path;
use std::process::Command;
use std::time::Instant;

use lunarray::sky::harmonics::{Alm, AnalysisOptions, Method, Transform};
use lunarray::sky::healpix::ring;
use num_complex::Complex64;
use pulp::{Arch, Simd, WithSimd};
use rayon::prelude::*;

/// Multiply-adds on independent registers, enough to hide their latency.
struct PeakLoop(usize);

impl WithSimd for PeakLoop {
    type Output = f64;

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) -> f64 {
        let factor = simd.splat_f64s(black_box(0.999));
        let mut sums = [simd.splat_f64s(black_box(1.0)); 12];
        for _ in 0..self.0 {
            for sum in &mut sums {
                *sum = simd.mul_add_e_f64s(*sum, factor, factor);
            }
        }
        sums.into_iter().map(|sum| simd.reduce_sum_f64s(sum)).sum::<f64>() * S::F64_LANES as f64
    }
}

struct LanesOf;

impl WithSimd for LanesOf {
    type Output = usize;

    fn with_simd<S: Simd>(self, _: S) -> usize {
        S::F64_LANES
    }
}

/// Multiply-adds a second of all threads.
fn peak() -> f64 {
    let (arch, turns) = (Arch::new(), 20_000_000);
    let threads = rayon::current_num_threads();
    let per_thread = (12 * turns * arch.dispatch(LanesOf)) as f64;
    let seconds = best(3, || {
        (0..threads).into_par_iter().for_each(|_| {
            black_box(arch.dispatch(PeakLoop(turns)));
        });
    });
    per_thread * threads as f64 / seconds
}

/// Least time of several runs, s.
fn best(runs: usize, mut run: impl FnMut()) -> f64 {
    let time = |_| {
        let start = Instant::now();
        run();
        start.elapsed().as_secs_f64()
    };
    (0..runs).map(time).fold(f64::INFINITY, f64::min)
}

/// Multiply-adds that a transform needs: six for each ring pair and two degrees, for the orders that reach the ring.
fn needed(nside: usize, l_max: usize) -> f64 {
    let of_ring = |k: usize| {
        let top = (l_max as f64 * ring(nside, k).sin_theta) as usize;
        (0..=top.min(l_max)).map(|m| 6 * ((l_max - m) / 2 + 1)).sum::<usize>() as f64
    };
    (1..=2 * nside).map(of_ring).sum()
}

/// Seconds that healpy takes for alm2map and for map2alm without iterations.
fn healpy(nside: usize, l_max: usize) -> Option<[f64; 2]> {
    let python = std::env::var_os("LUNARRAY_PYTHON")?;
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/python/sky_harmonics_time.py");
    let threads = rayon::current_num_threads().to_string();
    let output = Command::new(python)
        .arg(script)
        .args([nside.to_string(), l_max.to_string()])
        .env("OMP_NUM_THREADS", threads)
        .output()
        .expect("LUNARRAY_PYTHON runs");
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let text = String::from_utf8(output.stdout).unwrap();
    let seconds: Vec<f64> = text.split_whitespace().map(|word| word.parse().unwrap()).collect();
    Some([seconds[0], seconds[1]])
}

fn report(what: &str, seconds: f64, work: f64, peak: f64, healpy: Option<f64>) {
    let ratio =
        healpy.map_or("healpy not timed".into(), |other| format!("{:.2} x healpy's time", seconds / other));
    println!(
        "  {what:<28} {:>9.3} ms  {:>6.1} Gmul-add/s, {:>3.0} % of peak  {ratio}",
        seconds * 1e3,
        work / seconds * 1e-9,
        100.0 * work / seconds / peak
    );
}

fn main() {
    let chosen: Vec<usize> = std::env::args().filter_map(|argument| argument.parse().ok()).collect();
    let chosen = if chosen.is_empty() { vec![64, 128, 256] } else { chosen };
    let peak = peak();
    println!("{} threads, multiply-add peak {:.1} G/s", rayon::current_num_threads(), peak * 1e-9);
    for nside in chosen {
        let l_max = 3 * nside - 1;
        println!("nside {nside}, l_max {l_max}");
        let (work, other) = (needed(nside, l_max), healpy(nside, l_max));
        let alm = coefficients(l_max);
        let runs = (1024 / nside).clamp(2, 20);
        let made = best(runs, || {
            black_box(Transform::new(nside, l_max).unwrap());
        });
        println!("  {:<28} {:>9.3} ms", "tables", made * 1e3);
        let once = best(runs, || {
            black_box(Transform::new(nside, l_max).unwrap().synthesis(&alm).unwrap());
        });
        report("synthesis, tables included", once, work, peak, other.map(|other| other[0]));
        let transform = Transform::new(nside, l_max).unwrap();
        let mut map = transform.synthesis(&alm).unwrap();
        let seconds = best(runs, || map = transform.synthesis(black_box(&alm)).unwrap());
        report("synthesis", seconds, work, peak, other.map(|other| other[0]));
        transform.adjoint(&map).unwrap();
        let seconds = best(runs, || {
            black_box(transform.adjoint(black_box(&map)).unwrap());
        });
        report("adjoint (quadrature)", seconds, work, peak, other.map(|other| other[1]));

        least_squares(nside, 5 * nside / 2);
    }
}

/// Analysis of a map of white coefficients.
fn least_squares(nside: usize, l_max: usize) {
    let transform = Transform::new(nside, l_max).unwrap();
    let alm = coefficients(l_max);
    let map = transform.synthesis(&alm).unwrap();
    let start = Instant::now();
    let found = transform.analysis(&map, &AnalysisOptions { method: Method::ACCURATE }).unwrap();
    let seconds = start.elapsed().as_secs_f64();
    let squared = |values: &mut dyn Iterator<Item = Complex64>| values.map(|v| v.norm_sqr()).sum::<f64>();
    let wrong = squared(&mut found.alm.values().iter().zip(alm.values()).map(|(a, b)| a - b));
    let error = (wrong / squared(&mut alm.values().iter().copied())).sqrt();
    println!(
        "  {:<28} {:>9.3} ms  l_max {l_max}: {} iterations, relative error {error:.1e}",
        "least squares",
        seconds * 1e3,
        found.iterations
    );
}

/// Coefficients of order one.
fn coefficients(l_max: usize) -> Alm {
    let mut alm = Alm::zeros(l_max);
    for (k, value) in alm.values_mut().iter_mut().enumerate() {
        let imaginary = if k <= l_max { 0.0 } else { (k as f64 * 0.7).cos() };
        *value = Complex64::new((k as f64).sin(), imaginary);
    }
    alm
}
