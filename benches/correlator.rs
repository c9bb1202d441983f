//! Speed of the correlator's kernel, compared with the machine's peak and with matrix products of libraries.
//!
//! `cargo bench --bench correlator`. One thread. The candidates take turns in the same run, and the best of many short
//! rounds counts. Operations are those that the products need: 4 multiply-adds per pair, 2 per auto-correlation.
//! `LUNARRAY_PYTHON` names a Python with numpy; numpy and its BLAS then multiply the same blocks as complex64.
#![allow(clippy::unwrap_used)] // An interactive program.

use std::hint::black_box;
use std::time::Instant;

use faer::{Accum, MatMut, MatRef, Par};
use lunarray::frames::Samples;
use lunarray::mother::correlator::kernel::{LANES, Packed, SLICE, correlate, no_sums};
use num_complex::Complex32;
use pulp::{Arch, Simd, WithSimd};

const DAUGHTERS: usize = 8;
/// Samples per channel in a round.
const SAMPLES: usize = 1 << 10;
/// Multiply-adds that the products of one slice need: 4 per pair, 2 per auto-correlation.
const MULTIPLY_ADDS: usize = (DAUGHTERS * (DAUGHTERS - 1) / 2 * 4 + DAUGHTERS * 2) * SLICE * LANES;
/// Rounds, of which the best counts.
const ROUNDS: usize = 150;

/// Multiply-adds on registers only.
struct Peak(usize);

