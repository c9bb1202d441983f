//! Samples of all daughters in one channel, drawn with the covariance that the model gives.
//!
//! Spectra of `BINS` frequencies are drawn every `HOP` samples, coloured with the factor of the covariance at
//! each frequency, turned into `BINS` samples and blended with their neighbours by windows whose squares
//! add to one. Correlations of equal instants are then exactly the blend of the two epochs' means over the
//! channel; receiver noise is white. Two samples `n` apart lose `1 - cos(pi n / BINS)` of their
//! correlation: 0.2 % at the longest delay of 333 us. The mean over `BINS` frequencies stands for the
//! integral over the channel: at a delay tau it exceeds `sinc(pi tau dnu)` by its
//! `(pi tau dnu / BINS)^2 / 6`th part, 7e-4 at 333 us.
//!
//! Signals turn as exp(-2 pi i nu t), so that the daughter nearer to a source, which is ahead, has the
//! phase that the sign of V gives it.

use std::f64::consts::{PI, TAU};
use std::sync::Arc;

use num_complex::{Complex32, Complex64};
use rustfft::{Fft, FftPlanner};

use super::colour::{Repairs, TILE, Tile, colour, element, expand, factor};
use super::covariance::{Covariances, chebyshev_points, interpolate};
use super::normal::fill_complex_normal;
use crate::units::{StreamKind, random_stream};

/// Frequencies over the channel.
pub const BINS: usize = 128;
/// Samples from one epoch to the next.
pub const HOP: usize = BINS / 2;
const TILES: usize = BINS / TILE;

/// What does not change from channel to channel.
pub struct Synthesis {
    fft: Arc<dyn Fft<f32>>,
    /// The window, the turning of the lowest frequency and the transform's scale.
    window: Vec<Complex32>,
    /// For each number of points over the channel, its interpolation to the bins: point by point a tile, by tile.
    bases: Vec<[Vec<[f32; TILE]>; TILES]>,
}

/// What a daughter does to its own signal at one epoch.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Response {
    /// Gain at the channel's centre.
    pub gain: Complex64,
    /// Turns of phase from one end of the channel to the other.
    pub turns: f64,
}

/// Samples of all daughters, and room to make them in.
pub struct Draft {
    daughters: usize,
    noise: [Vec<[f32; TILE]>; 2],
    tile: Tile,
    spectra: Vec<Complex32>,
    scratch: Vec<Complex32>,
    /// Second halves of the segments before.
    tails: Vec<Complex32>,
    /// The latest `HOP` samples of each daughter, one daughter after another, sqrt(K sr).
    pub samples: Vec<Complex32>,
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

impl Default for Synthesis {
    fn default() -> Self {
        Self::new()
    }
}

impl Synthesis {
    /// The tables.
    #[must_use]
    pub fn new() -> Self {
        let window = (0..BINS).map(|n| {
            let n = n as f64;
            let amplitude = (PI * (n + 0.5) / BINS as f64).sin() / (BINS as f64).sqrt();
            // Frequencies are (k + 1/2) / BINS - 1/2.
            let value = amplitude * Complex64::cis(PI * n * (1.0 - 1.0 / BINS as f64));
            Complex32::new(value.re as f32, value.im as f32)
        });
        Self { fft: FftPlanner::new().plan_fft_forward(BINS), window: window.collect(), bases: Vec::new() }
    }

    /// Makes the tables that `covariances` need.
    pub fn prepare(&mut self, covariances: &Covariances) {
        for points in self.bases.len()..=covariances.points_max() {
            self.bases.push(basis(points));
        }
    }

    /// Room for `daughters`.
    #[must_use]
    pub fn draft(&self, daughters: usize) -> Draft {
        Draft {
            daughters,
            noise: std::array::from_fn(|_| vec![[0.0; TILE]; daughters * TILES]),
            tile: Tile::new(daughters),
            spectra: vec![Complex32::ZERO; daughters * BINS],
            scratch: vec![Complex32::ZERO; self.fft.get_inplace_scratch_len()],
            tails: vec![Complex32::ZERO; daughters * HOP],
            samples: vec![Complex32::ZERO; daughters * HOP],
        }
    }

