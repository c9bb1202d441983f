//! Delays and sub-bands, applied to samples before correlation.
//!
//! Over a channel of width W, a source whose wave reaches daughter i earlier than j by
//! `tau = n . (r_i - r_j) / c` keeps the fraction sinc(pi W tau) of its visibility. At 100 km tau is up to 333 us,
//! 2.7 samples at 8 kHz, and little is left. Two methods recover it, alone or combined:
//!
//! - **Delays** towards a direction n_0, one per baseline. Daughter i receives the wave `n_0 . r_i / c` early, so its
//!   stream is read `D_i = W max_k n_0 . (r_k - r_i) / c` samples later, rounded to an integer L_i: down or up, such that
//!   the two streams of a pair differ by less than half a sample. The fraction sinc(pi (W tau + L_i - L_j)) remains: at
//!   least sinc(pi / 2) = 0.64 of a source at n_0, and less elsewhere. No delay is right for the whole sky.
//! - **Sub-bands.** Frames of N samples are transformed,
//!   `X_k = N^(-1/2) sum over n of x(n + L) exp(2 pi i d_k (n + L) / W)` (signals rotate as exp(-2 pi i nu t)), with
//!   `d_k / W = (k + 1/2) / N - 1/2`. Products of each X_k are visibilities at its own frequency `nu + d_k`, of width
//!   W / N, in the same K sr. Phases count from the same instant whatever the delay L, so they are those of `nu + d_k`,
//!   and the remaining fraction is the overlap of two frames, `1 - |W tau + L_i - L_j| / N`, all over the sky.
//!
//! The response of a sub-band is that of N samples, `(sin(pi N x) / (N sin(pi x)))^2` at x = (nu' - nu - d_k) / W: its
//! edges are not sharp, and the outermost sub-bands alias into each other, as the samples do.

use std::sync::Arc;

use multiversion::multiversion;
use num_complex::{Complex32, Complex64};
use rustfft::{Fft, FftPlanner};

use super::align::BlockRow;
use super::kernel::{LANES, ProductSums};
use crate::array::Array;
use crate::frames::{Channel, SampleBlock, Samples};
use crate::units::arithmetic::fused;
use crate::units::constants::SPEED_OF_LIGHT_M_S;
use crate::units::vector::{Vec3, dot};

/// Maximum number of sub-bands: a frame is then as long as the longest dump.
pub const SUB_BANDS_MAX: usize = 64;

/// Delays and sub-bands of a correlator.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Division {
    /// Number of sub-bands per channel: a power of two up to 64; 1 for none.
    pub sub_bands: usize,
    /// Direction towards which delays are compensated, a unit vector on ecliptic axes; `None` for no delays.
    pub delay_centre: Option<Vec3>,
}

impl Division {
    /// Neither sub-bands nor delays.
    pub const NONE: Self = Self { sub_bands: 1, delay_centre: None };

    /// Frequencies of a channel's sub-bands relative to its centre, in channel widths.
    pub fn offsets(self) -> impl Iterator<Item = f64> {
        (0..self.sub_bands).map(move |k| offset(k, self.sub_bands))
    }

    /// The sub-bands of channels, channel by channel.
    #[must_use]
    pub fn divided(self, channels: &[Channel]) -> Vec<Channel> {
        let width = |channel: &Channel| channel.width_hz / self.sub_bands as f64;
        let bands = |channel: Channel| {
            let at = move |offset| channel.frequency_hz + offset * channel.width_hz;
            self.offsets().map(move |offset| Channel { frequency_hz: at(offset), width_hz: width(&channel) })
        };
        channels.iter().flat_map(|&channel| bands(channel)).collect()
    }

    /// Delays at `t_s`, in samples at `rate_hz`.
    #[must_use]
    pub fn delays(self, array: &Array, t_s: f64, rate_hz: f64) -> Delays {
        let count = array.satellites();
        let Some(n_hat) = self.delay_centre else {
            return Delays { streams: vec![0; count], pairs: pairs(count, |i, j| [i, j]) };
        };
        let lead_s = |n| dot(n_hat, array.position_m(n, t_s)) / SPEED_OF_LIGHT_M_S;
        let lead_s: Vec<f64> = (0..count).map(lead_s).collect();
        let most_s = lead_s.iter().copied().fold(f64::NEG_INFINITY, f64::max);
        let later: Vec<f64> = lead_s.iter().map(|own_s| (most_s - own_s) * rate_hz).collect();
        let below = later.iter().map(|later| *later as usize);
        let above = below.clone().map(|below| below + 1);
        let chosen = |i: usize, j: usize| {
            let left = later[i].fract() - later[j].fract();
            [i + if left > 0.5 { count } else { 0 }, j + if left < -0.5 { count } else { 0 }]
        };
        Delays { streams: below.clone().chain(above).collect(), pairs: pairs(count, chosen) }
    }
}

