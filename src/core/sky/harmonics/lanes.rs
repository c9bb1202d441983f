//! Rings as SIMD lanes: their geometry, and the powers of sin theta from which recurrences start.

use crate::sky::healpix::ring;

/// Exponent of the factor 2^`SCALE_EXPONENT` that one unit of scale represents.
pub(super) const SCALE_EXPONENT: i32 = 400;

/// Maximum number of ring pairs in a block; tables of rings are padded to a multiple of it.
pub(super) const BLOCK_MAX: usize = 32;

/// Number of low powers; each power is a product of one of the first `LOW` and one of every `LOW`-th.
const LOW: usize = 32;

/// Rings 1 .. 2 nside, from the north pole to the equator, one per lane, padded to whole blocks.
pub(super) struct RingLanes {
    /// Number of lanes including padding.
    pub len: usize,
    pub cos: Vec<f64>,
    pub sin: Vec<f64>,
    /// sin^k for k < `LOW`, `len` values each.
    low: Vec<f64>,
    /// sin^(`LOW` k), `len` values each, to be multiplied by 2^400 to the power of the scale.
    high: Vec<f64>,
    high_scale: Vec<f64>,
}

impl RingLanes {
    pub(super) fn new(nside: usize, l_max: usize) -> Self {
        let len = (2 * nside).next_multiple_of(BLOCK_MAX);
        let mut cos = Vec::with_capacity(len);
        let mut sin = Vec::with_capacity(len);
        for k in 1..=2 * nside {
            let ring = ring(nside, k);
            cos.push(ring.z);
            sin.push(ring.sin_theta);
        }
        cos.resize(len, 0.0);
        sin.resize(len, 1.0);

        let mut low = vec![1.0; len];
        for _ in 1..LOW {
            let last = low.len() - len;
            low.extend_from_within(last..);
            multiply(&mut low[last + len..], &sin);
        }
        // sin^LOW; at most (4e4)^-32 = 2^-489 for nside 8192.
        let mut step = low[low.len() - len..].to_vec();
        multiply(&mut step, &sin);
        let mut high = vec![1.0; len];
        let mut high_scale = vec![0.0; len];
        for _ in 0..l_max / LOW {
            let last = high.len() - len;
            high.extend_from_within(last..);
            high_scale.extend_from_within(last..);
            let (values, scales) = (&mut high[last + len..], &mut high_scale[last + len..]);
            multiply(values, &step);
            for (value, scale) in values.iter_mut().zip(scales) {
                while *value < power_of_two(-300) {
                    *value *= power_of_two(SCALE_EXPONENT);
                    *scale -= 1.0;
                }
            }
        }
        Self { len, cos, sin, low, high, high_scale }
    }

    /// Returns two factors of sin^m for `lanes`, and the scale of the second.
    #[inline(always)]
    pub(super) fn powers(&self, m: usize, lanes: std::ops::Range<usize>) -> (&[f64], &[f64], &[f64]) {
        let (low, high) = (m % LOW * self.len, m / LOW * self.len);
        let of = |plane: usize| plane + lanes.start..plane + lanes.end;
        (&self.low[of(low)], &self.high[of(high)], &self.high_scale[of(high)])
    }
}

pub(super) const fn power_of_two(exponent: i32) -> f64 {
    f64::from_bits(((1023 + exponent) as u64) << 52)
}

fn multiply(values: &mut [f64], by: &[f64]) {
    for (value, by) in values.iter_mut().zip(by) {
        *value *= by;
    }
}
