//! Products with the weights along gamma, the innermost loops of a matrix product.

use num_complex::Complex32;

use super::grid::NODES;

/// Maximum number of terms of one node's product: with itself, the nodes above and the nodes below.
const TERMS_MAX: usize = 2 * NODES - 1;

/// Computes `line = sum_d W_d z_{+d} + sum_{d > 0} W'_d z_{-d}`. W is `rows[0]`, which couples this node to those above;
/// `W'_d` is diagonal d of `rows[d]`, which couples the node d below to this one.
pub(super) fn multiply_line<'a>(
    line: &mut [Complex32],
    rows: &[Option<&'a [f32]>; NODES],
    stride: usize,
    z: impl Fn(isize) -> &'a [Complex32],
) {
    let mut terms: [(&[f32], &[Complex32]); TERMS_MAX] = [(&[], &[]); TERMS_MAX];
    let mut count = 0;
    let points = line.len();
    for d in 0..NODES {
        if let Some(weights) = rows[0] {
            terms[count] = (&weights[d * stride..d * stride + points], z(d as isize));
            count += 1;
        }
        if d > 0
            && let Some(below) = rows[d]
        {
            terms[count] = (&below[d * stride..d * stride + points], z(-(d as isize)));
            count += 1;
        }
    }
    sum_products(line, &terms[..count]);
}

/// Points that are summed over all terms in vector registers.
const CHUNK: usize = 16;

#[multiversion::multiversion(targets("x86_64+avx512f+avx512vl+fma", "x86_64+avx2+fma"))]
fn sum_products(line: &mut [Complex32], terms: &[(&[f32], &[Complex32])]) {
    let (chunks, rest) = line.as_chunks_mut::<CHUNK>();
    let tail = chunks.len() * CHUNK;
    for (k, out) in chunks.iter_mut().enumerate() {
        let mut sums = [Complex32::ZERO; CHUNK];
        for (weights, z) in terms {
            let (Some(weights), Some(z)) =
                (weights.as_chunks::<CHUNK>().0.get(k), z.as_chunks::<CHUNK>().0.get(k))
            else {
                continue;
            };
            for ((sum, w), z) in sums.iter_mut().zip(weights).zip(z) {
                sum.re += w * z.re;
                sum.im += w * z.im;
            }
        }
        *out = sums;
    }
    for (k, out) in rest.iter_mut().enumerate() {
        *out = terms.iter().map(|(weights, z)| z[tail + k] * weights[tail + k]).sum();
    }
}
