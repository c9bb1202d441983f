//! Products of quantised samples in integer arithmetic, 16 channels at a time.
//!
//! A code `c` represents the level `(2 c + 1)` in units of half a step. The real and imaginary part of a sample are
//! adjacent, so that one pairwise multiply-add gives `re re' + im im'` of eight channels, and, with the parts of one
//! daughter exchanged (`im`, `-re`), the imaginary part `im re' - re im'` of `x conj(x')`. Levels are below 2^8 and
//! their products below 2^16, so sums of two products over `SLICE` = 2^4 samples are below 2^21 and exact, even in
//! `f32`.

use pulp::Arch;

use super::lanes::{LANES, ProductSums, SLICE, product};

/// Parts of eight channels, real and imaginary alternating.
type Half = [i16; 16];
/// Channels in a half register.
const EIGHT: usize = LANES / 2;

/// A sample of one daughter: both halves of the channels, and both with the parts exchanged.
#[derive(Clone, Copy, Debug)]
struct Sample {
    plain: [Half; 2],
    exchanged: [Half; 2],
}

impl Sample {
    const SILENCE: Self = Self { plain: [[0; 16]; 2], exchanged: [[0; 16]; 2] };
}

/// A slice of levels of all daughters in the kernel's order: by sample, then by daughter.
#[derive(Clone, Debug)]
pub struct Levels {
    daughters: usize,
    data: Vec<Sample>,
    /// By daughter: half the step of each channel, sqrt(K sr).
    half_steps: Vec<[f32; LANES]>,
}

/// A slice of codes of one daughter.
#[derive(Clone, Copy, Debug)]
pub struct Codes {
    /// Codes by part (real, imaginary), then by channel.
    pub parts: [[[i8; SLICE]; LANES]; 2],
    /// Step between levels by channel; 0 where samples are missing, and then the codes must be 0.
    pub steps: [f32; LANES],
}

impl Codes {
    /// No samples.
    pub const NONE: Self = Self { parts: [[[0; SLICE]; LANES]; 2], steps: [0.0; LANES] };
}

impl Levels {
    /// Memory for `daughters`, without samples.
    #[must_use]
    pub fn new(daughters: usize) -> Self {
        let daughters = daughters.next_multiple_of(2);
        Self {
            daughters,
            data: vec![Sample::SILENCE; SLICE * daughters],
            half_steps: vec![[0.0; LANES]; daughters],
        }
    }

    /// Unpacks the samples of one daughter into their lanes.
    ///
    /// # Panics
    /// If there is no such daughter.
    pub fn put(&mut self, arch: Arch, daughter: usize, codes: &Codes) {
        self.half_steps[daughter] = codes.steps.map(|step| 0.5 * step);
        let (rows, stride) = (&mut self.data[daughter..], self.daughters);
        match arch {
            #[cfg(target_arch = "x86_64")]
            Arch::V3(simd) => simd.vectorize(
                #[inline(always)]
                || x86::put(simd, codes, rows, stride),
            ),
            #[cfg(target_arch = "x86_64")]
            Arch::V4(simd) => simd.vectorize(
                #[inline(always)]
                || x86::put(*simd, codes, rows, stride),
            ),
            _ => plain::put(codes, rows, stride),
        }
    }

    /// Adds the products of the slice to `sums`.
    pub fn correlate(&self, arch: Arch, sums: &mut ProductSums) {
        match arch {
            #[cfg(target_arch = "x86_64")]
            Arch::V3(simd) => simd.vectorize(
                #[inline(always)]
                || self.run(x86::Avx2Pairs(simd), sums),
            ),
            #[cfg(target_arch = "x86_64")]
            Arch::V4(simd) => simd.vectorize(
                #[inline(always)]
                || self.run(x86::Avx2Pairs(*simd), sums),
            ),
            _ => self.run(plain::PlainPairs, sums),
        }
    }

    #[inline(always)]
    fn run<M: PairMultiply>(&self, machine: M, sums: &mut ProductSums) {
        for half in 0..2 {
            for j in (0..self.daughters).step_by(2) {
                self.diagonal(machine, [j, half], sums);
                for i in (0..j).step_by(2) {
                    self.tile(machine, [i, j, half], sums);
                }
            }
        }
    }

