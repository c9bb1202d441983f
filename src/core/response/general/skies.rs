//! Rotation of skies into the frames of many nodes, and its transpose.

use num_complex::Complex64;

use super::lanes::{LANES, Value};
use super::plan::RowNode;
use super::turns::{QuarterTurns, order_index};
use crate::numerics::trigonometry::sin_cos;
use crate::response::harmonic::degree_count;
use crate::sky::harmonics::Alm;

/// Skies rotated into frames, by mu: real and imaginary parts of `t_{l mu}`, `[l = mu, mu + 2, ..][sky][lane]`.
pub(super) type RotatedSkies = Vec<[Vec<Value>; 2]>;

/// Resizes rotated skies to this number of columns (skies times lanes), without clearing old values.
pub(super) fn resize_buffers(rotated: &mut RotatedSkies, l_max: usize, columns: usize) {
    rotated.resize_with(l_max + 1, Default::default);
    for (mu, parts) in rotated.iter_mut().enumerate() {
        parts.iter_mut().for_each(|part| part.resize(degree_count(l_max, mu) * columns, 0.0));
    }
}

/// Number of nodes of a batch, padded to whole vectors.
pub(super) fn padded_count(nodes: &[RowNode]) -> usize {
    nodes.len().next_multiple_of(LANES)
}

/// Work buffers for rotations.
#[derive(Clone, Debug, Default)]
pub(super) struct RotationBuffers {
    phases: Phases,
    /// Real and imaginary parts of one degree before or after both quarter turns.
    sky: [Vec<Value>; 2],
    /// Real and imaginary parts of one degree between the quarter turns.
    half: [Vec<Value>; 2],
}

impl RotationBuffers {
    fn prepare(&mut self, nodes: &[RowNode], l_max: usize, columns: usize) {
        self.phases.fill(nodes, l_max);
        let parts = self.sky.iter_mut().chain(&mut self.half);
        parts.for_each(|part| part.resize(columns * (l_max + 1), 0.0));
    }
}

impl QuarterTurns {
    /// Rotates skies into the frames of nodes.
    pub(super) fn rotate_skies(
        &self,
        nodes: &[RowNode],
        skies: &[Alm],
        buffers: &mut RotationBuffers,
        out: &mut RotatedSkies,
    ) {
        let (l_max, lanes) = (self.l_max(), padded_count(nodes));
        let columns = lanes * skies.len();
        resize_buffers(out, l_max, columns);
        buffers.prepare(nodes, l_max, columns);
        let RotationBuffers { phases, sky, half } = buffers;
        for l in 0..=l_max {
            let [mut sky, half] =
                [&mut *sky, &mut *half].map(|both| both.each_mut().map(|x| &mut x[..columns * (l + 1)]));
            for m in 0..=l {
                for (k, alm) in skies.iter().enumerate() {
                    let at = order_index(l, m) * columns + k * lanes;
                    let [re, im] = sky.each_mut().map(|part| &mut part[at..at + lanes]);
                    let z = alm.get(l, m).conj();
                    re.fill(z.re as Value);
                    im.fill(z.im as Value);
                    apply_phases(re, im, phases.get(0, m), -1.0);
                }
            }
            let [re, im] = half;
            self.rotate(l, &[0, 1], [&*sky[0], &*sky[1]], [&mut *re, &mut *im]);
            for k in 0..=l {
                let at = order_index(l, k) * columns;
                apply_phases_to_order([&mut *re, &mut *im], at, columns, phases.get(1, k), -1.0);
            }
            let [to_re, to_im] = sky;
            self.rotate(l, &[l % 2], [&*re, &*im], [&mut *to_re, &mut *to_im]);
            for mu in (l % 2..=l).step_by(2) {
                let (from, to) = (order_index(l, mu) * columns, (l - mu) / 2 * columns);
                let [re, im] = &mut out[mu];
                re[to..to + columns].copy_from_slice(&to_re[from..from + columns]);
                im[to..to + columns].copy_from_slice(&to_im[from..from + columns]);
                apply_phases_to_order([&mut *re, &mut *im], to, columns, phases.get(2, mu), -1.0);
            }
        }
    }

