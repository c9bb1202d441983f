//! Products of all pairs of daughters, 16 channels at a time: the hot loop of the mission.
//!
//! Codes are multiplied as integers (`integers.rs`), which is twice as fast; floats are multiplied here. A lane of a
//! register is a channel, so nothing is ever summed across lanes. Samples are packed in slices of `SLICE` that stay in
//! the first-level cache, and each tile of two daughters by two keeps its sums in registers.

use multiversion::multiversion;
use pulp::{Arch, Simd, WithSimd};

use super::integers::{Codes, Levels};
pub use super::lanes::{LANES, ProductSums, SLICE, product};
use crate::frames::Samples;

/// Planes per group: real and imaginary parts of two daughters.
const PLANES: usize = 4;

/// A slice of samples of all daughters in the kernel's order: by sample, daughter, part, channel.
#[derive(Clone, Debug)]
pub struct Packed {
    arch: Arch,
    /// Groups of two daughters.
    groups: usize,
    /// Values of all samples, filled once any of them is a float.
    data: Vec<f32>,
    levels: Levels,
    /// The latest codes of each daughter, from which values can be computed.
    codes: Vec<Codes>,
    quantised: bool,
}

impl Packed {
    /// Memory for `daughters`, filled with zeros.
    #[must_use]
    pub fn new(daughters: usize) -> Self {
        let groups = daughters.div_ceil(2);
        Self {
            arch: Arch::new(),
            groups,
            data: vec![0.0; SLICE * groups * PLANES * LANES],
            levels: Levels::new(daughters),
            codes: vec![Codes::NONE; daughters],
            quantised: true,
        }
    }

    /// Packs `SLICE` samples of one daughter, starting at `first`, into their lanes: one block per channel, zeros for
    /// missing blocks.
    ///
    /// # Panics
    /// If a block has no such samples, or there is no such daughter or lane.
    pub fn put_all<'a>(
        &mut self,
        daughter: usize,
        blocks: impl Fn(usize) -> Option<&'a Samples>,
        first: usize,
    ) {
        let mut whole = true;
        let codes = &mut self.codes[daughter];
        let range = first..first + SLICE;
        for lane in 0..LANES {
            let [re_codes, im_codes] = codes.parts.each_mut().map(|part| &mut part[lane]);
            if let Some(Samples::Codes { step, re, im, .. }) = blocks(lane) {
                re_codes.copy_from_slice(&re[range.clone()]);
                im_codes.copy_from_slice(&im[range.clone()]);
                codes.steps[lane] = *step;
            } else {
                (*re_codes, *im_codes, codes.steps[lane]) = ([0; SLICE], [0; SLICE], 0.0);
                whole &= blocks(lane).is_none();
            }
        }
        if self.quantised && whole {
            self.levels.put(self.arch, daughter, codes);
            return;
        }
        let mut planes = [[0.0; SLICE * LANES]; 2];
        for lane in 0..LANES {
            if let Some(Samples::Float { re, im }) = blocks(lane) {
                let row = lane * SLICE..(lane + 1) * SLICE;
                planes[0][row.clone()].copy_from_slice(&re[range.clone()]);
                planes[1][row].copy_from_slice(&im[range.clone()]);
            }
        }
        if self.quantised {
            // From here on all samples are packed as values, including those of this slice packed before.
            self.quantised = false;
            for other in (0..self.codes.len()).filter(|&other| other != daughter) {
                self.put_values(other, [[0.0; SLICE * LANES]; 2]);
            }
        }
        self.put_values(daughter, planes);
    }

    /// Packs the values of codes and of floats (`planes`, by channel) into their lanes.
    fn put_values(&mut self, daughter: usize, mut planes: [[f32; SLICE * LANES]; 2]) {
        let codes = &self.codes[daughter];
        // The step of floats is 0, so levels add nothing to them.
        let mut steps = [0.0; SLICE * LANES];
        for (steps, step) in steps.chunks_exact_mut(SLICE).zip(codes.steps) {
            steps.fill(step);
        }
        for (plane, codes) in planes.iter_mut().zip(&codes.parts) {
            let codes = codes.as_flattened();
            add_and_transpose(plane, codes.first_chunk().unwrap_or(&[0; SLICE * LANES]), &steps);
        }
        let [re, im] = &planes;
        let [re, im] = [re.as_chunks::<LANES>().0, im.as_chunks::<LANES>().0];
        let stride = self.groups * PLANES * LANES;
        let at = daughter * 2 * LANES;
        for (sample, (re, im)) in self.data.chunks_exact_mut(stride).zip(re.iter().zip(im)) {
            sample[at..at + LANES].copy_from_slice(re);
            sample[at + LANES..at + 2 * LANES].copy_from_slice(im);
        }
    }
}