    /// Products of two daughters with two others.
    #[inline(always)]
    fn tile<M: PairMultiply>(&self, machine: M, [i, j, half]: [usize; 3], sums: &mut ProductSums) {
        let mut own = [[machine.zero(); 2]; 4];
        for sample in self.data.chunks_exact(self.daughters) {
            let (a, b) = (&sample[i..i + 2], &sample[j..j + 2]);
            for (k, own) in own.iter_mut().enumerate() {
                let (a, b) = (&a[k % 2], &b[k / 2].plain[half]);
                own[0] = machine.add(&a.plain[half], b, own[0]);
                own[1] = machine.add(&a.exchanged[half], b, own[1]);
            }
        }
        for (k, own) in own.into_iter().enumerate() {
            self.add_scaled(machine, [i + k % 2, j + k / 2, half], own, sums);
        }
    }

    /// Products of two daughters with each other and with themselves.
    #[inline(always)]
    fn diagonal<M: PairMultiply>(&self, machine: M, [j, half]: [usize; 2], sums: &mut ProductSums) {
        let mut own = [machine.zero(); 4];
        for sample in self.data.chunks_exact(self.daughters) {
            let (a, b) = (&sample[j], &sample[j + 1]);
            own[0] = machine.add(&a.plain[half], &a.plain[half], own[0]);
            own[1] = machine.add(&a.plain[half], &b.plain[half], own[1]);
            own[2] = machine.add(&a.exchanged[half], &b.plain[half], own[2]);
            own[3] = machine.add(&b.plain[half], &b.plain[half], own[3]);
        }
        self.add_scaled(machine, [j, j, half], [own[0], machine.zero()], sums);
        self.add_scaled(machine, [j, j + 1, half], [own[1], own[2]], sums);
        self.add_scaled(machine, [j + 1, j + 1, half], [own[3], machine.zero()], sums);
    }

    /// Scales the sums of a product by the steps of both daughters and adds them.
    #[inline(always)]
    fn add_scaled<M: PairMultiply>(
        &self,
        machine: M,
        [i, j, half]: [usize; 3],
        own: [M::Output; 2],
        sums: &mut ProductSums,
    ) {
        let steps = [i, j].map(|n| &self.half_steps[n].as_chunks::<EIGHT>().0[half]);
        for (own, sums) in own.into_iter().zip(&mut sums[product(i, j)]) {
            machine.add_scaled(own, steps, &mut sums.as_chunks_mut::<EIGHT>().0[half]);
        }
    }
}

/// Pairwise multiply-adds of one instruction set.
trait PairMultiply: Copy {
    /// Running sums of eight channels.
    type Output: Copy;
    fn zero(self) -> Self::Output;
    /// Adds the products of adjacent parts.
    fn add(self, a: &Half, b: &Half, sum: Self::Output) -> Self::Output;
    /// `out += sum x steps`.
    fn add_scaled(self, sum: Self::Output, steps: [&[f32; EIGHT]; 2], out: &mut [f32; EIGHT]);
}

/// The portable version.
mod plain {
    use super::{Codes, EIGHT, Half, LANES, PairMultiply, Sample};

    pub(super) fn put(codes: &Codes, rows: &mut [Sample], stride: usize) {
        for (k, row) in rows.iter_mut().step_by(stride).enumerate() {
            for lane in 0..LANES {
                let is_present = i16::from(codes.steps[lane] > 0.0);
                let [re, im] = codes.parts.map(|part| 2 * i16::from(part[lane][k]) + is_present);
                let (half, at) = (lane / EIGHT, 2 * (lane % EIGHT));
                row.plain[half][at..at + 2].copy_from_slice(&[re, im]);
                row.exchanged[half][at..at + 2].copy_from_slice(&[im, -re]);
            }
        }
    }

    #[derive(Clone, Copy)]
    pub(super) struct PlainPairs;

    impl PairMultiply for PlainPairs {
        type Output = [i32; EIGHT];

        #[inline(always)]
        fn zero(self) -> Self::Output {
            [0; EIGHT]
        }

