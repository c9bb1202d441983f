//! Sums over degrees with SIMD over rings, the inner loops of the transforms.
//!
//! The two rings of a pair (a ring and its mirror image south of the equator) share the recurrence. Functions start at
//! (sin theta)^m, which may be far below the smallest f64. Each ring therefore carries a scale until its function has grown to
//! 2^-100; smaller terms are neglected.
#![expect(clippy::needless_range_loop, reason = "arrays of registers are walked in step")]

use std::ops::Range;

use pulp::{Simd, WithSimd};

use super::lanes::{RingLanes, SCALE_EXPONENT, power_of_two};
use super::recurrence::Order;

/// Magnitude below which functions, times their scale, are neglected.
const MAGNITUDE_MIN: f64 = power_of_two(-100);

/// Magnitude above which the scale of a function is raised: `MAGNITUDE_MIN` times 2^400.
const MAGNITUDE_MAX: f64 = power_of_two(300);
/// Number of steps between checks of the scales. A step multiplies by less than 2^16 for any l up to 8191.
const STEPS_BETWEEN_CHECKS: usize = 4;

/// Ring pairs are passed between stages in groups of this size.
pub(super) const GROUP: usize = 8;

/// Maximum order that is not negligible on a ring: beyond it all functions up to `l_max` are below 1e-30 or so
/// (libsharp's rule).
pub(super) fn order_max(l_max: usize, sin_theta: f64) -> usize {
    let l = l_max as f64;
    let order = l * sin_theta + (0.01 * l).max(100.0);
    (order as usize).min(l_max)
}

/// Sums over the degrees of one order on all rings.
///
/// `out` has four planes (north real, imaginary; south real, imaginary) of `stride` values each; rings on which the order is
/// negligible are not changed.
pub(super) struct SynthesisTask<'a> {
    pub order: &'a Order,
    pub l_max: usize,
    pub mixed: &'a [[f64; 4]],
    pub rings: &'a RingLanes,
    /// Lanes to process, in whole blocks.
    pub chunk: Range<usize>,
    pub out: &'a mut [f64],
    pub stride: usize,
}

/// Sums over rings for every function of the recurrence, the transpose of [`SynthesisTask`].
pub(super) struct AdjointTask<'a> {
    pub order: &'a Order,
    pub l_max: usize,
    pub rings: &'a RingLanes,
    /// Lanes to process, in whole blocks.
    pub chunk: Range<usize>,
    /// Even part (real, imaginary) and cos theta times odd part for groups of `GROUP` rings; group `g` is at
    /// `g * group_stride`.
    pub parts: &'a [f64],
    pub group_stride: usize,
    /// Work buffer for sums by SIMD lane.
    pub by_lane: &'a mut Vec<f64>,
    pub sums: &'a mut Vec<[f64; 4]>,
}

/// Consumes the functions of a block of rings.
trait FunctionSink<S: Simd, const U: usize> {
    fn take(&mut self, j: usize, q: &[S::f64s; U]);
}

struct RingBlock<S: Simd, const U: usize> {
    simd: S,
    x2: [S::f64s; U],
    below: [S::f64s; U],
    q: [S::f64s; U],
    scale: [S::f64s; U],
}

impl<S: Simd, const U: usize> RingBlock<S, U> {
    #[inline(always)]
    fn new(simd: S, order: &Order, rings: &RingLanes, at: usize) -> Self {
        let lanes = at..at + U * S::F64_LANES;
        let cos = load::<S, U>(&rings.cos[lanes.clone()]);
        let (low, high, high_scale) = rings.powers(order.m, lanes);
        let (low, high, scale) = (load::<S, U>(low), load::<S, U>(high), load::<S, U>(high_scale));
        let start = simd.splat_f64s(order.start);
        let zero = simd.splat_f64s(0.0);
        let (mut x2, mut q) = ([zero; U], [zero; U]);
        for u in 0..U {
            x2[u] = simd.mul_f64s(cos[u], cos[u]);
            q[u] = simd.mul_f64s(start, simd.mul_f64s(low[u], high[u]));
        }
        let mut block = Self { simd, x2, below: [zero; U], q, scale };
        // The product is at least 2^-800.
        block.scale_up(MAGNITUDE_MIN);
        block.scale_up(MAGNITUDE_MIN);
        block
    }

    /// Multiplies values below `limit` by 2^400 and lowers their scale.
    #[inline(always)]
    fn scale_up(&mut self, limit: f64) {
        let simd = self.simd;
        let factor = simd.splat_f64s(power_of_two(SCALE_EXPONENT));
        let (limit, one) = (simd.splat_f64s(limit), simd.splat_f64s(1.0));
        for u in 0..U {
            let small = simd.less_than_f64s(simd.abs_f64s(self.q[u]), limit);
            self.q[u] = simd.select_f64s(small, simd.mul_f64s(self.q[u], factor), self.q[u]);
            self.scale[u] = simd.select_f64s(small, simd.sub_f64s(self.scale[u], one), self.scale[u]);
        }
    }