impl WithSimd for Peak {
    /// Number of multiply-adds, and a value that depends on all of them.
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

/// Pairwise multiply-adds of 16-bit integers into 32 bits, with the best instructions that the kernel could use: their
/// number, and a value that depends on all of them.
#[cfg(target_arch = "x86_64")]
fn integer_peak(arch: Arch, rounds: usize) -> Option<(usize, i32)> {
    use pulp::x86::V3;
    use std::arch::x86_64::__m256i;

    #[inline(always)]
    fn chains(simd: V3, rounds: usize) -> (usize, i32) {
        const CHAINS: usize = 12;
        let avx2 = simd.avx2;
        let a: __m256i = pulp::cast(black_box([3_i16; 16]));
        let mut sums: [__m256i; CHAINS] = [pulp::cast([1_i32; 8]); CHAINS];
        for k in 0..rounds {
            let a = avx2._mm256_xor_si256(a, pulp::cast([k as i32; 8]));
            for sum in &mut sums {
                *sum = avx2._mm256_add_epi32(*sum, avx2._mm256_madd_epi16(a, *sum));
            }
        }
        let total = sums.into_iter().flat_map(pulp::cast::<__m256i, [i32; 8]>).fold(0, i32::wrapping_add);
        (rounds * CHAINS * 16, total)
    }

    let simd = match arch {
        Arch::V3(simd) => simd,
        Arch::V4(simd) => *simd,
        _ => return None,
    };
    Some(simd.vectorize(
        #[inline(always)]
        || chains(simd, rounds),
    ))
}

#[cfg(not(target_arch = "x86_64"))]
fn integer_peak(_: Arch, _: usize) -> Option<(usize, i32)> {
    None
}

/// Measures the products of all channels' blocks, s: numpy's product and the rank-k update of BLAS.
const PYTHON: &str = r#"
import sys, time, glob, os, ctypes
import numpy
channels, daughters, samples, rounds = map(int, sys.argv[1:])
random = numpy.random.default_rng(1)
parts = random.integers(-128, 128, (2, channels, daughters, samples)) + numpy.float32(0.5)
x = (parts[0] + 1j * parts[1]).astype(numpy.complex64)
def best(work):
    times = []
    for _ in range(rounds):
        since = time.perf_counter()
        work()
        times.append(time.perf_counter() - since)
    return min(times)
print("numpy", best(lambda: x @ x.conj().swapaxes(1, 2)))
folder = os.path.join(os.path.dirname(numpy.__path__[0]), "numpy.libs")
for library in glob.glob(os.path.join(folder, "libscipy_openblas64_*")):
    blas = ctypes.CDLL(library)
    cherk = blas.scipy_cblas_cherk64_
    size, real, pointer = ctypes.c_int64, ctypes.c_float, ctypes.c_void_p
    cherk.argtypes = [ctypes.c_int] * 3 + [size, size, real, pointer, size, real, pointer, size]
    out = numpy.zeros((channels, daughters, daughters), numpy.complex64)
    # Rows, upper triangle, not transposed.
    def update():
        for block, product in zip(x, out):
            cherk(101, 121, 111, daughters, samples, 1.0, block.ctypes.data, samples, 0.0, product.ctypes.data, daughters)
    print("BLAS rank-k update", best(update))
    expected = numpy.triu(x[0] @ x[0].conj().T)
    assert abs(numpy.triu(out[0]) - expected).max() < 1e-3 * abs(expected).max()
"#;

/// Names of the peers, with their multiply-adds per second.
fn peers(threads: usize, operations: f64) -> Vec<(String, f64)> {
    let Some(python) = std::env::var_os("LUNARRAY_PYTHON") else {
        println!("skipped numpy and BLAS: LUNARRAY_PYTHON is not set");
        return Vec::new();
    };
    let mut command = std::process::Command::new(python);
    command.args(["-c", PYTHON]).args([LANES, DAUGHTERS, SAMPLES, ROUNDS].map(|n| n.to_string()));
    for variable in ["OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"] {
        command.env(variable, threads.to_string());
    }
    let text = String::from_utf8(command.output().unwrap().stdout).unwrap();
    let rate = |line: &str| {
        let (name, seconds) = line.rsplit_once(' ')?;
        Some((format!("{name}, {threads} thread(s)"), operations / seconds.parse::<f64>().ok()?))
    };
    text.lines().filter_map(rate).collect()
}

fn seconds(work: impl FnOnce()) -> f64 {
    let since = Instant::now();
    work();
    since.elapsed().as_secs_f64()
}

/// The data of a channel for the library: a matrix of daughters by samples.
fn matrix(blocks: &[Samples], lane: usize) -> Vec<Complex32> {
    let level = |code: i8| (f32::from(code) + 0.5) * 0.1;
    let mut matrix = vec![Complex32::ZERO; DAUGHTERS * SAMPLES];
    for daughter in 0..DAUGHTERS {
        let Samples::Codes { re, im, .. } = &blocks[lane * DAUGHTERS + daughter] else { continue };
        for k in 0..SAMPLES {
            matrix[k * DAUGHTERS + daughter] = Complex32::new(level(re[k]), level(im[k]));
        }
    }
    matrix
}

/// The library's products of `depth` samples each.
fn products(matrices: &[Vec<Complex32>], depth: usize) {
    let mut product = vec![Complex32::ZERO; DAUGHTERS * DAUGHTERS];
    for samples in matrices.iter().flat_map(|m| m.chunks_exact(DAUGHTERS * depth)) {
        let a = MatRef::from_column_major_slice(samples, DAUGHTERS, depth);
        let target = MatMut::from_column_major_slice_mut(&mut product, DAUGHTERS, DAUGHTERS);
        let one = Complex32::ONE;
        faer::linalg::matmul::matmul(target, Accum::Replace, a, a.adjoint(), one, Par::Seq);
    }
    black_box(&product);
}

fn main() {
    let arch = Arch::new();
    let codes = |seed: usize| (0..SAMPLES).map(|k| ((k * 31 + seed * 7919) % 251) as u8 as i8).collect();
    let blocks: Vec<Samples> = (0..DAUGHTERS * LANES)
        .map(|n| Samples::Codes { bits: 8, step: 0.1, re: codes(n), im: codes(n + 1000) })
        .collect();
    let matrices: Vec<Vec<Complex32>> = (0..LANES).map(|lane| matrix(&blocks, lane)).collect();
    let slices = SAMPLES / SLICE;
    let mut packed = Packed::new(DAUGHTERS);
    for daughter in 0..DAUGHTERS {
        packed.put_all(daughter, |lane| Some(&blocks[lane * DAUGHTERS + daughter]), 0);
    }
    let operations = (MULTIPLY_ADDS * slices) as f64;
    let [mut peak, mut float_peak, mut kernel, mut packing] = [0.0_f64; 4];
    let mut library = [0.0_f64; 3];
    // Samples per product of the library: a whole block, a dump, and a short one.
    let depths = [SAMPLES, 64, 16];
    for _ in 0..ROUNDS {
        let mut done = 0;
        let spent = seconds(|| done = black_box(arch.dispatch(Peak(20_000))).0);
        float_peak = float_peak.max(done as f64 / spent);
        let spent = seconds(|| done = black_box(integer_peak(arch, 20_000)).map_or(0, |(done, _)| done));
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
            let spent = seconds(|| products(&matrices, depth));
            *library = library.max(operations / spent);
        }
    }
    // Without pairwise integer instructions the kernel is a plain loop.
    let peak = if peak > 0.0 { peak } else { float_peak };
    println!("multiply-adds per second on one core, 8-bit codes");
    println!("peak of 16-bit pairs                  {peak:8.2e}  (of f32: {float_peak:8.2e})");
    println!(
        "kernel                                {kernel:8.2e}  {:5.1} % of the peak",
        100.0 * kernel / peak
    );
    println!(
        "kernel with unpacking                 {packing:8.2e}  {:5.1} % of the peak",
        100.0 * packing / peak
    );
    let compare = |name: &str, rate: f64| {
        println!(
            "{name:<38}{rate:8.2e}  the kernel is {:.2} times as fast, {:.2} with unpacking",
            kernel / rate,
            packing / rate
        );
    };
    for (library, depth) in library.into_iter().zip(depths) {
        compare(&format!("faer's product of {depth:5} samples"), library);
    }
    for threads in [1, 2] {
        for (name, rate) in peers(threads, operations) {
            compare(&name, rate);
        }
    }
    let samples = packing / operations * (SAMPLES * DAUGHTERS * LANES) as f64;
    println!("samples per second with unpacking     {samples:8.2e}");
}
