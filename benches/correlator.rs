//! The correlator's kernel against the machine's multiply-adds and against a library's matrix product.
//!
//! `cargo bench --bench correlator`. One thread. Everything is measured in turns in the same run, and the best
//! of some rounds is taken. Operations are those that the products ask for: 4 multiply-adds for a pair, 2 for
//! a daughter with itself.
#![allow(clippy::unwrap_used)] // A program for people at a terminal.

use std::hint::black_box;
use std::time::Instant;

use faer::{Accum, MatMut, MatRef, Par};
use lunarray::frames::Samples;
use lunarray::mother::correlator::kernel::{LANES, Packed, SLICE, correlate, no_sums};
use num_complex::Complex32;
use pulp::{Arch, Simd, WithSimd};

const DAUGHTERS: usize = 8;
/// Samples of one channel in a round.
const SAMPLES: usize = 1 << 14;

/// Multiply-adds that depend on nothing but registers.
struct Peak(usize);

impl WithSimd for Peak {
    /// Multiply-adds done, and a value that depends on all.
    type Output = (usize, f32);

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) -> (usize, f32) {
        const CHAINS: usize = 12;
        let (a, b) = (simd.splat_f32s(black_box(0.999)), simd.splat_f32s(black_box(1e-3)));
        let mut sums = [simd.splat_f32s(1.0); CHAINS];
        for _ in 0..self.0 {
            for sum in &mut sums {
                *sum = simd.mul_add_f32s(*sum, a, b);
            }
        }
        let total = sums.into_iter().map(|sum| simd.reduce_sum_f32s(sum)).sum();
        (self.0 * CHAINS * S::F32_LANES, total)
    }
}

fn seconds(work: impl FnOnce()) -> f64 {
    let since = Instant::now();
    work();
    since.elapsed().as_secs_f64()
}

fn main() {
    let arch = Arch::new();
    let codes = |seed: usize| (0..SAMPLES).map(|k| ((k * 31 + seed * 7919) % 251) as u8 as i8).collect();
    let blocks: Vec<Samples> = (0..DAUGHTERS * LANES)
        .map(|n| Samples::Codes { bits: 8, step: 0.1, re: codes(n), im: codes(n + 1000) })
        .collect();
    // The library's form of the same: a matrix of daughters by samples for each channel.
    let level = |code: i8| (f32::from(code) + 0.5) * 0.1;
    let matrix = |lane: usize| -> Vec<Complex32> {
        let mut matrix = vec![Complex32::ZERO; DAUGHTERS * SAMPLES];
        for daughter in 0..DAUGHTERS {
            let Samples::Codes { re, im, .. } = &blocks[lane * DAUGHTERS + daughter] else { continue };
            for k in 0..SAMPLES {
                matrix[k * DAUGHTERS + daughter] = Complex32::new(level(re[k]), level(im[k]));
            }
        }
        matrix
    };
    let matrices: Vec<Vec<Complex32>> = (0..LANES).map(matrix).collect();
    let slices = SAMPLES / SLICE;
    let mut packed = Packed::new(DAUGHTERS);
    for daughter in 0..DAUGHTERS {
        packed.put_all(daughter, |lane| Some(&blocks[lane * DAUGHTERS + daughter]), 0);
    }
    let operations = (Packed::multiply_adds(DAUGHTERS) * slices) as f64;
    let [mut peak, mut kernel, mut packing] = [0.0_f64; 3];
    let mut library = [0.0_f64; 3];
    // Samples between two results of the library: a whole block, a dump, and a short one.
    let depths = [SAMPLES, 64, 16];
    for _ in 0..15 {
        let mut done = 0;
        let spent = seconds(|| done = black_box(arch.dispatch(Peak(400_000))).0);
        peak = peak.max(done as f64 / spent);
        let mut sums = no_sums(DAUGHTERS);
        let spent = seconds(|| (0..slices).for_each(|_| correlate(arch, black_box(&packed), &mut sums)));
        black_box(&sums);
        kernel = kernel.max(operations / spent);
        let spent = seconds(|| {
            for slice in 0..slices {
                for daughter in 0..DAUGHTERS {
                    packed.put_all(
                        daughter,
                        |lane| Some(&blocks[lane * DAUGHTERS + daughter]),
                        slice * SLICE,
                    );
                }
                correlate(arch, &packed, &mut sums);
            }
        });
        packing = packing.max(operations / spent);
        for (library, depth) in library.iter_mut().zip(depths) {
            let mut product = vec![Complex32::ZERO; DAUGHTERS * DAUGHTERS];
            let spent = seconds(|| {
                for samples in matrices.iter().flat_map(|m| m.chunks_exact(DAUGHTERS * depth)) {
                    let a = MatRef::from_column_major_slice(samples, DAUGHTERS, depth);
                    let target = MatMut::from_column_major_slice_mut(&mut product, DAUGHTERS, DAUGHTERS);
                    let one = Complex32::ONE;
                    faer::linalg::matmul::matmul(target, Accum::Replace, a, a.adjoint(), one, Par::Seq);
                }
            });
            black_box(&product);
            *library = library.max(operations / spent);
        }
    }
    println!("multiply-adds a second of one core, f32");
    println!("peak                                  {:8.2e}", peak);
    println!(
        "kernel                                {:8.2e}  {:5.1} % of the peak",
        kernel,
        100.0 * kernel / peak
    );
    println!(
        "kernel with unpacking of 8 bits       {:8.2e}  {:5.1} % of the peak",
        packing,
        100.0 * packing / peak
    );
    for (library, depth) in library.into_iter().zip(depths) {
        println!(
            "library's product of {depth:5} samples   {library:8.2e}  the kernel is {:.2} times as fast, {:.2} with unpacking",
            kernel / library,
            packing / library
        );
    }
    let samples = packing / operations * (SAMPLES * DAUGHTERS * LANES) as f64;
    println!("samples a second with unpacking       {samples:8.2e}");
}
