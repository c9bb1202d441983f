//! Drawing of samples of all daughters in one channel with the covariance of the model.
//!
//! Every `HOP` samples a spectrum of `BINS` frequencies is drawn, coloured with the factor of the covariance at
//! each frequency, transformed to `BINS` samples and blended with its neighbours by windows whose squares
//! add to one. Correlations of equal instants are then exactly the blend of the two epochs' means over the
//! channel; receiver noise is white. Two samples `n` apart lose `1 - cos(pi n / BINS)` of their
//! correlation: 0.2 % at the longest delay of 333 us. The mean over `BINS` frequencies replaces the
//! integral over the channel: at a delay tau it exceeds `sinc(pi tau dnu)` by a relative
//! `(pi tau dnu / BINS)^2 / 6`, 7e-4 at 333 us.
//!
//! Signals rotate as exp(-2 pi i nu t), so that the daughter nearer to a source, which receives the wave first, has the
//! phase that the sign convention of V gives it.

use std::f64::consts::{PI, TAU};
use std::sync::Arc;

use num_complex::{Complex32, Complex64};
use rustfft::{Fft, FftPlanner};

use multiversion::multiversion;
use pulp::Arch;

use super::bins::{BINS, HALF, HOP, bin_offset};
use super::colour::{ApplyFactor, Expand, Factor};
use super::covariance::Covariances;
use super::normal::{Bytes, CHUNK, fill_complex_normal};
use super::repair::{Repairs, factor};
use super::tile::{TILE, Tile, on_tile};
use crate::units::{StreamKind, random_stream};

const TILES: usize = BINS / TILE;

/// Tables of the synthesis, common to all channels.
pub struct SampleSynthesis {
    arch: Arch,
    fft: Arc<dyn Fft<f32>>,
    /// Product of the window, the shift to the lowest frequency and the transform's scale.
    window: [[f32; BINS]; 2],
}

/// A daughter's instrumental response at one epoch.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Response {
    /// Gain at the channel's centre.
    pub gain: Complex64,
    /// Phase change across the channel, turns.
    pub turns: f64,
}

impl Response {
    /// The response of a daughter without errors.
    pub const IDEAL: Self = Self { gain: Complex64::ONE, turns: 0.0 };
}

/// Samples of one daughter: real parts, imaginary parts.
pub type Planes = [Vec<f32>; 2];

/// Destination of samples of all daughters.
pub struct SampleSlot<'a> {
    /// Planes by daughter.
    pub planes: &'a mut [Planes],
    /// Index of the first sample.
    pub first: usize,
}

/// Memory for the samples of all daughters, and the overlap between epochs.
pub struct Draft {
    daughters: usize,
    bytes: Bytes,
    noise: [Vec<[f32; TILE]>; 2],
    tile: Tile,
    coloured: Vec<[[f32; TILE]; 2]>,
    spectra: Vec<Complex32>,
    scratch: Vec<Complex32>,
    /// Second halves of the previous segments.
    tails: Vec<[[f32; HOP]; 2]>,
}

/// Identity of the random numbers of one epoch.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct DrawKey {
    /// Seed of the run.
    pub seed: u64,
    /// Channel.
    pub channel: u16,
    /// Time of the epoch, ticks.
    pub ticks: i64,
}

impl Default for SampleSynthesis {
    fn default() -> Self {
        Self::new()
    }
}

impl SampleSynthesis {
    /// Computes the tables.
    #[must_use]
    pub fn new() -> Self {
        let [mut re, mut im] = [[0.0; BINS]; 2];
        for n in 0..BINS {
            let x = n as f64;
            let amplitude = (PI * (x + 0.5) / BINS as f64).sin() / (BINS as f64).sqrt();
            // Frequencies are (k + 1/2) / BINS - 1/2.
            let value = amplitude * Complex64::cis(PI * x * (1.0 - 1.0 / BINS as f64));
            (re[n], im[n]) = (value.re as f32, value.im as f32);
        }
        Self { arch: Arch::new(), fft: FftPlanner::new().plan_fft_forward(BINS), window: [re, im] }
    }

    /// Memory for `daughters`.
    #[must_use]
    pub fn draft(&self, daughters: usize) -> Draft {
        Draft {
            daughters,
            bytes: [[0; 4]; 2 * CHUNK],
            noise: std::array::from_fn(|_| vec![[0.0; TILE]; daughters * TILES]),
            tile: Tile::new(daughters),
            coloured: vec![[[0.0; TILE]; 2]; daughters],
            spectra: vec![Complex32::ZERO; daughters * BINS],
            scratch: vec![Complex32::ZERO; self.fft.get_inplace_scratch_len()],
            tails: vec![[[0.0; HOP]; 2]; daughters],
        }
    }