/// The delays of sample streams, and the streams that each product multiplies.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Delays {
    /// Delay of each stream, samples: one stream per daughter, or a second one per daughter with one sample more.
    streams: Vec<usize>,
    /// The two streams of each product.
    pairs: Vec<[usize; 2]>,
}

/// The streams of each product of `count` daughters, auto-correlations included, as given by `of`.
fn pairs(count: usize, of: impl Fn(usize, usize) -> [usize; 2]) -> Vec<[usize; 2]> {
    let of = &of;
    (0..count).flat_map(|j| (0..=j).map(move |i| of(i, j))).collect()
}

/// Frequency of sub-band `k` of `count` relative to the channel's centre, in channel widths.
fn offset(k: usize, count: usize) -> f64 {
    (k as f64 + 0.5) / count as f64 - 0.5
}

/// Computes the spectra of rows of blocks.
pub struct Divider {
    division: Division,
    fft: Arc<dyn Fft<f32>>,
    /// Shift to the lowest sub-band times the transform's scale, by sample of a frame.
    twiddles: Vec<Complex32>,
}

/// The spectra of a row in the kernel's order: by group of lanes, frame, stream, part, lane. A lane is a sub-band of
/// a channel.
pub struct Spectra {
    /// Number of frames in the row.
    pub frames: usize,
    daughters: usize,
    delays: Delays,
    planes: Vec<[f32; LANES]>,
    /// By group, stream and lane: number of leading frames whose samples all arrived.
    complete: Vec<[u32; LANES]>,
}

impl Divider {
    /// Creates a divider for `division`.
    #[must_use]
    pub fn new(division: Division) -> Self {
        let bands = division.sub_bands;
        let scale = (bands as f64).sqrt().recip();
        let twiddle = |n: usize| {
            let value = scale * Complex64::cis(std::f64::consts::TAU * offset(0, bands) * n as f64);
            Complex32::new(value.re as f32, value.im as f32)
        };
        let twiddles = (0..bands).map(twiddle).collect();
        Self { division, fft: FftPlanner::new().plan_fft_inverse(bands), twiddles }
    }

    /// Computes the spectra of `row`, whose streams are read later by their delays and continue in the `next` row. Frames
    /// with missing samples are zeros.
    #[must_use]
    pub fn divide(
        &self,
        row: &BlockRow,
        next: Option<&BlockRow>,
        daughters: usize,
        delays: Delays,
    ) -> Spectra {
        let (bands, streams) = (self.division.sub_bands, delays.streams.len());
        let frames = row.samples / bands;
        let groups = (row.blocks.len() / daughters * bands).div_ceil(LANES);
        let restored: Vec<Vec<Complex32>> = delays.streams.iter().map(|&delay| self.phases(delay)).collect();
        let mut out = Spectra {
            frames,
            daughters,
            delays,
            planes: vec![[0.0; LANES]; groups * frames * streams * 2],
            complete: vec![[0; LANES]; groups * streams],
        };
        let mut samples = Vec::new();
        let mut scratch = vec![Complex32::ZERO; self.fft.get_inplace_scratch_len()];
        for (place, block) in row.blocks.iter().enumerate() {
            let Some(block) = block else { continue };
            let after = next.and_then(|next| next.blocks.get(place)?.as_ref());
            for stream in (place % daughters..streams).step_by(daughters) {
                delayed(block, after, out.delays.streams[stream], frames * bands, &mut samples);
                samples.truncate(samples.len() / bands * bands);
                self.transform(&mut samples, &restored[stream], &mut scratch);
                out.put(place / daughters * bands, stream, &samples, bands);
            }
        }
        out
    }

    /// Transforms frames of samples to spectra, in place.
    fn transform(&self, samples: &mut [Complex32], restored: &[Complex32], scratch: &mut [Complex32]) {
        let bands = self.division.sub_bands;
        for frame in samples.chunks_exact_mut(bands) {
            frame.iter_mut().zip(&self.twiddles).for_each(|(x, twiddle)| *x *= twiddle);
        }
        self.fft.process_with_scratch(samples, scratch);
        for frame in samples.chunks_exact_mut(bands) {
            frame.iter_mut().zip(restored).for_each(|(x, phase)| *x *= phase);
        }
    }

    /// Phase factors that refer the spectra of samples read `delay` later to the frame's instant.
    fn phases(&self, delay: usize) -> Vec<Complex32> {
        let rotated = |offset: f64| {
            let value = Complex64::cis(std::f64::consts::TAU * (offset * delay as f64).fract());
            Complex32::new(value.re as f32, value.im as f32)
        };
        // Without sub-bands the only offset is 0.
        self.division.offsets().map(rotated).collect()
    }
}