/// Adds the levels of codes to rows of samples, one row per lane, and transposes the matrix.
#[multiversion(targets("x86_64+avx512f+avx512vl+avx512bw+avx512dq", "x86_64+avx2", "aarch64+neon"))]
fn add_and_transpose(
    matrix: &mut [f32; SLICE * LANES],
    codes: &[i8; SLICE * LANES],
    steps: &[f32; SLICE * LANES],
) {
    for ((value, code), step) in matrix.iter_mut().zip(codes).zip(steps) {
        *value += (f32::from(*code) + 0.5) * step;
    }
    let mut other = [0.0; SLICE * LANES];
    weave(matrix, &mut other);
    weave(&other, matrix);
    weave(matrix, &mut other);
    weave(&other, matrix);
}

/// Interleaves the two halves; four times that is a transposition.
#[inline(always)]
fn weave(from: &[f32; SLICE * LANES], to: &mut [f32; SLICE * LANES]) {
    const HALF: usize = SLICE * LANES / 2;
    for k in 0..HALF {
        to[2 * k] = from[k];
        to[2 * k + 1] = from[k + HALF];
    }
}

/// Zero sums for `daughters`, rounded up to an even number.
#[must_use]
pub fn no_sums(daughters: usize) -> ProductSums {
    let even = daughters.next_multiple_of(2);
    vec![[[0.0; LANES]; 2]; product(0, even)]
}

/// Adds the products of a slice to `sums`.
pub fn correlate(arch: Arch, packed: &Packed, sums: &mut ProductSums) {
    if packed.quantised {
        return packed.levels.correlate(arch, sums);
    }
    arch.dispatch(Correlate { packed, sums });
}

struct Correlate<'a> {
    packed: &'a Packed,
    sums: &'a mut ProductSums,
}

impl WithSimd for Correlate<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        match S::F32_LANES {
            16 => run::<S, 1>(simd, self),
            8 => run::<S, 2>(simd, self),
            4 => run::<S, 4>(simd, self),
            _ => run::<S, 16>(simd, self),
        }
    }
}

/// Runs the kernel; `PARTS` registers hold the channels.
#[inline(always)]
fn run<S: Simd, const PARTS: usize>(simd: S, work: Correlate<'_>) {
    let groups = work.packed.groups;
    let data = S::as_simd_f32s(&work.packed.data).0;
    for part in 0..PARTS {
        for j in 0..groups {
            diagonal::<S, PARTS>(simd, data, groups, [j, part], work.sums);
            for i in 0..j {
                tile::<S, PARTS>(simd, data, groups, [i, j, part], work.sums);
            }
        }
    }
}

#[inline(always)]
fn add<S: Simd, const PARTS: usize>(
    simd: S,
    part: usize,
    values: [S::f32s; 2],
    sums: &mut [[f32; LANES]; 2],
) {
    for (sum, value) in sums.iter_mut().zip(values) {
        let sum = S::as_mut_simd_f32s(sum).0;
        sum[part] = simd.add_f32s(sum[part], value);
    }
}

/// `sum + a conj(b)`.
#[inline(always)]
fn multiply_add<S: Simd>(simd: S, a: [S::f32s; 2], b: [S::f32s; 2], sum: &mut [S::f32s; 2]) {
    sum[0] = simd.mul_add_f32s(a[0], b[0], sum[0]);
    sum[1] = simd.mul_add_f32s(a[1], b[0], sum[1]);
    sum[0] = simd.mul_add_f32s(a[1], b[1], sum[0]);
    sum[1] = simd.mul_add_f32s(simd.neg_f32s(a[0]), b[1], sum[1]);
}

/// The two daughters of a group at one sample.
#[inline(always)]
fn load<S: Simd, const PARTS: usize>(sample: &[S::f32s], group: usize, part: usize) -> [[S::f32s; 2]; 2] {
    let group = &sample[group * PLANES * PARTS..][..PLANES * PARTS];
    assert!(part < PARTS && group.len() == PLANES * PARTS);
    [[group[part], group[PARTS + part]], [group[2 * PARTS + part], group[3 * PARTS + part]]]
}