        #[inline(always)]
        fn add(self, a: &Half, b: &Half, mut sum: Self::Output) -> Self::Output {
            for (k, sum) in sum.iter_mut().enumerate() {
                let term = |at: usize| i32::from(a[at]) * i32::from(b[at]);
                *sum += term(2 * k) + term(2 * k + 1);
            }
            sum
        }

        #[inline(always)]
        fn add_scaled(self, sum: Self::Output, [a, b]: [&[f32; EIGHT]; 2], out: &mut [f32; EIGHT]) {
            for k in 0..EIGHT {
                out[k] += sum[k] as f32 * (a[k] * b[k]);
            }
        }
    }
}

/// The version for x86 with AVX2; machines with AVX-512 use it too.
#[cfg(target_arch = "x86_64")]
mod x86 {
    use std::arch::x86_64::__m256i;

    use pulp::cast;
    use pulp::x86::V3;

    use super::{Codes, EIGHT, Half, LANES, PairMultiply, SLICE, Sample};

    /// Order of channels that unpacking turns into ascending order: the first eight end up in the lower half of a register.
    const ORDER: [usize; LANES] = [0, 1, 2, 3, 8, 9, 10, 11, 4, 5, 6, 7, 12, 13, 14, 15];

    #[inline(always)]
    pub(super) fn put(simd: V3, codes: &Codes, rows: &mut [Sample], stride: usize) {
        let avx2 = simd.avx2;
        // Lower byte of a level before the shift: one half, where there are samples.
        let mut is_present = [[0_i8; 2]; LANES];
        for (is_present, lane) in is_present.iter_mut().zip(ORDER) {
            *is_present = [if codes.steps[lane] > 0.0 { i8::MIN } else { 0 }; 2];
        }
        let is_present: __m256i = cast(is_present);
        let exchange: __m256i = cast(EXCHANGE);
        let sign: __m256i = cast(SIGN);
        // Interleave the parts; each half of a register holds samples of eight channels.
        let [mut early, mut late] = [[cast::<[i8; 32], __m256i>([0; 32]); EIGHT]; 2];
        for k in 0..EIGHT {
            let pair = |part: usize| -> __m256i {
                cast([codes.parts[part][ORDER[k]], codes.parts[part][ORDER[k + EIGHT]]])
            };
            let (re, im) = (pair(0), pair(1));
            early[k] = avx2._mm256_unpacklo_epi8(re, im);
            late[k] = avx2._mm256_unpackhi_epi8(re, im);
        }
        for (first, channels) in [(0, early), (SLICE / 2, late)] {
            let samples = transpose(simd, channels);
            for (k, sample) in samples.into_iter().enumerate() {
                let row = &mut rows[(first + k) * stride];
                let halves = [
                    avx2._mm256_unpacklo_epi8(is_present, sample),
                    avx2._mm256_unpackhi_epi8(is_present, sample),
                ];
                for (half, levels) in halves.into_iter().enumerate() {
                    // (256 c + 128) / 128.
                    let levels = avx2._mm256_srai_epi16::<7>(levels);
                    let exchanged = avx2._mm256_sign_epi16(avx2._mm256_shuffle_epi8(levels, exchange), sign);
                    row.plain[half] = cast(levels);
                    row.exchanged[half] = cast(exchanged);
                }
            }
        }
    }

    /// Byte shuffle that exchanges adjacent 16-bit words.
    const EXCHANGE: [i8; 32] = {
        let mut bytes = [0; 32];
        let mut k = 0;
        while k < 32 {
            bytes[k] = ((k % 16) ^ 2) as i8;
            k += 1;
        }
        bytes
    };

    /// Alternating signs.
    const SIGN: Half = [1, -1, 1, -1, 1, -1, 1, -1, 1, -1, 1, -1, 1, -1, 1, -1];

