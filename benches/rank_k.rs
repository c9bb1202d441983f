//! Rate of accumulation, rows included, and its ratio to the machine's symmetric rank-k peak.
//!
//! `cargo bench --bench rank_k [-- NSIDE..]`
#![allow(clippy::unwrap_used)] // A program for people at a terminal.

use std::hint::black_box;
use std::time::Instant;

use faer::linalg::matmul::triangular;
use faer::linalg::matmul::triangular::BlockStructure::{Rectangular, TriangularLower};
use faer::{Accum, MatMut, MatRef, Par};
use lunarray::array::{Array, ArrayConfig};
use lunarray::frames::{AntennaResponse, PlacedVisibilities};
use lunarray::imaging::{MapConfig, NormalEngine, PixelEngine, PixelSetup};
use lunarray::response::pixel::PixelMethod;
use lunarray::sky::healpix::pixel_count;
use lunarray::units::Pair;
use num_complex::Complex64;

const FREQUENCY_HZ: f64 = 10e6;
/// Columns of the peak's product; more are not faster.
const COLUMNS: usize = 512;
/// Elements between columns beyond their length, so that none fall on the same cache sets.
const PADDING: usize = 16;

/// Floating-point operations of a symmetric update of `order` by `columns`, half of the full product's.
fn operations(order: usize, columns: usize) -> f64 {
    order as f64 * (order + 1) as f64 * columns as f64
}

/// Operations a second of the library's own update of one matrix by all threads, the best of some runs.
fn peak(order: usize, runs: usize) -> f64 {
    let stride = order + PADDING;
    let rows: Vec<f64> = (0..stride * COLUMNS).map(|k| (k % 1009) as f64 / 1009.0 - 0.5).collect();
    let mut matrix = vec![0.0_f64; stride * order];
    let a = MatRef::from_column_major_slice_with_stride(&rows, order, COLUMNS, stride);
    let mut least_s = f64::INFINITY;
    for _ in 0..runs {
        let start = Instant::now();
        let target = MatMut::from_column_major_slice_with_stride_mut(&mut matrix, order, order, stride);
        let (left, right) = (a, a.transpose());
        let par = Par::rayon(rayon::current_num_threads());
        triangular::matmul(
            target,
            TriangularLower,
            Accum::Add,
            left,
            Rectangular,
            right,
            Rectangular,
            1.0,
            par,
        );
        black_box(&mut matrix);
        least_s = least_s.min(start.elapsed().as_secs_f64());
    }
    operations(order, COLUMNS) / least_s
}

/// Visibilities of the shortest pair, which is within 2 b_p at nside 16 and 32, spread over four years.
fn visibilities(array: &Array, count: usize) -> PlacedVisibilities {
    let time_s: Vec<f64> = (0..count).map(|k| 3.1e3 * (k + 1) as f64).collect();
    PlacedVisibilities {
        frequency_hz: FREQUENCY_HZ,
        pair: Pair { i: 0, j: 1 },
        r_i_m: time_s.iter().map(|&t_s| array.position_m(0, t_s)).collect(),
        r_j_m: time_s.iter().map(|&t_s| array.position_m(1, t_s)).collect(),
        value_k_sr: vec![Complex64::new(1e5, -1e5); count],
        weight: vec![1e-9; count],
        time_s,
        ..PlacedVisibilities::default()
    }
}

fn main() {
    let asked: Vec<usize> = std::env::args().filter_map(|arg| arg.parse().ok()).collect();
    let nsides = if asked.is_empty() { vec![16, 32] } else { asked };
    let array = Array::new(&ArrayConfig::default()).unwrap();
    println!("symmetric rank-k updates in f64, {} threads", rayon::current_num_threads());
    for nside in nsides {
        let order = pixel_count(nside);
        // About 2e11 operations a run, whatever the size.
        let count = ((1e11 / operations(order, 1)) as usize).next_multiple_of(COLUMNS / 2);
        let runs = 5;
        let peak_per_s = peak(order, runs);
        println!("nside {nside}: peak {:.1} Gflop/s", peak_per_s / 1e9);
        let block = visibilities(&array, count);
        for method in [PixelMethod::Average, PixelMethod::Centre] {
            let mut engine = PixelEngine::new(PixelSetup {
                nside,
                frequency_hz: FREQUENCY_HZ,
                method,
                moon_radius_m: array.moon_radius_m(),
                response: AntennaResponse::Isotropic,
                companion_seed: 1,
                weight_max: 1e-6,
            })
            .unwrap();
            let longest_m = MapConfig { nside, ..MapConfig::default() }.baseline_m_max(FREQUENCY_HZ);
            assert!(longest_m > 450.0, "the pair of this benchmark is longer than {longest_m} m");
            let mut least_s = f64::INFINITY;
            for _ in 0..=runs {
                let start = Instant::now();
                assert_eq!(engine.add(&block).unwrap().visibilities, count as u64);
                least_s = least_s.min(start.elapsed().as_secs_f64());
            }
            let rate = operations(order, 2 * count) / least_s;
            println!(
                "  rows ({method:?}) and sums: {:.1} Gflop/s, {:.0} % of the peak, {:.0} visibilities/s",
                rate / 1e9,
                100.0 * rate / peak_per_s,
                count as f64 / least_s
            );
        }
    }
}
