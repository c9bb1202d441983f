//! Inner loops of products with B: sums over degrees and over orders, with one pair per SIMD lane.

use num_complex::Complex64;

use super::lanes::{LANES, Lanes, VALUES, Value};

/// Number of degrees whose products are added in f32; these sums are added in f64.
const DEGREES_PER_SUM: usize = 16;

/// Sums the products of rotated skies and patterns over l: for mu, and for -mu with the conjugate skies. Values of consecutive l are
/// `stride` apart.
#[multiversion::multiversion(targets("x86_64+avx512f+avx512dq+avx512vl", "x86_64+avx2+fma"))]
pub(super) fn products(re: &[Value], im: &[Value], stride: usize, pattern: &[Value]) -> [Lanes; 4] {
    let mut sums = [[0.0; LANES]; 4];
    let (re, im) = (re.chunks(DEGREES_PER_SUM * stride), im.chunks(DEGREES_PER_SUM * stride));
    for ((re, im), pattern) in re.zip(im).zip(pattern.chunks(DEGREES_PER_SUM * VALUES)) {
        let mut partial = [[0.0; LANES]; 4];
        for ((re, im), pattern) in re.chunks(stride).zip(im.chunks(stride)).zip(pattern.chunks_exact(VALUES))
        {
            let (re, im) = (&re[..LANES], &im[..LANES]);
            for k in 0..LANES {
                let [a, b, c, d] = [0, 1, 2, 3].map(|part| pattern[part * LANES + k]);
                partial[0][k] += re[k] * a - im[k] * b;
                partial[1][k] += re[k] * b + im[k] * a;
                partial[2][k] += re[k] * c + im[k] * d;
                partial[3][k] += re[k] * d - im[k] * c;
            }
        }
        for (sums, partial) in sums.iter_mut().zip(&partial) {
            sums.iter_mut().zip(partial).for_each(|(sum, partial)| *sum += f64::from(*partial));
        }
    }
    sums
}

/// The transpose of [`products`].
#[multiversion::multiversion(targets("x86_64+avx512f+avx512dq+avx512vl", "x86_64+avx2+fma"))]
pub(super) fn products_back(
    values: &[[Value; LANES]; 4],
    pattern: &[Value],
    re: &mut [Value],
    im: &mut [Value],
    stride: usize,
) {
    let parts = re.chunks_mut(stride).zip(im.chunks_mut(stride));
    for ((re, im), pattern) in parts.zip(pattern.chunks_exact(VALUES)) {
        let (re, im) = (&mut re[..LANES], &mut im[..LANES]);
        for k in 0..LANES {
            let [a, b, c, d] = [0, 1, 2, 3].map(|part| pattern[part * LANES + k]);
            let [plus_re, plus_im, minus_re, minus_im] = [0, 1, 2, 3].map(|part| values[part][k]);
            re[k] = a * plus_re + b * plus_im + c * minus_re + d * minus_im;
            im[k] = a * plus_im - b * plus_re + d * minus_re - c * minus_im;
        }
    }
}

/// Computes `sum_n exp(-i n angle) g_n`, n from 0; the length is a multiple of the lanes.
#[multiversion::multiversion(targets("x86_64+avx512f+avx512dq+avx512vl", "x86_64+avx2+fma"))]
pub(super) fn phase_sum(re: &[f64], im: &[f64], angle_rad: f64) -> Complex64 {
    // Horner's rule in each lane, from its last order down.
    let (sin, cos) = (-(LANES as f64) * angle_rad).sin_cos();
    let mut sums = [[0.0; LANES]; 2];
    for (re, im) in re.rchunks_exact(LANES).zip(im.rchunks_exact(LANES)) {
        for k in 0..LANES {
            let [a, b] = [sums[0][k], sums[1][k]];
            sums[0][k] = a * cos - b * sin + re[k];
            sums[1][k] = a * sin + b * cos + im[k];
        }
    }
    (0..LANES).map(|k| Complex64::new(sums[0][k], sums[1][k]) * Complex64::cis(-(k as f64) * angle_rad)).sum()
}

/// Writes `exp(i n angle) first`, n from 0; the length is a multiple of the lanes.
#[multiversion::multiversion(targets("x86_64+avx512f+avx512dq+avx512vl", "x86_64+avx2+fma"))]
pub(super) fn phase_terms(first: Complex64, angle_rad: f64, re: &mut [f64], im: &mut [f64]) {
    let (sin, cos) = (LANES as f64 * angle_rad).sin_cos();
    let start: [Complex64; LANES] = std::array::from_fn(|k| first * Complex64::cis(k as f64 * angle_rad));
    let mut term = [start.map(|z| z.re), start.map(|z| z.im)];
    for (re, im) in re.chunks_exact_mut(LANES).zip(im.chunks_exact_mut(LANES)) {
        for k in 0..LANES {
            let [a, b] = [term[0][k], term[1][k]];
            (re[k], im[k]) = (a, b);
            term[0][k] = a * cos - b * sin;
            term[1][k] = a * sin + b * cos;
        }
    }
}