    /// Divides values above `limit`, and their predecessors in the recurrence, by 2^400 and raises their scale.
    #[inline(always)]
    fn scale_down(&mut self, limit: f64) {
        let simd = self.simd;
        let factor = simd.splat_f64s(power_of_two(-SCALE_EXPONENT));
        let (limit, one) = (simd.splat_f64s(limit), simd.splat_f64s(1.0));
        for u in 0..U {
            let great = simd.greater_than_f64s(simd.abs_f64s(self.q[u]), limit);
            self.q[u] = simd.select_f64s(great, simd.mul_f64s(self.q[u], factor), self.q[u]);
            self.below[u] = simd.select_f64s(great, simd.mul_f64s(self.below[u], factor), self.below[u]);
            self.scale[u] = simd.select_f64s(great, simd.add_f64s(self.scale[u], one), self.scale[u]);
        }
    }

    #[inline(always)]
    fn scales(&self) -> (f64, f64) {
        let simd = self.simd;
        let (mut scale_min, mut scale_max) = (self.scale[0], self.scale[0]);
        for u in 1..U {
            scale_min = simd.min_f64s(scale_min, self.scale[u]);
            scale_max = simd.max_f64s(scale_max, self.scale[u]);
        }
        (simd.reduce_min_f64s(scale_min), simd.reduce_max_f64s(scale_max))
    }

    #[inline(always)]
    fn step(&mut self, step: [f64; 2]) {
        let next = self.next(step, &self.q, &self.below);
        self.below = self.q;
        self.q = next;
    }

    #[inline(always)]
    fn next(&self, [a, b]: [f64; 2], q: &[S::f64s; U], below: &[S::f64s; U]) -> [S::f64s; U] {
        let simd = self.simd;
        let (a, b) = (simd.splat_f64s(a), simd.splat_f64s(b));
        let mut next = *below;
        for u in 0..U {
            let factor = simd.mul_add_e_f64s(a, self.x2[u], b);
            next[u] = simd.mul_add_e_f64s(factor, q[u], below[u]);
        }
        next
    }

    /// Computes all functions and passes those that are not negligible to `sink`.
    #[inline(always)]
    fn run(mut self, steps: &[[f64; 2]], sink: &mut impl FunctionSink<S, U>) {
        let simd = self.simd;
        let zero = simd.splat_f64s(0.0);
        let mut j = 0;
        let (mut scale_min, mut scale_max) = self.scales();
        while scale_max < 0.0 && j + STEPS_BETWEEN_CHECKS <= steps.len() {
            for &step in &steps[j..j + STEPS_BETWEEN_CHECKS] {
                self.step(step);
            }
            j += STEPS_BETWEEN_CHECKS;
            self.scale_down(MAGNITUDE_MAX);
            (scale_min, scale_max) = self.scales();
        }
        while scale_min < 0.0 && j < steps.len() {
            for _ in 0..STEPS_BETWEEN_CHECKS.min(steps.len() - j) {
                let mut counting = self.q;
                for u in 0..U {
                    let counts = simd.greater_than_or_equal_f64s(self.scale[u], zero);
                    counting[u] = simd.select_f64s(counts, self.q[u], zero);
                }
                sink.take(j, &counting);
                self.step(steps[j]);
                j += 1;
            }
            self.scale_down(MAGNITUDE_MAX);
            scale_min = self.scales().0;
        }
        // Two steps per iteration, so that no values have to be copied.
        let (mut even, mut odd) = (self.q, self.below);
        let (pairs, rest) = steps[j..].as_chunks::<2>();
        for pair in pairs {
            sink.take(j, &even);
            odd = self.next(pair[0], &even, &odd);
            sink.take(j + 1, &odd);
            even = self.next(pair[1], &odd, &even);
            j += 2;
        }
        if !rest.is_empty() {
            sink.take(j, &even);
        }
    }
}

struct SumDegrees<'a, S: Simd, const U: usize> {
    simd: S,
    mixed: &'a [[f64; 4]],
    sums: [[S::f64s; U]; 4],
}

impl<S: Simd, const U: usize> FunctionSink<S, U> for SumDegrees<'_, S, U> {
    #[inline(always)]
    fn take(&mut self, j: usize, q: &[S::f64s; U]) {
        let simd = self.simd;
        let mixed = &self.mixed[j];
        for part in 0..4 {
            let coefficient = simd.splat_f64s(mixed[part]);
            for u in 0..U {
                self.sums[part][u] = simd.mul_add_e_f64s(coefficient, q[u], self.sums[part][u]);
            }
        }
    }
}