/// Products of two daughters with two others.
#[inline(always)]
fn tile<S: Simd, const PARTS: usize>(
    simd: S,
    data: &[S::f32s],
    groups: usize,
    [i, j, part]: [usize; 3],
    sums: &mut ProductSums,
) {
    let mut own = [[simd.splat_f32s(0.0); 2]; 4];
    for sample in data.chunks_exact(groups * PLANES * PARTS) {
        let (a, b) = (load::<S, PARTS>(sample, i, part), load::<S, PARTS>(sample, j, part));
        multiply_add(simd, a[0], b[0], &mut own[0]);
        multiply_add(simd, a[1], b[0], &mut own[1]);
        multiply_add(simd, a[0], b[1], &mut own[2]);
        multiply_add(simd, a[1], b[1], &mut own[3]);
    }
    for (k, own) in own.into_iter().enumerate() {
        add::<S, PARTS>(simd, part, own, &mut sums[product(2 * i + k % 2, 2 * j + k / 2)]);
    }
}

/// Products of two daughters with each other and with themselves.
#[inline(always)]
fn diagonal<S: Simd, const PARTS: usize>(
    simd: S,
    data: &[S::f32s],
    groups: usize,
    [j, part]: [usize; 2],
    sums: &mut ProductSums,
) {
    let zero = simd.splat_f32s(0.0);
    let (mut first, mut second, mut cross) = (zero, zero, [zero; 2]);
    let (mut first_im, mut second_im) = (zero, zero);
    for sample in data.chunks_exact(groups * PLANES * PARTS) {
        let [a, b] = load::<S, PARTS>(sample, j, part);
        first = simd.mul_add_f32s(a[0], a[0], first);
        second = simd.mul_add_f32s(b[0], b[0], second);
        first_im = simd.mul_add_f32s(a[1], a[1], first_im);
        second_im = simd.mul_add_f32s(b[1], b[1], second_im);
        multiply_add(simd, a, b, &mut cross);
    }
    let (first, second) = (simd.add_f32s(first, first_im), simd.add_f32s(second, second_im));
    add::<S, PARTS>(simd, part, [first, zero], &mut sums[product(2 * j, 2 * j)]);
    add::<S, PARTS>(simd, part, cross, &mut sums[product(2 * j, 2 * j + 1)]);
    add::<S, PARTS>(simd, part, [second, zero], &mut sums[product(2 * j + 1, 2 * j + 1)]);
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Samples are small integers, so that sums are exact; those of one daughter may be floats.
    fn samples(daughter: usize, lane: usize, float: Option<usize>) -> Samples {
        match codes(daughter, lane) {
            Samples::Codes { step, re, im, .. } if float == Some(daughter) => {
                let values =
                    |codes: Vec<i8>| codes.into_iter().map(|code| (f32::from(code) + 0.5) * step).collect();
                Samples::Float { re: values(re), im: values(im) }
            }
            codes => codes,
        }
    }

    fn codes(daughter: usize, lane: usize) -> Samples {
        let code = |part: usize| {
            (0..2 * SLICE)
                .map(move |k| ((k * 31 + daughter * 7 + lane * 13 + part * 5) % 11) as i8 - 5)
                .collect()
        };
        Samples::Codes { bits: 4, step: 2.0, re: code(0), im: code(1) }
    }

    fn value(daughter: usize, lane: usize, k: usize) -> (f64, f64) {
        let Samples::Codes { re, im, .. } = codes(daughter, lane) else { unreachable!() };
        (2.0 * f64::from(re[k]) + 1.0, 2.0 * f64::from(im[k]) + 1.0)
    }

    #[test]
    fn products_equal_those_of_a_simple_loop_for_any_number_of_daughters() {
        let all = [2, 3, 8].into_iter();
        for (daughters, float) in all.flat_map(|n| [None, Some(0), Some(1)].map(|float| (n, float))) {
            let mut packed = Packed::new(daughters);
            for daughter in 0..daughters {
                let blocks: Vec<Samples> = (0..LANES).map(|lane| samples(daughter, lane, float)).collect();
                let block_of = |lane: usize| (daughter != 1 || lane != 3).then(|| &blocks[lane]);
                packed.put_all(daughter, block_of, SLICE);
            }
            for arch in [Arch::new(), Arch::Scalar] {
                let mut sums = no_sums(daughters);
                correlate(arch, &packed, &mut sums);
                correlate(arch, &packed, &mut sums);
                for j in 0..daughters {
                    for (i, lane) in (0..=j).flat_map(|i| (0..LANES).map(move |lane| (i, lane))) {
                        let mut expected = [0.0; 2];
                        for k in SLICE..2 * SLICE {
                            let ((a, b), (c, d)) = (value(i, lane, k), value(j, lane, k));
                            if lane != 3 || (i != 1 && j != 1) {
                                expected[0] += 2.0 * (a * c + b * d);
                                expected[1] += 2.0 * (b * c - a * d);
                            }
                        }
                        let found = sums[product(i, j)].map(|plane| f64::from(plane[lane]));
                        assert_eq!(found, expected, "{i} {j} {lane}");
                    }
                }
            }
        }
    }
}
