//! What is wrong with a model of the sky that no gains reconcile with the data: its frequency, or a source that it lacks.
//!
//! Each pair has a complex factor of its own, whatever its daughters' gains. A model of another frequency, or with one more source, that
//! leaves [`LEFT_MAX`] of what the model left names the fault; another sky has none. Baselines that are all longer or shorter by a factor
//! look like another frequency. Only short baselines are used, so that the cost is that of a pass, not of its longest baseline.

use std::f64::consts::TAU;

use bincode::{Decode, Encode};
use num_complex::Complex64;
use serde::Serialize;

use crate::array::hidden_by_moon;
use crate::calibration::bursts::{Sample, locate};
use crate::response::model::PairPosition;
use crate::response::pixel::PairGeometry;
use crate::sky::{ecliptic_deg, k_sr_per_jy};
use crate::units::vector::{Vec3, dot, norm};

/// What is wrong with a model.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Encode, Decode)]
#[serde(tag = "fault", rename_all = "kebab-case")]
pub enum ModelFault {
    /// The data are of another frequency, or all baselines of another length.
    Frequency {
        /// Frequency of the data over that of the model, or length of the baselines over that of their positions, within a tenth of a
        /// fringe of the short baselines.
        ratio: f64,
    },
    /// The sky has a source that the model lacks, or has too faint.
    Source {
        /// Ecliptic longitude and latitude, deg; for daughters in one plane perhaps those of its mirror image in the plane.
        position_deg: [f64; 2],
        /// Flux density beyond the model's, as an isotropic antenna sees it, Jy.
        flux_jy: f64,
    },
}

/// Part of what the model leaves that a fault may leave.
const LEFT_MAX: f64 = 0.35;

/// Standard deviations by which what a model leaves exceeds the noise.
const LEFT_SIGMAS: f64 = 10.0;

/// Ratios of frequencies that are tried, either way.
const RATIO_MAX: f64 = 2.0;

/// Longest baseline with which frequencies are told, wavelengths: at twice the frequency it sees degrees up to 150, which maps of
/// `DIAGNOSIS_NSIDE` hold.
const REACH_WAVELENGTHS: f64 = 12.0;

/// Maximum nside of the maps with which frequencies are told.
pub(super) const DIAGNOSIS_NSIDE: usize = 64;

/// Steps of the ratio, and of its refinement, in fringes of the longest of these baselines.
const STEPS: [f64; 3] = [0.25, 0.06, 0.015];

/// Number of visibilities with which frequencies are told, and of each pair with which a source is searched.
const VISIBILITIES: usize = 64;
const OF_PAIR: usize = 8;

/// Least number of visibilities that tell a frequency, and least of the longest of their baselines, wavelengths: within a pass a visibility
/// of less than one hardly changes, and so agrees with some frequency by chance.
const VISIBILITIES_MIN: usize = 32;
const LONGEST_WAVELENGTHS_MIN: f64 = 3.0;

/// Longest baseline with which a source is searched, wavelengths.
const SOURCE_WAVELENGTHS: f64 = 60.0;

/// Rounds in which the flux density of a source and the factors of the pairs are fitted in turn.
const ROUNDS: usize = 8;

/// A visibility with its model.
#[derive(Clone, Copy, Debug)]
pub(super) struct Datum {
    pub(super) geometry: PairGeometry,
    pub(super) value_k_sr: Complex64,
    /// Inverse variance of the real part, (K sr)^-2.
    pub(super) weight: f64,
    /// K sr.
    pub(super) model: Complex64,
}

impl Datum {
    fn wavelengths(&self) -> f64 {
        norm(self.geometry.baseline_wavelengths())
    }

    fn position(&self) -> PairPosition {
        let PairGeometry { r_i_m, r_j_m, .. } = self.geometry;
        PairPosition { r_i_m, r_j_m, span_rad: 0.0, pair_time: None }
    }

