//! Sums of parts of vectors, with the same bits for any order of the parts and any distribution among ranks.
//!
//! All parts are rounded to multiples of one power of two, which depends on their largest element, and the multiples are
//! added as integers. The largest element keeps 51 bits, so that relative to it a sum is as accurate as in f64.

use super::rounding::{BIAS, above_bias};
use crate::ranks::Ranks;

/// Bits of the largest multiple, which rounding by [`BIAS`] leaves.
const MULTIPLE_BITS: i64 = 51;
/// Bits that remain for the number of parts.
const PARTS_BITS: i64 = 11;
/// Minimum exponent of the quantum, so that its inverse is finite.
const EXPONENT_MIN: i64 = -1000;

/// Sums the parts of all ranks, vectors of length `len`; NaN if any element is not finite. Each rank passes its own parts; together there are
/// at most `parts_max`.
pub(in crate::imaging) fn sum_of_parts(
    ranks: &Ranks,
    parts: &[impl AsRef<[f64]>],
    len: usize,
    parts_max: usize,
) -> Vec<f64> {
    let sizes = parts.iter().flat_map(AsRef::as_ref).map(|x| x.abs().to_bits());
    // Non-negative floats are ordered as their bits.
    let mut largest = [sizes.max().unwrap_or(0).cast_signed()];
    ranks.max(&mut largest);
    let largest = f64::from_bits(largest[0].cast_unsigned());
    let Some(exponent) = quantum_exponent(largest, parts_max) else { return vec![f64::NAN; len] };
    let (quantum, inverse) = (power_of_two(exponent), power_of_two(-exponent));
    let mut sums = vec![0_i64; len];
    for part in parts {
        for (sum, x) in sums.iter_mut().zip(part.as_ref()) {
            *sum = sum.wrapping_add(above_bias(x * inverse + BIAS));
        }
    }
    ranks.sum(&mut sums);
    sums.into_iter().map(|sum| sum as f64 * quantum).collect()
}

/// The exponent of the quantum for parts with this largest element; `None` if it is not finite.
fn quantum_exponent(largest: f64, parts_max: usize) -> Option<i64> {
    // The largest element is below 2 to this power.
    let exponent = (largest.to_bits() >> 52) as i64 - 1022;
    let parts_bits = i64::from(parts_max.next_power_of_two().trailing_zeros());
    let quantum = exponent - MULTIPLE_BITS + (parts_bits - PARTS_BITS).max(0);
    largest.is_finite().then_some(quantum.max(EXPONENT_MIN))
}

/// The power of 2 with an exponent from -1022 to 1023.
fn power_of_two(exponent: i64) -> f64 {
    f64::from_bits(((exponent + 1023) as u64) << 52)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ranks::on_threads;

    /// Parts with elements of very different magnitudes.
    fn parts(count: usize, len: usize) -> Vec<Vec<f64>> {
        let mut word = 1_u64;
        let mut number = || {
            word = word.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
            let exponent = (word >> 60) as i32 - 8;
            ((word >> 20) as f64 / 2_f64.powi(43) - 1.0) * 10_f64.powi(exponent)
        };
        (0..count).map(|_| (0..len).map(|_| number()).collect()).collect()
    }

    fn bits(values: &[f64]) -> Vec<u64> {
        values.iter().map(|x| x.to_bits()).collect()
    }

    #[test]
    fn sums_do_not_depend_on_the_order_of_parts() {
        let mut parts = parts(90, 40);
        let forward = sum_of_parts(&Ranks::single(), &parts, 40, 90);
        parts.reverse();
        let reverse = sum_of_parts(&Ranks::single(), &parts, 40, 90);
        assert_eq!(bits(&forward), bits(&reverse));
        for count in 1..4 {
            let shared = on_threads(count, |ranks| {
                let own: Vec<_> =
                    (0..90).filter(|k| ranks.share().holds(*k)).map(|k| parts[k].clone()).collect();
                sum_of_parts(ranks, &own, 40, 90)
            });
            assert!(shared.iter().all(|sum| bits(sum) == bits(&forward)), "{count} ranks");
        }
        // Half a quantum for each part, for numbers below 10^8.
        let tolerance = 90.0 * 0.5 * 1.35e8 / 2_f64.powi(51);
        for (k, sum) in forward.iter().enumerate() {
            let plain: f64 = parts.iter().map(|part| part[k]).sum();
            assert!((sum - plain).abs() < tolerance, "{sum:e} {plain:e}");
        }
    }

    #[test]
    fn sums_have_room_for_all_parts() {
        for (count, value) in [(2048, f64::MAX / 4096.0), (5000, -1.0), (3, 1e-300), (1, 0.0)] {
            let sum = sum_of_parts(&Ranks::single(), &vec![vec![value]; count], 1, count);
            let expected = value * count as f64;
            // 1e-300 is about 2^-996, some four and a half of the smallest quanta.
            assert!((sum[0] - expected).abs() <= 0.2 * expected.abs(), "{count} {value:e}: {}", sum[0]);
        }
        assert_eq!(sum_of_parts(&Ranks::single(), &[] as &[&[f64]], 2, 1), [0.0, 0.0]);
        for bad in [f64::NAN, f64::INFINITY] {
            assert!(
                sum_of_parts(&Ranks::single(), &[vec![1.0, bad], vec![1.0, 1.0]], 2, 2)
                    .iter()
                    .all(|x| x.is_nan())
            );
        }
    }
}
