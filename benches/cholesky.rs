//! Rate of the factorisation by tiles, and its ratio to the library's own of a full matrix.
//!
//! `cargo bench --bench cholesky [-- NSIDE..]`
#![allow(clippy::unwrap_used)] // A program for people at a terminal.

use std::hint::black_box;
use std::time::Instant;

use faer::dyn_stack::{MemBuffer, MemStack};
use faer::linalg::cholesky::llt::factor::{cholesky_in_place, cholesky_in_place_scratch};
use faer::{MatMut, Par};
use lunarray::array::{Array, ArrayConfig};
use lunarray::frames::{AntennaResponse, PlacedVisibilities};
use lunarray::imaging::Cholesky;
use lunarray::imaging::{NormalEngine, PixelEngine, PixelSetup, SymmetricTiles};
use lunarray::response::pixel::PixelMethod;
use lunarray::units::Pair;
use num_complex::Complex64;

/// Elements between columns beyond their length, so that none fall on the same cache sets.
const PADDING: usize = 16;

/// The regularised normal matrix of some visibilities.
fn normal_matrix(nside: usize) -> SymmetricTiles {
    const FREQUENCY_HZ: f64 = 10e6;
    let array = Array::new(&ArrayConfig::default()).unwrap();
    let mut engine = PixelEngine::new(PixelSetup {
        nside,
        frequency_hz: FREQUENCY_HZ,
        method: PixelMethod::Average,
        moon_radius_m: array.moon_radius_m(),
        response: AntennaResponse::Isotropic,
        companion_seed: 1,
        weight_max: 1e-6,
    })
    .unwrap();
    let time_s: Vec<f64> = (0..512).map(|k| 3.1e4 * f64::from(k)).collect();
    let count = time_s.len();
    let added = engine.add(&PlacedVisibilities {
        frequency_hz: FREQUENCY_HZ,
        pair: Pair { i: 0, j: 1 },
        r_i_m: time_s.iter().map(|&t_s| array.position_m(0, t_s)).collect(),
        r_j_m: time_s.iter().map(|&t_s| array.position_m(1, t_s)).collect(),
        value_k_sr: vec![Complex64::new(1e5, -1e5); count],
        weight: vec![1e-9; count],
        time_s,
        ..PlacedVisibilities::default()
    });
    assert_eq!(added.unwrap().visibilities, count as u64);
    let mut matrix = engine.into_sums().normal;
    let greatest = matrix.diagonal().into_iter().fold(0.0, f64::max);
    matrix.add_to_diagonal(1e-2 * greatest);
    matrix
}

/// Least seconds of some runs of the work, its preparation left out.
fn best<T>(runs: usize, mut prepare: impl FnMut() -> T, mut run: impl FnMut(T)) -> f64 {
    let mut least_s = f64::INFINITY;
    for _ in 0..runs {
        let prepared = prepare();
        let start = Instant::now();
        run(prepared);
        least_s = least_s.min(start.elapsed().as_secs_f64());
    }
    least_s
}

/// The library's factorisation of a full matrix with padded columns by all threads.
fn library(order: usize, mut matrix: Vec<f64>) {
    let par = Par::rayon(rayon::current_num_threads());
    let target = MatMut::from_column_major_slice_with_stride_mut(&mut matrix, order, order, order + PADDING);
    let mut memory = MemBuffer::new(cholesky_in_place_scratch::<f64>(order, par, Default::default()));
    cholesky_in_place(target, Default::default(), par, MemStack::new(&mut memory), Default::default())
        .unwrap();
    black_box(&matrix);
}

fn main() {
    let asked: Vec<usize> = std::env::args().filter_map(|arg| arg.parse().ok()).collect();
    let nsides = if asked.is_empty() { vec![8, 16] } else { asked };
    println!("Cholesky factorisation in f64, {} threads", rayon::current_num_threads());
    for nside in nsides {
        let matrix = normal_matrix(nside);
        let order = matrix.order();
        let operations = (order as f64).powi(3) / 3.0;
        let mut full = vec![0.0; (order + PADDING) * order];
        for (column, values) in full.chunks_exact_mut(order + PADDING).enumerate() {
            for (row, value) in values[..order].iter_mut().enumerate() {
                *value = matrix.get(row, column);
            }
        }
        let by_tiles = |matrix| {
            black_box(Cholesky::new(matrix).unwrap());
        };
        let ours = operations / best(7, || matrix.clone(), by_tiles);
        let peer = operations / best(7, || full.clone(), |matrix| library(order, matrix));
        println!(
            "nside {nside}, order {order}: by tiles {:.1} Gflop/s, library {:.1} Gflop/s, ratio {:.2}",
            ours / 1e9,
            peer / 1e9,
            ours / peer
        );
    }
}