    /// Visibility of a source of unit power.
    fn fringe(&self, n_hat: Vec3) -> Complex64 {
        let PairGeometry { r_i_m, r_j_m, moon_radius_m, .. } = self.geometry;
        if hidden_by_moon(r_i_m, n_hat, moon_radius_m) || hidden_by_moon(r_j_m, n_hat, moon_radius_m) {
            return Complex64::ZERO;
        }
        let turns = dot(self.geometry.baseline_wavelengths(), n_hat);
        self.geometry.antenna(n_hat) * Complex64::cis(-TAU * (turns - turns.round()))
    }
}

/// Model of a channel with its frequency times a factor, at some positions, K sr; `None` if there is none.
pub(super) type ModelAtRatio<'a> = &'a dyn Fn(f64, &[PairPosition]) -> Option<Vec<Complex64>>;

/// Finds what is wrong with the model of a channel; `pairs` has the visibilities of each.
pub(super) fn diagnose(pairs: &[Vec<Datum>], at_ratio: ModelAtRatio<'_>) -> Option<ModelFault> {
    source(&within(pairs, SOURCE_WAVELENGTHS))
        .or_else(|| frequency(&within(pairs, REACH_WAVELENGTHS), at_ratio))
}

/// The pairs whose baselines are all shorter than a length, the shortest first.
fn within(pairs: &[Vec<Datum>], wavelengths: f64) -> Vec<Vec<Datum>> {
    let longest = |pair: &Vec<Datum>| pair.iter().map(Datum::wavelengths).fold(0.0, f64::max);
    let mut near: Vec<(f64, &Vec<Datum>)> = pairs
        .iter()
        .map(|pair| (longest(pair), pair))
        .filter(|(longest, pair)| pair.len() >= OF_PAIR && *longest > 0.0 && *longest < wavelengths)
        .collect();
    near.sort_by(|a, b| a.0.total_cmp(&b.0));
    near.into_iter().map(|(_, pair)| pair.clone()).collect()
}

/// Standard deviation of [`left_over`] by noise alone: the square of a visibility has a variance of 4.
fn noise(visibilities: usize) -> f64 {
    2.0 * (visibilities as f64).sqrt()
}

/// The factor of a pair that brings a model closest to its data; zero without signal in the model.
fn factor(pair: &[Datum], model: impl Fn(&Datum) -> Complex64) -> Complex64 {
    let (mut cross, mut gram) = (Complex64::ZERO, 0.0);
    for datum in pair {
        let of_model = model(datum);
        cross += datum.weight * of_model.conj() * datum.value_k_sr;
        gram += datum.weight * of_model.norm_sqr();
    }
    if gram > 0.0 { cross / gram } else { Complex64::ZERO }
}

/// Power that a model leaves in units of the variance of a real part, beyond that of noise.
fn left_over(pairs: &[Vec<Datum>], model: impl Fn(&Datum) -> Complex64) -> f64 {
    let of_pair = |pair: &Vec<Datum>| -> f64 {
        let factor = factor(pair, &model);
        let square =
            |datum: &Datum| datum.weight * (datum.value_k_sr - factor * model(datum)).norm_sqr() - 2.0;
        // The factor takes a complex number.
        pair.iter().map(square).sum::<f64>() + 2.0
    };
    pairs.iter().map(of_pair).sum()
}

/// Every so-many-th of some visibilities, at most `count`.
fn thinned(pair: &[Datum], count: usize) -> Vec<Datum> {
    pair.iter().step_by(pair.len().div_ceil(count.max(1)).max(1)).copied().collect()
}