/// Collects up to `count` samples of a block from `delay` on, continued in the block after it if present.
fn delayed(
    block: &SampleBlock,
    after: Option<&SampleBlock>,
    delay: usize,
    count: usize,
    out: &mut Vec<Complex32>,
) {
    out.clear();
    extend(&block.samples, delay, count, out);
    if let Some(after) = after
        && out.len() < count
    {
        extend(&after.samples, delay.saturating_sub(block.samples.len()), count - out.len(), out);
    }
}

fn extend(samples: &Samples, from: usize, count: usize, out: &mut Vec<Complex32>) {
    let until = (from + count).min(samples.len());
    let range = from.min(until)..until;
    match samples {
        Samples::Float { re, im } => {
            let pairs = re[range.clone()].iter().zip(&im[range]);
            out.extend(pairs.map(|(&re, &im)| Complex32::new(re, im)));
        }
        Samples::Codes { step, re, im, .. } => {
            let level = |code: i8| (f32::from(code) + 0.5) * step;
            let pairs = re[range.clone()].iter().zip(&im[range]);
            out.extend(pairs.map(|(&re, &im)| Complex32::new(level(re), level(im))));
        }
    }
}

impl Spectra {
    fn streams(&self) -> usize {
        self.delays.streams.len()
    }

    /// Stores frames of `bands` sub-bands in the lanes from `first` on.
    fn put(&mut self, first: usize, stream: usize, spectra: &[Complex32], bands: usize) {
        let streams = self.streams();
        for k in 0..bands {
            let (group, lane) = ((first + k) / LANES, (first + k) % LANES);
            let base = (group * self.frames * streams + stream) * 2;
            let frames = spectra.chunks_exact(bands);
            self.complete[group * streams + stream][lane] = frames.len() as u32;
            for (frame, value) in frames.enumerate() {
                let at = base + frame * streams * 2;
                self.planes[at][lane] = value[k].re;
                self.planes[at + 1][lane] = value[k].im;
            }
        }
    }

    /// Planes of one frame of a group: by stream, then by part.
    fn frame(&self, group: usize, frame: usize) -> &[[[f32; LANES]; 2]] {
        let length = self.streams() * 2;
        self.planes[(group * self.frames + frame) * length..][..length].as_chunks().0
    }

    /// By daughter and lane: sum of |X|^2 over the row, and number of frames.
    pub fn powers(&self, group: usize) -> Vec<[(f64, u64); LANES]> {
        let mut sums = vec![[(0.0, 0); LANES]; self.daughters];
        for frame in 0..self.frames {
            for (sums, [re, im]) in sums.iter_mut().zip(self.frame(group, frame)) {
                for lane in 0..LANES {
                    sums[lane].0 += f64::from(re[lane] * re[lane] + im[lane] * im[lane]);
                }
            }
        }
        for (sums, complete) in sums.iter_mut().zip(&self.complete[group * self.streams()..]) {
            for lane in 0..LANES {
                sums[lane].1 = u64::from(complete[lane]);
            }
        }
        sums
    }

    /// Adds the products of `frames` to `sums`; returns the number of leading frames that each product has.
    pub fn correlate(
        &self,
        group: usize,
        frames: std::ops::Range<usize>,
        sums: &mut ProductSums,
    ) -> Vec<[u32; LANES]> {
        for frame in frames.clone() {
            multiply(self.frame(group, frame), &self.delays.pairs, sums);
        }
        let (first, count) = (frames.start as u32, frames.len() as u32);
        let complete = &self.complete[group * self.streams()..];
        let add_product = |&[i, j]: &[usize; 2]| {
            std::array::from_fn(|lane| {
                complete[i][lane].min(complete[j][lane]).saturating_sub(first).min(count)
            })
        };
        self.delays.pairs.iter().map(add_product).collect()
    }
}

/// Adds `x_i conj(x_j)` to `sums`, for pairs of streams with planes of real and imaginary parts.
#[multiversion(targets("x86_64+avx512f+avx512vl+fma", "x86_64+avx2+fma", "aarch64+neon"))]
fn multiply(streams: &[[[f32; LANES]; 2]], pairs: &[[usize; 2]], sums: &mut ProductSums) {
    const FMA: bool =
        multiversion::target::target_cfg_f!(any(target_feature = "fma", target_feature = "neon"));
    for (&[i, j], [re, im]) in pairs.iter().zip(sums) {
        let ([a, b], [c, d]) = (&streams[i], &streams[j]);
        for t in 0..LANES {
            re[t] = fused::<FMA>(a[t], c[t], fused::<FMA>(b[t], d[t], re[t]));
            im[t] = fused::<FMA>(b[t], c[t], fused::<FMA>(-a[t], d[t], im[t]));
        }
    }
}