    /// Draws the segment of an epoch; `draft.samples` are then the `HOP` samples before the epoch.
    ///
    /// `covariances` are those that [`Self::prepare`] has seen; `responses` are none, or one a daughter.
    pub fn draw(
        &self,
        covariances: &Covariances,
        epoch: usize,
        key: DrawKey,
        responses: &[Response],
        draft: &mut Draft,
    ) -> Repairs {
        let mut rng =
            random_stream(key.seed, StreamKind::Samples, [u64::from(key.channel), key.ticks.cast_unsigned()]);
        let [re, im] = &mut draft.noise;
        fill_complex_normal(&mut rng, re.as_flattened_mut(), im.as_flattened_mut());
        let mut repairs = Repairs::default();
        for tile in 0..TILES {
            self.fill(covariances, epoch, tile, &mut draft.tile);
            repairs.absorb(factor(&mut draft.tile, draft.daughters));
            let noise = [&draft.noise[0][tile..], &draft.noise[1][tile..]];
            for daughter in 0..draft.daughters {
                let mut x = [[0.0; TILE]; 2];
                colour(&draft.tile, daughter, noise, TILES, &mut x);
                let out = &mut draft.spectra[daughter * BINS + tile * TILE..][..TILE];
                for (out, (re, im)) in out.iter_mut().zip(x[0].iter().zip(&x[1])) {
                    *out = Complex32::new(*re, *im);
                }
            }
        }
        for (spectrum, response) in draft.spectra.chunks_exact_mut(BINS).zip(responses) {
            response.apply(spectrum);
        }
        self.fft.process_with_scratch(&mut draft.spectra, &mut draft.scratch);
        self.blend(draft);
        repairs
    }

    fn fill(&self, covariances: &Covariances, epoch: usize, tile: usize, out: &mut Tile) {
        for daughter in 0..covariances.daughters() {
            let at = element(daughter, daughter);
            out.re[at] = [covariances.power(daughter, epoch); TILE];
            out.im[at] = [0.0; TILE];
        }
        for (pair, points, values) in covariances.at(epoch) {
            // Below the diagonal stands V_ji, the conjugate.
            let at = element(pair.j.into(), pair.i.into());
            let basis = &self.bases[points][tile];
            expand(&values[..points], basis, 1.0, &mut out.re[at]);
            expand(&values[points..], basis, -1.0, &mut out.im[at]);
        }
    }

    fn blend(&self, draft: &mut Draft) {
        let (first, second) = self.window.split_at(HOP);
        let daughters = draft.spectra.chunks_exact(BINS);
        let kept = draft.samples.chunks_exact_mut(HOP).zip(draft.tails.chunks_exact_mut(HOP));
        for (segment, (samples, tail)) in daughters.zip(kept) {
            let (early, late) = segment.split_at(HOP);
            for k in 0..HOP {
                samples[k] = tail[k] + early[k] * first[k];
                tail[k] = late[k] * second[k];
            }
        }
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

/// Frequency of a bin from the channel's centre, in widths of the channel.
fn bin_offset(bin: usize) -> f64 {
    (bin as f64 + 0.5) / BINS as f64 - 0.5
}

/// Weights of `points` Chebyshev points over the channel at the bins, by tile.
fn basis(points: usize) -> [Vec<[f32; TILE]>; TILES] {
    let nodes: Vec<f64> = chebyshev_points(points).collect();
    let mut weights = vec![0.0; points];
    let mut basis: [Vec<[f32; TILE]>; TILES] = std::array::from_fn(|_| vec![[0.0; TILE]; points]);
    if points == 0 {
        return basis;
    }
    for bin in 0..BINS {
        interpolate(&nodes, 2.0 * bin_offset(bin), &mut weights);
        for (row, weight) in basis[bin / TILE].iter_mut().zip(&weights) {
            row[bin % TILE] = *weight as f32;
        }
    }
    basis
}
