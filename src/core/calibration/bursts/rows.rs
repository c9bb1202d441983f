//! The visibilities of a burst, and how its fringe turns in them.

use std::f64::consts::{PI, TAU};

use num_complex::Complex64;

use crate::frames::{AntennaResponse, PlacedVisibilities};
use crate::response::pixel::PairGeometry;
use crate::units::vector::{Vec3, scale, sub};

/// Longest time between visibilities whose difference is the motion of a baseline, s.
const MOTION_S_MAX: f64 = 150.0;

/// A source that may have a flux.
#[derive(Clone, Copy, Debug)]
pub(super) struct Place {
    pub(super) hat: Vec3,
    pub(super) moon_radius_m: f64,
    /// Whether fringes turn during integrations.
    pub(super) smears: bool,
}

/// A visibility of a burst, for the fit.
#[derive(Clone, Copy)]
pub(super) struct BurstRow<'a> {
    pub(super) block: &'a PlacedVisibilities,
    pub(super) k: usize,
    /// Mean squared modulus of what the steady sky adds, (K sr)^2.
    pub(super) steady_k2_sr2: f64,
}

impl BurstRow<'_> {
    pub(super) fn duration_s(&self) -> f64 {
        duration_s(self.block, self.k)
    }

    /// Variance, real and imaginary part together, with the steady sky counted a number of times.
    pub(super) fn variance_k2_sr2(&self, times: f64) -> f64 {
        times * self.steady_k2_sr2 + 2.0 / self.block.weight[self.k]
    }
}

/// Length of an integration, s; 0 is not divided by.
pub(super) fn duration_s(block: &PlacedVisibilities, k: usize) -> f64 {
    block.duration_s.get(k).copied().map_or(0.0, f64::from).max(1e-3)
}

/// Baseline of a visibility, wavelengths.
pub(super) fn baseline(block: &PlacedVisibilities, k: usize) -> Vec3 {
    geometry(block, k).baseline_wavelengths()
}

fn geometry(block: &PlacedVisibilities, k: usize) -> PairGeometry {
    PairGeometry {
        r_i_m: block.r_i_m[k],
        r_j_m: block.r_j_m[k],
        frequency_hz: block.frequency_hz,
        moon_radius_m: 0.0,
        response: AntennaResponse::Isotropic,
    }
}

/// The part of an integration that lies in a cell.
#[derive(Clone, Copy, Debug)]
pub(super) struct Share {
    pub(super) cell: usize,
    pub(super) share: f64,
    /// Its middle after that of the integration, s.
    pub(super) after_s: f64,
}

impl Share {
    /// The share with the mean over its part of a fringe that turns at a rate, 1/s, in units of the fringe at the middle of the integration.
    pub(super) fn turned(&self, rate: f64, duration_s: f64) -> Complex64 {
        self.share * sinc(PI * rate * self.share * duration_s) * phasor(-rate * self.after_s)
    }
}

/// The parts of an integration, by its middle and length, in cells, by the start of the first and their length, s.
pub(super) fn shares(
    [from_s, cell_s]: [f64; 2],
    cells: usize,
    [middle_s, duration_s]: [f64; 2],
) -> impl Iterator<Item = Share> + use<> {
    let (duration, middle) = (duration_s / cell_s, (middle_s - from_s) / cell_s);
    let (from, until) = (middle - 0.5 * duration, middle + 0.5 * duration);
    let within = from.max(0.0) as usize..(until.max(0.0).ceil() as usize).min(cells);
    let part = move |cell: usize| {
        let [start, end] = [from.max(cell as f64), until.min((cell + 1) as f64)];
        Share { cell, share: (end - start) / duration, after_s: cell_s * (0.5 * (start + end) - middle) }
    };
    within.map(part).filter(|part| part.share > 0.0)
}

/// Motion of the baseline of a visibility, wavelengths per s, by those beside it in its block; zero without one.
pub(super) fn motion(block: &PlacedVisibilities, k: usize) -> Vec3 {
    let (before, after) = (k.saturating_sub(1), (k + 1).min(block.len() - 1));
    let s = block.time_s[after] - block.time_s[before];
    if s > 0.0 && s < MOTION_S_MAX * (after - before) as f64 {
        scale(s.recip(), sub(baseline(block, after), baseline(block, before)))
    } else {
        [0.0; 3]
    }
}

/// `sin(x) / x`.
pub(super) fn sinc(x: f64) -> f64 {
    if x.abs() < 1e-6 { 1.0 } else { x.sin() / x }
}

/// `exp(2 pi i turns)`.
pub(super) fn phasor(turns: f64) -> Complex64 {
    Complex64::cis(TAU * (turns - turns.round()))
}