struct SumRings<'a, S: Simd, const U: usize> {
    simd: S,
    parts: [[S::f64s; U]; 4],
    /// The sums of rings that are equal modulo `GROUP`, on every processor.
    by_lane: &'a mut [S::f64s],
    /// Position of the block among the vectors of a group.
    first: usize,
}

impl<S: Simd, const U: usize> FunctionSink<S, U> for SumRings<'_, S, U> {
    #[inline(always)]
    fn take(&mut self, j: usize, q: &[S::f64s; U]) {
        let simd = self.simd;
        let vectors = GROUP / S::F64_LANES;
        let sums = &mut self.by_lane[j * 4 * vectors..][..4 * vectors];
        for part in 0..4 {
            for r in 0..vectors.min(U) {
                let at = if U >= vectors { r } else { (self.first + r) % vectors };
                let mut sum = sums[part * vectors + at];
                for u in (r..U).step_by(vectors) {
                    sum = simd.mul_add_e_f64s(self.parts[part][u], q[u], sum);
                }
                sums[part * vectors + at] = sum;
            }
        }
    }
}

#[inline(always)]
fn load<S: Simd, const U: usize>(values: &[f64]) -> [S::f64s; U] {
    let vectors = S::as_simd_f64s(values).0;
    std::array::from_fn(
        #[inline(always)]
        |u| vectors[u],
    )
}

impl SynthesisTask<'_> {
    #[inline(always)]
    fn run<S: Simd, const U: usize>(self, simd: S) {
        let width = U * S::F64_LANES;
        let planes = self.out;
        for at in self.chunk.clone().step_by(width) {
            if self.order.m > order_max(self.l_max, self.rings.sin[at + width - 1]) {
                continue;
            }
            let zero = simd.splat_f64s(0.0);
            let mut sink = SumDegrees { simd, mixed: self.mixed, sums: [[zero; U]; 4] };
            RingBlock::new(simd, self.order, self.rings, at).run(&self.order.steps, &mut sink);
            let cos = load::<S, U>(&self.rings.cos[at..at + width]);
            for part in 0..2 {
                for u in 0..U {
                    let (even, odd) = (sink.sums[part][u], simd.mul_f64s(cos[u], sink.sums[part + 2][u]));
                    let lane = at - self.chunk.start + u * S::F64_LANES;
                    let north = &mut planes[part * self.stride + lane..][..S::F64_LANES];
                    S::as_mut_simd_f64s(north).0[0] = simd.add_f64s(even, odd);
                    let south = &mut planes[(part + 2) * self.stride + lane..][..S::F64_LANES];
                    S::as_mut_simd_f64s(south).0[0] = simd.sub_f64s(even, odd);
                }
            }
        }
    }
}

impl AdjointTask<'_> {
    #[inline(always)]
    fn run<S: Simd, const U: usize>(self, simd: S) {
        let width = U * S::F64_LANES;
        let count = self.order.len();
        self.by_lane.clear();
        self.by_lane.resize(4 * GROUP * count, 0.0);
        let by_lane = S::as_mut_simd_f64s(self.by_lane.as_mut_slice()).0;
        for at in self.chunk.clone().step_by(width) {
            if self.order.m > order_max(self.l_max, self.rings.sin[at + width - 1]) {
                continue;
            }
            let zero = simd.splat_f64s(0.0);
            let mut parts = [[zero; U]; 4];
            for (part, vectors) in parts.iter_mut().enumerate() {
                for (u, vector) in vectors.iter_mut().enumerate() {
                    let lane = at - self.chunk.start + u * S::F64_LANES;
                    let group = lane / GROUP * self.group_stride + part * GROUP + lane % GROUP;
                    *vector = S::as_simd_f64s(&self.parts[group..group + S::F64_LANES]).0[0];
                }
            }
            let first = at / S::F64_LANES % (GROUP / S::F64_LANES);
            let mut sink = SumRings { simd, parts, by_lane: &mut *by_lane, first };
            RingBlock::new(simd, self.order, self.rings, at).run(&self.order.steps, &mut sink);
        }
        self.sums.clear();
        for parts in self.by_lane.as_chunks::<GROUP>().0.as_chunks::<4>().0 {
            self.sums.push(parts.map(|s| ((s[0] + s[4]) + (s[2] + s[6])) + ((s[1] + s[5]) + (s[3] + s[7]))));
        }
    }
}

impl WithSimd for SynthesisTask<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        // As many vectors as fit the registers with sums, functions and geometry (7 U).
        if S::REGISTER_COUNT >= 32 { self.run::<S, 4>(simd) } else { self.run::<S, 2>(simd) }
    }
}

impl WithSimd for AdjointTask<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        // AVX2 takes the parts from memory, and loads and stores sums half as often.
        if S::REGISTER_COUNT >= 32 || S::F64_LANES == 4 {
            self.run::<S, 4>(simd)
        } else {
            self.run::<S, 2>(simd)
        }
    }
}
