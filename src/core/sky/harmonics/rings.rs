//! Fourier transforms between orders and the pixels of every ring.
//!
//! On a ring of n pixels order m is equivalent to m modulo n; orders beyond n/2 are folded onto their aliases.

use std::f64::consts::PI;
use std::sync::{Arc, OnceLock};

use num_complex::Complex64;
use realfft::{ComplexToReal, RealFftPlanner, RealToComplex};

use super::kernel::{GROUP, order_max};
use crate::sky::healpix::{Ring, pixel_area_sr, ring};

/// Phases of orders are products of one of the first `LOW` and one of every `LOW`-th.
const LOW: usize = 32;

/// Fourier transforms for all ring lengths of an nside.
pub(super) struct RingFourier {
    nside: usize,
    l_max: usize,
    /// For n = 4 k pixels, the first at longitude pi / n: exp(i m pi / n) for m < `LOW`, then for every `LOW`-th m.
    phases: Vec<Vec<Complex64>>,
    inverse: OnceLock<Vec<Arc<dyn ComplexToReal<f64>>>>,
    forward: OnceLock<Vec<Arc<dyn RealToComplex<f64>>>>,
}

/// A ring and its mirror image, which is empty for the equator.
pub(super) struct RingPair<P> {
    pub north: P,
    pub south: P,
}

pub(super) struct Scratch {
    phase: Vec<Complex64>,
    spectrum: Vec<Complex64>,
    pixels: Vec<f64>,
    work: Vec<Complex64>,
    parts: [Vec<Complex64>; 2],
}

impl Scratch {
    pub(super) fn new() -> Self {
        let empty = Vec::new;
        Self { phase: vec![], spectrum: vec![], pixels: vec![], work: vec![], parts: [empty(), empty()] }
    }
}

impl RingFourier {
    pub(super) fn new(nside: usize, l_max: usize) -> Self {
        let phases = (1..=nside)
            .map(|k| {
                let phase = |m: usize| Complex64::cis(PI * (m % (8 * k)) as f64 / (4 * k) as f64);
                (0..LOW).chain((0..=l_max / LOW).map(|high| LOW * high)).map(phase).collect()
            })
            .collect();
        Self { nside, l_max, phases, inverse: OnceLock::new(), forward: OnceLock::new() }
    }

    /// Ring `pair` + 1 from the north pole.
    fn ring(&self, pair: usize) -> Ring {
        ring(self.nside, pair + 1)
    }

    /// Index of a ring length among the plans and phases.
    fn length_index(&self, pair: usize) -> usize {
        pair.min(self.nside - 1)
    }

    fn inverse(&self, pair: usize) -> &dyn ComplexToReal<f64> {
        let plans = self.inverse.get_or_init(|| {
            let mut planner = RealFftPlanner::new();
            (1..=self.nside).map(|k| planner.plan_fft_inverse(4 * k)).collect()
        });
        plans[self.length_index(pair)].as_ref()
    }

    fn forward(&self, pair: usize) -> &dyn RealToComplex<f64> {
        let plans = self.forward.get_or_init(|| {
            let mut planner = RealFftPlanner::new();
            (1..=self.nside).map(|k| planner.plan_fft_forward(4 * k)).collect()
        });
        plans[self.length_index(pair)].as_ref()
    }

    /// Writes exp(i m phi0) for m = 0 .. m_max.
    fn fill_phases(&self, pair: usize, ring: &Ring, m_max: usize, out: &mut Vec<Complex64>) {
        out.clear();
        if ring.phi0_rad == 0.0 {
            out.resize(m_max + 1, Complex64::ONE);
            return;
        }
        let (low, high) = self.phases[self.length_index(pair)].split_at(LOW);
        for first in high {
            let count = LOW.min(m_max + 1 - out.len());
            out.extend(low[..count].iter().map(|phase| first * phase));
            if out.len() > m_max {
                return;
            }
        }
    }