    /// Adds the transpose of [`Self::rotate_skies`] to `out`.
    pub(super) fn rotate_skies_transposed(
        &self,
        nodes: &[RowNode],
        rotated: &RotatedSkies,
        buffers: &mut RotationBuffers,
        out: &mut [Alm],
    ) {
        let (l_max, lanes) = (self.l_max(), padded_count(nodes));
        let columns = lanes * out.len();
        buffers.prepare(nodes, l_max, columns);
        let RotationBuffers { phases, sky, half } = buffers;
        for l in 0..=l_max {
            let [[sky_re, sky_im], [re, im]] =
                [&mut *sky, &mut *half].map(|both| both.each_mut().map(|x| &mut x[..columns * (l + 1)]));
            for mu in (l % 2..=l).step_by(2) {
                let (from, to) = ((l - mu) / 2 * columns, order_index(l, mu) * columns);
                sky_re[to..to + columns].copy_from_slice(&rotated[mu][0][from..from + columns]);
                sky_im[to..to + columns].copy_from_slice(&rotated[mu][1][from..from + columns]);
                apply_phases_to_order([&mut *sky_re, &mut *sky_im], to, columns, phases.get(2, mu), 1.0);
            }
            self.rotate_transposed(l, &[l % 2], [&*sky_re, &*sky_im], [&mut *re, &mut *im]);
            for k in 0..=l {
                let at = order_index(l, k) * columns;
                apply_phases_to_order([&mut *re, &mut *im], at, columns, phases.get(1, k), 1.0);
            }
            self.rotate_transposed(l, &[0, 1], [&*re, &*im], [&mut *sky_re, &mut *sky_im]);
            for m in 0..=l {
                for (k, out) in out.iter_mut().enumerate() {
                    let at = order_index(l, m) * columns + k * lanes;
                    let [re, im] = [&mut sky_re[at..at + lanes], &mut sky_im[at..at + lanes]];
                    apply_phases(re, im, phases.get(0, m), 1.0);
                    // z = conj(T) conj(phase): the gradient is conj(z' phase).
                    let sum = |part: &[Value]| part.iter().map(|x| f64::from(*x)).sum::<f64>();
                    *out.get_mut(l, m) += Complex64::new(sum(re), -sum(im));
                }
            }
        }
    }
}

/// Multiplies the values of one order, `[sky][lane]` from index `at`, by the phases of the lanes.
fn apply_phases_to_order(
    [re, im]: [&mut [Value]; 2],
    at: usize,
    columns: usize,
    [cos, sin]: [&[Value]; 2],
    sign: Value,
) {
    let (re, im) = (&mut re[at..at + columns], &mut im[at..at + columns]);
    for (re, im) in re.chunks_exact_mut(cos.len()).zip(im.chunks_exact_mut(cos.len())) {
        apply_phases(re, im, [cos, sin], sign);
    }
}

/// Multiplies values by phases, conjugated if `sign` is -1.
#[multiversion::multiversion(targets("x86_64+avx512f+avx512dq+avx512vl", "x86_64+avx2+fma"))]
fn apply_phases(re: &mut [Value], im: &mut [Value], [cos, sin]: [&[Value]; 2], sign: Value) {
    for (((re, im), cos), sin) in re.iter_mut().zip(im).zip(cos).zip(sin) {
        let sin = sign * sin;
        (*re, *im) = (*re * cos - *im * sin, *re * sin + *im * cos);
    }
}

/// Cosines and sines of multiples of the nodes' rotation angles; the last node pads the last vector.
#[derive(Clone, Debug, Default)]
struct Phases {
    stride: usize,
    lanes: usize,
    cos: Vec<Value>,
    sin: Vec<Value>,
}

impl Phases {
    fn fill(&mut self, nodes: &[RowNode], l_max: usize) {
        (self.stride, self.lanes) = (l_max + 1, padded_count(nodes));
        self.cos.clear();
        self.sin.clear();
        for turn in 0..3 {
            for k in 0..self.stride {
                let filled = nodes.iter().chain(nodes.last().into_iter().cycle()).take(self.lanes);
                for (s, c) in filled.map(|node| sin_cos(k as f64 * node.turns_rad[turn])) {
                    self.cos.push(c as Value);
                    self.sin.push(s as Value);
                }
            }
        }
    }

    /// Returns the cosines and sines of one rotation angle and order, by lane.
    fn get(&self, turn: usize, k: usize) -> [&[Value]; 2] {
        let first = (turn * self.stride + k) * self.lanes;
        [&self.cos[first..first + self.lanes], &self.sin[first..first + self.lanes]]
    }
}