    /// Draws the segment of an epoch, and writes the `HOP` samples before the epoch (sqrt(K sr)) to `out`.
    ///
    /// `responses` is empty, or has one response per daughter.
    pub fn draw(
        &self,
        covariances: &Covariances,
        epoch: usize,
        key: DrawKey,
        responses: &[Response],
        draft: &mut Draft,
        out: SampleSlot<'_>,
    ) -> Repairs {
        let mut rng =
            random_stream(key.seed, StreamKind::Samples, [u64::from(key.channel), key.ticks.cast_unsigned()]);
        let [re, im] = &mut draft.noise;
        fill_complex_normal(&mut rng, &mut draft.bytes, re.as_flattened_mut(), im.as_flattened_mut());
        let mut repairs = Repairs::default();
        for group in 0..TILES {
            repairs.add(self.factor(covariances, epoch, group, draft));
            let Draft { tile, coloured, spectra, noise: [re, im], .. } = draft;
            let noise = [&re[group..], &im[group..]];
            on_tile(self.arch, ApplyFactor { tile, noise, stride: TILES, x: coloured });
            for (spectrum, coloured) in spectra.chunks_exact_mut(BINS).zip(coloured) {
                copy_to_spectrum(coloured, group, spectrum);
            }
        }
        for (spectrum, response) in draft.spectra.chunks_exact_mut(BINS).zip(responses) {
            response.apply(spectrum);
        }
        self.fft.process_with_scratch(&mut draft.spectra, &mut draft.scratch);
        let segments = draft.spectra.as_chunks::<BINS>().0.iter().zip(&mut draft.tails);
        let SampleSlot { planes, first } = out;
        for ((segment, tail), [re, im]) in segments.zip(planes) {
            blend(segment, &self.window, tail, [&mut re[first..], &mut im[first..]]);
        }
        repairs
    }

    /// Factorises the covariances of one group of bins.
    fn factor(&self, covariances: &Covariances, epoch: usize, group: usize, draft: &mut Draft) -> Repairs {
        let Draft { daughters, tile, .. } = draft;
        on_tile(self.arch, Expand { covariances, epoch, group, tile });
        if on_tile(self.arch, Factor { tile, order: *daughters }) {
            return Repairs::none(*daughters);
        }
        on_tile(self.arch, Expand { covariances, epoch, group, tile });
        factor(tile, *daughters)
    }
}

/// Copies the signal of a group of bins and its mirror image into the spectrum.
#[multiversion(targets("x86_64+avx512f+avx512vl", "x86_64+avx2", "aarch64+neon"))]
fn copy_to_spectrum([re, im]: &[[f32; TILE]; 2], group: usize, spectrum: &mut [Complex32]) {
    let (below, above) = spectrum.split_at_mut(BINS / 2);
    let above = &mut above[BINS / 2 - (group + 1) * HALF..][..HALF];
    for (k, out) in below[group * HALF..][..HALF].iter_mut().enumerate() {
        *out = Complex32::new(re[k], im[k]);
    }
    for (k, out) in above.iter_mut().enumerate() {
        *out = Complex32::new(re[TILE - 1 - k], im[TILE - 1 - k]);
    }
}

/// Adds the segment's first half to the previous tail to make samples; its second half becomes the tail.
#[multiversion(targets("x86_64+avx512f+avx512vl+fma", "x86_64+avx2+fma", "aarch64+neon"))]
fn blend(
    segment: &[Complex32; BINS],
    [window_re, window_im]: &[[f32; BINS]; 2],
    [tail_re, tail_im]: &mut [[f32; HOP]; 2],
    [re, im]: [&mut [f32]; 2],
) {
    let (re, im) = (&mut re[..HOP], &mut im[..HOP]);
    for k in 0..HOP {
        let (x, w) = (segment[k], (window_re[k], window_im[k]));
        re[k] = tail_re[k] + (x.re * w.0 - x.im * w.1);
        im[k] = tail_im[k] + (x.re * w.1 + x.im * w.0);
    }
    for k in 0..HOP {
        let (x, w) = (segment[HOP + k], (window_re[HOP + k], window_im[HOP + k]));
        tail_re[k] = x.re * w.0 - x.im * w.1;
        tail_im[k] = x.re * w.1 + x.im * w.0;
    }
}

impl Response {
    fn apply(&self, spectrum: &mut [Complex32]) {
        for (bin, value) in spectrum.iter_mut().enumerate() {
            let factor = self.gain * Complex64::cis(TAU * self.turns * bin_offset(bin));
            *value *= Complex32::new(factor.re as f32, factor.im as f32);
        }
    }
}