    /// Computes the pixels of a ring pair from its sums over degrees: plane `p` (north real, imaginary; south real,
    /// imaginary) of order m at `planes[(4 m + p) stride]`.
    pub(super) fn synthesise(
        &self,
        pair: usize,
        planes: &[f64],
        stride: usize,
        pixels: &mut RingPair<&mut [f64]>,
        scratch: &mut Scratch,
    ) {
        let ring = self.ring(pair);
        let plan = self.inverse(pair);
        let m_max = order_max(self.l_max, ring.sin_theta);
        self.fill_phases(pair, &ring, m_max, &mut scratch.phase);
        scratch.work.resize(plan.get_scratch_len(), Complex64::ZERO);
        for (plane, pixels) in [(0, &mut *pixels.north), (2, &mut *pixels.south)] {
            if pixels.is_empty() {
                continue;
            }
            let value = |m: usize| {
                Complex64::new(planes[(4 * m + plane) * stride], planes[(4 * m + plane + 1) * stride])
            };
            fold(&scratch.phase, value, ring.len, &mut scratch.spectrum);
            // The transform cannot fail: lengths are those of the plan, and both ends of the spectrum are real.
            let done = plan.process_with_scratch(&mut scratch.spectrum, pixels, &mut scratch.work);
            debug_assert!(done.is_ok());
        }
    }

    /// Computes the even part (real, imaginary) and cos theta times the odd part of a ring pair, times the pixel area: order m
    /// is at `out[(4 m + p) GROUP]`.
    pub(super) fn analyse(
        &self,
        pair: usize,
        pixels: &RingPair<&[f64]>,
        out: &mut [f64],
        scratch: &mut Scratch,
    ) {
        let ring = self.ring(pair);
        let plan = self.forward(pair);
        let m_max = order_max(self.l_max, ring.sin_theta);
        self.fill_phases(pair, &ring, m_max, &mut scratch.phase);
        scratch.work.resize(plan.get_scratch_len(), Complex64::ZERO);
        scratch.spectrum.resize(ring.len / 2 + 1, Complex64::ZERO);
        let area = pixel_area_sr(self.nside);
        for (part, pixels) in scratch.parts.iter_mut().zip([pixels.north, pixels.south]) {
            part.clear();
            if pixels.is_empty() {
                part.resize(m_max + 1, Complex64::ZERO);
                continue;
            }
            scratch.pixels.clear();
            scratch.pixels.extend(pixels.iter().map(|pixel| pixel * area));
            // The transform cannot fail: lengths are those of the plan.
            let done =
                plan.process_with_scratch(&mut scratch.pixels, &mut scratch.spectrum, &mut scratch.work);
            debug_assert!(done.is_ok());
            unfold(&scratch.phase, &scratch.spectrum, ring.len, part);
        }
        let [north, south] = &scratch.parts;
        for (m, (north, south)) in north.iter().zip(south).enumerate() {
            let (even, odd) = (north + south, (north - south) * ring.z);
            for (p, value) in [even.re, even.im, odd.re, odd.im].into_iter().enumerate() {
                out[(4 * m + p) * GROUP] = value;
            }
        }
    }
}

/// Computes the spectrum of `len` real samples of Re sum_m (2 - [m = 0]) value(m) phase_m exp(2 pi i m k / len).
fn fold(phase: &[Complex64], value: impl Fn(usize) -> Complex64, len: usize, spectrum: &mut Vec<Complex64>) {
    let half = len / 2;
    spectrum.clear();
    spectrum.resize(half + 1, Complex64::ZERO);
    spectrum[0].re = value(0).re;
    let mut k = 0;
    for (m, phase) in phase.iter().enumerate().skip(1) {
        k += 1;
        if k == len {
            k = 0;
        }
        let term = value(m) * phase;
        if k == 0 || k == half {
            spectrum[k].re += 2.0 * term.re;
        } else if k < half {
            spectrum[k] += term;
        } else {
            spectrum[len - k] += term.conj();
        }
    }
}

/// Computes sum_k sample_k exp(-i m phi_k) for every order, from the spectrum of `len` samples.
fn unfold(phase: &[Complex64], spectrum: &[Complex64], len: usize, out: &mut Vec<Complex64>) {
    let half = len / 2;
    let mut k = 0;
    for phase in phase {
        let value = if k <= half { spectrum[k] } else { spectrum[len - k].conj() };
        out.push(value * phase.conj());
        k += 1;
        if k == len {
            k = 0;
        }
    }
}