/// The frequency that the short baselines ask for.
fn frequency(pairs: &[Vec<Datum>], at_ratio: ModelAtRatio<'_>) -> Option<ModelFault> {
    let longest = pairs.last()?.iter().map(Datum::wavelengths).fold(0.0, f64::max);
    let of_pair = (VISIBILITIES / pairs.len()).max(OF_PAIR);
    let near: Vec<Vec<Datum>> = pairs.iter().map(|pair| thinned(pair, of_pair)).collect();
    let left = |ln_ratio: f64| -> Option<f64> {
        let positions: Vec<PairPosition> = near.iter().flatten().map(Datum::position).collect();
        let mut models = at_ratio(ln_ratio.exp(), &positions)?.into_iter();
        let with_models: Vec<Vec<Datum>> = near
            .iter()
            .map(|pair| {
                pair.iter().zip(models.by_ref()).map(|(datum, model)| Datum { model, ..*datum }).collect()
            })
            .collect();
        Some(left_over(&with_models, |datum| datum.model))
    };
    let before = left(0.0)?;
    let count: usize = near.iter().map(Vec::len).sum();
    if count < VISIBILITIES_MIN || longest < LONGEST_WAVELENGTHS_MIN || before < LEFT_SIGMAS * noise(count) {
        return None;
    }
    let mut best = (0.0, before);
    let mut reach = RATIO_MAX.ln();
    for part in STEPS {
        let step = part / (RATIO_MAX * longest);
        let steps = (reach / step).ceil() as i32;
        let middle = best.0;
        for k in -steps..=steps {
            let ln_ratio = middle + step * f64::from(k);
            let left = left(ln_ratio)?;
            if left < best.1 {
                best = (ln_ratio, left);
            }
        }
        reach = step;
    }
    (best.1 < LEFT_MAX * before).then(|| ModelFault::Frequency { ratio: best.0.exp() })
}

/// The source of constant power that the model lacks.
fn source(pairs: &[Vec<Datum>]) -> Option<ModelFault> {
    let left = left_over(pairs, |datum| datum.model);
    if left < LEFT_SIGMAS * noise(pairs.iter().map(Vec::len).sum()) {
        return None;
    }
    let geometry = pairs.iter().flatten().next()?.geometry;
    let samples = |pair: &Vec<Datum>| -> Vec<Sample> {
        let factor = factor(pair, |datum| datum.model);
        let sample = |datum: Datum| Sample {
            geometry: datum.geometry,
            value_k_sr: datum.value_k_sr / factor - datum.model,
            information: 0.5 * datum.weight * factor.norm_sqr(),
        };
        let is_known = factor.norm_sqr() > 0.0;
        thinned(pair, OF_PAIR).into_iter().filter(|_| is_known).map(sample).collect()
    };
    let samples: Vec<Sample> = pairs.iter().flat_map(samples).collect();
    let located = *locate(&[samples], geometry.moon_radius_m).first()?;
    let (n_hat, mut power_k_sr) = (located.hat, located.power_k_sr);
    let model = |datum: &Datum, power_k_sr: f64| datum.model + power_k_sr * datum.fringe(n_hat);
    for _ in 0..ROUNDS {
        let (mut cross, mut gram) = (0.0, 0.0);
        for pair in pairs {
            let factor = factor(pair, |datum| model(datum, power_k_sr));
            for datum in pair {
                let of_source = factor * datum.fringe(n_hat);
                cross += datum.weight * (of_source.conj() * (datum.value_k_sr - factor * datum.model)).re;
                gram += datum.weight * of_source.norm_sqr();
            }
        }
        power_k_sr = cross / gram.max(f64::MIN_POSITIVE);
    }
    let with_source = left_over(pairs, |datum| model(datum, power_k_sr));
    // A bright source that the model has at another place is found, too; but then the source alone explains nearly as much.
    let alone = left_over(pairs, |datum| datum.fringe(n_hat));
    let is_source = power_k_sr > 0.0 && with_source < LEFT_MAX * left.min(alone);
    let flux_jy = power_k_sr / k_sr_per_jy(geometry.frequency_hz);
    is_source.then(|| ModelFault::Source { position_deg: ecliptic_deg(n_hat), flux_jy })
}