    /// Transposes eight channels of samples into eight samples of channels, within each half of the registers.
    #[inline(always)]
    fn transpose(simd: V3, a: [__m256i; EIGHT]) -> [__m256i; EIGHT] {
        let avx2 = simd.avx2;
        let words = |x, y| [avx2._mm256_unpacklo_epi16(x, y), avx2._mm256_unpackhi_epi16(x, y)];
        let doubles = |x, y| [avx2._mm256_unpacklo_epi32(x, y), avx2._mm256_unpackhi_epi32(x, y)];
        let quads = |x, y| [avx2._mm256_unpacklo_epi64(x, y), avx2._mm256_unpackhi_epi64(x, y)];
        let [[a0, a1], [b0, b1]] = [words(a[0], a[1]), words(a[2], a[3])];
        let [[c0, c1], [d0, d1]] = [words(a[4], a[5]), words(a[6], a[7])];
        let [[e0, e1], [e2, e3]] = [doubles(a0, b0), doubles(a1, b1)];
        let [[f0, f1], [f2, f3]] = [doubles(c0, d0), doubles(c1, d1)];
        let [[g0, g1], [g2, g3]] = [quads(e0, f0), quads(e1, f1)];
        let [[g4, g5], [g6, g7]] = [quads(e2, f2), quads(e3, f3)];
        [g0, g1, g2, g3, g4, g5, g6, g7]
    }

    #[derive(Clone, Copy)]
    pub(super) struct Avx2Pairs(pub(super) V3);

    impl PairMultiply for Avx2Pairs {
        type Output = __m256i;

        #[inline(always)]
        fn zero(self) -> __m256i {
            cast([0_i32; EIGHT])
        }

        #[inline(always)]
        fn add(self, a: &Half, b: &Half, sum: __m256i) -> __m256i {
            let avx2 = self.0.avx2;
            avx2._mm256_add_epi32(sum, avx2._mm256_madd_epi16(cast(*a), cast(*b)))
        }

        #[inline(always)]
        fn add_scaled(self, sum: __m256i, [a, b]: [&[f32; EIGHT]; 2], out: &mut [f32; EIGHT]) {
            let avx = self.0.avx;
            let steps = avx._mm256_mul_ps(cast(*a), cast(*b));
            let scaled = avx._mm256_mul_ps(avx._mm256_cvtepi32_ps(sum), steps);
            *out = cast(avx._mm256_add_ps(cast(*out), scaled));
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::mother::correlator::kernel::no_sums;

    /// All codes; one channel of daughter 1 is missing.
    fn codes(daughter: usize) -> Codes {
        let mut codes = Codes::NONE;
        for lane in (0..LANES).filter(|lane| (daughter, *lane) != (1, 3)) {
            codes.steps[lane] = 2.0;
            for (part, rows) in codes.parts.iter_mut().enumerate() {
                for (k, code) in rows[lane].iter_mut().enumerate() {
                    *code = ((k * 31 + daughter * 77 + lane * 13 + part * 55) % 256) as u8 as i8;
                }
            }
        }
        codes
    }

    #[test]
    fn sums_equal_those_of_a_simple_loop_bit_by_bit() {
        for daughters in [2, 3, 8] {
            for arch in [Arch::new(), Arch::Scalar] {
                let mut levels = Levels::new(daughters);
                (0..daughters).for_each(|daughter| levels.put(arch, daughter, &codes(daughter)));
                let mut sums = no_sums(daughters);
                levels.correlate(arch, &mut sums);
                for (j, lane) in (0..daughters).flat_map(|j| (0..LANES).map(move |lane| (j, lane))) {
                    for i in 0..=j {
                        let mut expected = [0_i64; 2];
                        for k in 0..SLICE {
                            let level = |daughter: usize, part: usize| match codes(daughter) {
                                codes if codes.steps[lane] > 0.0 => {
                                    2 * i64::from(codes.parts[part][lane][k]) + 1
                                }
                                _ => 0,
                            };
                            let [a, b] = [i, j].map(|n| [level(n, 0), level(n, 1)]);
                            expected[0] += a[0] * b[0] + a[1] * b[1];
                            expected[1] += a[1] * b[0] - a[0] * b[1];
                        }
                        let found = sums[product(i, j)].map(|part| f64::from(part[lane]));
                        assert_eq!(found, expected.map(|sum| sum as f64), "{i} {j} {lane}");
                    }
                }
            }
        }
    }
}
