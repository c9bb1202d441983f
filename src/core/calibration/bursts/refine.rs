//! Directions of a burst with their errors, from all of its visibilities.
//!
//! The search goes by the mean power of each bin. A burst changes within a bin, and each pair has its own integrations. So in each direction
//! that the search finds, the power by time is fitted, in cells short against the integrations, which are not in step; with the part that
//! each visibility has of it the likelihood's peak is found again.
//!
//! **Errors.** At the peak, the part of each visibility across the fringe says how far the direction is off: by `H^-1` times the sum of
//! scores `2 w m P (2 pi u) r`, with `H` the sum of `2 w (m P)^2 (2 pi u)(2 pi u)^T`. What the steady sky adds to a pair is the same while its
//! baseline hardly moves: between two visibilities, whose baselines differ by d wavelengths, it has the correlation `sin(2 pi d) / (2 pi d)` of
//! an even sky. With the variance J of the scores by that, the directions have the covariance `H^-1 J H^-1`, times the chi-square per degree
//! of freedom of the sums across the fringe, of each pair in each part of the burst: errors of gains and of the model are in it.

use std::f64::consts::{PI, TAU};
use std::ops::Range;

use num_complex::Complex64;
use rayon::prelude::*;

use super::BurstSearch;
use super::flux::{Flux, Seen, affordable};
use super::locate::Candidate;
use super::rows::{BurstRow, Place, baseline, phasor, sinc};
use crate::array::{jupiter_hat_by_date, sun_hat_by_date};
use crate::units::Pair;
use crate::units::vector::{Vec3, add, cross, dot, norm, scale, sub, unit};

/// Distance from the Sun within which its bursts at these frequencies arise and are scattered, rad: two degrees.
const SUN_RAD: f64 = 0.035;

/// The error of Jupiter's direction, rad.
const JUPITER_RAD: f64 = 5e-4;

/// Standard deviation of a position, rad, up to which it can have a name. On short baselines along a line it is any place of a circle.
const SIGMA_RAD_MAX: f64 = 0.1;

/// Directions of equal likelihood that are reported.
const REPORTED_MAX: usize = 4;

/// Twice the logarithm of a likelihood, with the scatter found, within which 99 % of positions, of two parameters, lie.
const WITHIN: f64 = 9.21;

/// Visibilities of a pair that a direction is found with.
const OF_PAIR: usize = 32;

/// Work of a fit to them, as [`affordable`] counts it: those of 28 pairs, 25 s long in cells of 0.5 s, are 3e6.
const WORK_MAX: f64 = 1e7;

/// Least power of a visibility in units of the largest, for a direction.
const FAINTEST: f64 = 0.03;

/// Times that the power by time is fitted, and the peak found.
const ROUNDS: usize = 3;

/// Directions nearer to each other are the same, turns of the fringe of the longest baseline.
const SAME: f64 = 0.02;

/// Square of the part of the shift by smearing that remains, as the power by time is not known better: 3 %, as measured.
const DOUBT: f64 = 9e-4;

/// Steps to the peak of the likelihood, and halvings of each.
const STEPS: usize = 30;
const HALVINGS: usize = 8;

/// Gain of twice the logarithm of the likelihood below which a step is the last.
const GAIN: f64 = 0.01;

/// Parts of the burst in which sums across the fringe are judged.
const PARTS: f64 = 6.0;

/// A direction, with its errors.
#[derive(Clone, Copy, Debug)]
pub(super) struct Located {
    pub(super) hat: Vec3,
    /// Standard deviations along the longer and the shorter axis of the error ellipse, and the angle of the longer from ecliptic north
    /// through east, rad.
    pub(super) errors_rad: [f64; 3],
}

/// A visibility that a direction is found with.
struct Datum {
    value_k_sr: Complex64,
    /// Power of the source in it.
    power_k_sr: f64,
    /// Inverse variance, real and imaginary part together.
    information: f64,
    /// Baseline, wavelengths.
    u: Vec3,
    pair: Pair,
    part: i64,
    steady_k2_sr2: f64,
    thermal_k2_sr2: f64,
}

/// Directions in the order of their likelihood, with their errors; others have a likelihood within 99 % of its distribution. Also whether
/// fringes turn during integrations, by which of the two explains more.
pub(super) fn refine(
    search: BurstSearch,
    candidates: &[Candidate],
    rows: &[BurstRow],
    span_s: [f64; 2],
) -> (Vec<Located>, bool) {
    let of_hat = |smears: bool| move |hat: Vec3| Place { hat, moon_radius_m: search.moon_radius_m, smears };
    let Some(rows) = candidates.first().and_then(|first| bright(rows, of_hat(false)(first.hat), span_s))
    else {
        return (Vec::new(), false);
    };
    let information = information(&rows);
    let [middle, smeared] =
        [false, true].map(|smears| peaks((&rows, &information), candidates, of_hat(smears), span_s));
    let largest = |peaks: &[(Candidate, Vec<Datum>)]| peaks.first().map_or(0.0, |(best, _)| best.twice_log);
    let smears = largest(&smeared) > largest(&middle);
    let (best, other) = if smears { (smeared, middle) } else { (middle, smeared) };
    let Some((first, data)) = best.first() else { return (Vec::new(), false) };
    let inflation = inflation(first, data);
    // How likely the other one is, or how well the power by time is known.
    let doubt = (1.0 + (0.5 * (first.twice_log - largest(&other)) / inflation).exp()).recip();
    let doubt = if smears { doubt.max(DOUBT) } else { doubt };
    let place = |(candidate, data): &(Candidate, Vec<Datum>)| Located {
        hat: candidate.hat,
        errors_rad: errors(candidate, data, doubt, &other),
    };
    let mut located = vec![place(&best[0])];
    let apart_rad = 5.0 * located[0].errors_rad[0] + longest(&rows).recip();
    for peak in &best[1..] {
        let is_likely = first.twice_log - peak.0.twice_log < WITHIN * inflation;
        let is_other = located.iter().all(|other| norm(sub(other.hat, peak.0.hat)) > apart_rad);
        if is_likely && is_other && located.len() < REPORTED_MAX {
            located.push(place(peak));
        }
    }
    (located, smears)
}

/// Length of the longest baseline, wavelengths.
fn longest(rows: &[BurstRow]) -> f64 {
    rows.iter().map(|row| norm(baseline(row.block, row.k))).fold(1.0, f64::max)
}

/// The visibilities in which the burst is bright, by the power by time in a direction: of each pair at most some, evenly. They are the same for
/// all directions, so that likelihoods compare.
fn bright<'a>(rows: &[BurstRow<'a>], place: Place, span_s: [f64; 2]) -> Option<Vec<BurstRow<'a>>> {
    let flux = Flux::fit(rows, place, span_s)?;
    let least = FAINTEST * flux.largest_k_sr();
    let is_bright = |row: &&BurstRow| flux.power_k_sr_in(row) > least;
    let bright: Vec<BurstRow> = rows.iter().filter(is_bright).copied().collect();
    let of_pairs = bright.chunk_by(|a, b| a.block.pair == b.block.pair);
    let some = |rows: &[BurstRow<'a>]| -> Vec<BurstRow<'a>> {
        rows.iter().step_by(rows.len().div_ceil(OF_PAIR).max(1)).copied().collect()
    };
    let some: Vec<BurstRow> = of_pairs.flat_map(some).collect();
    Some(affordable(&some, span_s, WORK_MAX))
}

/// Peaks of the likelihood near candidates, the likeliest first, and the visibilities as they have the source there.
fn peaks(
    (rows, information): (&[BurstRow], &[f64]),
    candidates: &[Candidate],
    place: impl Fn(Vec3) -> Place + Sync,
    span_s: [f64; 2],
) -> Vec<(Candidate, Vec<Datum>)> {
    let longest = longest(rows);
    let mut hats: Vec<Vec3> = candidates.iter().map(|candidate| candidate.hat).collect();
    let mut best: Vec<(Candidate, Vec<Datum>)> = Vec::new();
    for _ in 0..ROUNDS {
        best = hats.par_iter().filter_map(|hat| peak((rows, information), place(*hat), span_s)).collect();
        best.sort_by(|(a, _), (b, _)| b.twice_log.total_cmp(&a.twice_log));
        // Many end at the same peak.
        hats.clear();
        best.retain(|(candidate, _)| {
            let is_new = hats.iter().all(|hat| norm(sub(*hat, candidate.hat)) > SAME / longest);
            hats.extend(is_new.then_some(candidate.hat));
            is_new
        });
    }
    best
}

/// The peak of the likelihood near a direction with the power by time that is fitted there.
fn peak(
    (rows, information): (&[BurstRow], &[f64]),
    place: Place,
    span_s: [f64; 2],
) -> Option<(Candidate, Vec<Datum>)> {
    let flux = Flux::fit(rows, place, span_s)?;
    let datum = |(row, information): (&BurstRow, &f64)| datum(row, *information, flux.seen(row), span_s);
    let data: Vec<Datum> = rows.iter().zip(information).map(datum).collect();
    let found = climbed(place.hat, &data);
    (found.power_k_sr > 0.0).then_some((found, data))
}

/// The peak of the likelihood near a direction, by Newton's steps.
fn climbed(hat: Vec3, data: &[Datum]) -> Candidate {
    let mut best = judged(hat, data);
    for _ in 0..STEPS {
        let [east, north] = east_and_north(best.hat);
        let mut step = newton(&best, data);
        let mut tries = 0;
        let next = loop {
            let off = add(scale(step[0], east), scale(step[1], north));
            let next = judged(unit(add(best.hat, off)), data);
            if next.twice_log > best.twice_log || tries == HALVINGS {
                break next;
            }
            (step, tries) = (step.map(|angle| 0.5 * angle), tries + 1);
        };
        let gain = next.twice_log - best.twice_log;
        if gain > 0.0 {
            best = next;
        }
        if gain < GAIN {
            break;
        }
    }
    best
}

/// The likelihood and the power of a direction.
fn judged(hat: Vec3, data: &[Datum]) -> Candidate {
    let (mut c, mut i) = (0.0, 0.0);
    for Datum { value_k_sr, power_k_sr, information, u, .. } in data {
        c += information * power_k_sr * (value_k_sr * phasor(dot(*u, hat))).re;
        i += information * power_k_sr * power_k_sr;
    }
    let twice_log = if c > 0.0 { 2.0 * c * c / i } else { 0.0 };
    Candidate { hat, twice_log, power_k_sr: if i > 0.0 { c / i } else { 0.0 } }
}

/// The step to the peak of the likelihood, to the east and to the north, rad.
fn newton(candidate: &Candidate, data: &[Datum]) -> [f64; 2] {
    let (mut information, mut score) = ([[1.0, 0.0], [0.0, 1.0]], [0.0; 2]);
    for of_pair in data.chunk_by(|a, b| a.pair == b.pair) {
        let Scores { weights, slopes, across, .. } = Scores::new(candidate, of_pair);
        for ((weight, slope), across) in weights.iter().zip(&slopes).zip(&across) {
            add_outer(&mut information, *weight, [*slope; 2]);
            score.iter_mut().zip(slope).for_each(|(sum, slope)| *sum += weight * slope * across);
        }
    }
    inverse(information).map(|row| row[0] * score[0] + row[1] * score[1])
}

fn datum(row: &BurstRow, information: f64, seen: Option<Seen>, [from_s, until_s]: [f64; 2]) -> Datum {
    let BurstRow { block, k, steady_k2_sr2 } = *row;
    // The Moon may hide the direction from a daughter.
    let hidden = || Seen { power_k_sr: 0.0, u: baseline(block, k), value_k_sr: block.value_k_sr[k] };
    let Seen { power_k_sr, u, value_k_sr } = seen.unwrap_or_else(hidden);
    Datum {
        value_k_sr,
        power_k_sr,
        information,
        u,
        pair: block.pair,
        part: (PARTS * (block.time_s[k] - from_s) / (until_s - from_s)) as i64,
        steady_k2_sr2,
        thermal_k2_sr2: 2.0 / block.weight[k],
    }
}

/// Inverse variances of visibilities: the steady sky counts once while it is the same.
fn information(rows: &[BurstRow]) -> Vec<f64> {
    let of_pair = |rows: &[BurstRow]| -> Vec<f64> {
        let u: Vec<Vec3> = rows.iter().map(|row| baseline(row.block, row.k)).collect();
        let times = |a: &Vec3| -> f64 { u.iter().map(|b| correlation(norm(sub(*a, *b))).powi(2)).sum() };
        rows.iter().zip(&u).map(|(row, u)| row.variance_k2_sr2(times(u)).recip()).collect()
    };
    rows.chunk_by(|a, b| a.block.pair == b.block.pair).flat_map(of_pair).collect()
}

/// Correlation of an even sky's visibilities, whose baselines differ by some wavelengths.
fn correlation(wavelengths: f64) -> f64 {
    sinc(TAU * wavelengths)
}

/// What the visibilities say about a direction: the inverse of its information, the variance of the scores, and the chi-square per degree of
/// freedom of sums across the fringe, at least 1.
fn judgement(candidate: &Candidate, data: &[Datum]) -> (Matrix, Matrix, f64) {
    // A radian is known.
    let (mut information, mut variance) = ([[1.0, 0.0], [0.0, 1.0]], [[1.0, 0.0], [0.0, 1.0]]);
    let (mut squares, mut sums) = (0.0, -3.0);
    for of_pair in data.chunk_by(|a, b| a.pair == b.pair) {
        let scores = Scores::new(candidate, of_pair);
        for k in 0..of_pair.len() {
            add_outer(&mut information, scores.weights[k], [scores.slopes[k]; 2]);
            for l in 0..of_pair.len() {
                let factor = scores.weights[k] * scores.weights[l] * scores.covariance(k, l);
                add_outer(&mut variance, factor, [scores.slopes[k], scores.slopes[l]]);
            }
        }
        let mut from = 0;
        for part in of_pair.chunk_by(|a, b| a.part == b.part) {
            if let Some(square) = scores.square(from..from + part.len()) {
                (squares, sums) = (squares + square, sums + 1.0);
            }
            from += part.len();
        }
    }
    (inverse(information), variance, (squares / f64::max(sums, 1.0)).max(1.0))
}

/// The factor by which differences of the likelihood are too large.
fn inflation(candidate: &Candidate, data: &[Datum]) -> f64 {
    let (inverse, variance, scatter) = judgement(candidate, data);
    let spread = product(inverse, variance);
    scatter * (0.5 * (spread[0][0] + spread[1][1])).max(1.0)
}

/// The error ellipse of a direction, with the doubt between it and that of the other peaks which is nearest.
fn errors(candidate: &Candidate, data: &[Datum], doubt: f64, others: &[(Candidate, Vec<Datum>)]) -> [f64; 3] {
    let (inverse, variance, scatter) = judgement(candidate, data);
    let mut covariance =
        product(product(inverse, variance), inverse).map(|row| row.map(|value| scatter * value));
    let offs = others.iter().map(|(other, _)| sub(other.hat, candidate.hat));
    if let Some(off) = offs.min_by(|a, b| norm(*a).total_cmp(&norm(*b))) {
        add_outer(&mut covariance, doubt, [east_and_north(candidate.hat).map(|axis| dot(off, axis)); 2]);
    }
    let [longer, shorter, angle] = ellipse(covariance);
    // The longer axis is an arc about the line of the daughters; a Gaussian's rms of how far it leaves the tangent.
    let longest =
        data.iter().map(|datum| datum.u).fold([0.0; 3], |a, b| if norm(b) > norm(a) { b } else { a });
    let cosine = dot(longest, candidate.hat).abs() / norm(longest).max(f64::MIN_POSITIVE);
    let bend = cosine / (1.0 - cosine * cosine).max(1e-6).sqrt();
    let sag = 0.75_f64.sqrt() * bend * longer * longer;
    let across = shorter.hypot(sag).min(1.0);
    match across > longer {
        true => [across, longer, (angle + 0.5 * PI).rem_euclid(PI)],
        false => [longer, across, angle],
    }
}

/// What the visibilities of a pair say about a direction.
struct Scores<'a> {
    data: &'a [Datum],
    /// Inverse variances of parts of visibilities across the fringe.
    weights: Vec<f64>,
    /// Slopes of these parts by the direction, to the east and to the north.
    slopes: Vec<[f64; 2]>,
    /// These parts, K sr.
    across: Vec<f64>,
    /// Turns of the fringe.
    turns: Vec<f64>,
}

impl<'a> Scores<'a> {
    fn new(candidate: &Candidate, data: &'a [Datum]) -> Self {
        let axes = east_and_north(candidate.hat);
        let slope = |datum: &Datum| {
            let power_k_sr = candidate.power_k_sr * datum.power_k_sr;
            axes.map(|axis| -TAU * power_k_sr * dot(datum.u, axis))
        };
        let turns: Vec<f64> = data.iter().map(|datum| dot(datum.u, candidate.hat)).collect();
        let across = |(datum, turns): (&Datum, &f64)| (datum.value_k_sr * phasor(*turns)).im;
        Self {
            data,
            weights: data.iter().map(|datum| 2.0 * datum.information).collect(),
            slopes: data.iter().map(slope).collect(),
            across: data.iter().zip(&turns).map(across).collect(),
            turns,
        }
    }

    /// Covariance of two parts across the fringe.
    fn covariance(&self, k: usize, l: usize) -> f64 {
        let (a, b) = (&self.data[k], &self.data[l]);
        let sky = correlation(norm(sub(a.u, b.u))) * phasor(self.turns[k] - self.turns[l]).re;
        let thermal = if k == l { a.thermal_k2_sr2 } else { 0.0 };
        0.5 * (a.steady_k2_sr2 * sky + thermal)
    }

    /// The squared sum across the fringe of some visibilities, in units of its variance.
    fn square(&self, range: Range<usize>) -> Option<f64> {
        let weight = |k: usize| self.weights[k] * self.data[k].power_k_sr;
        let sum: f64 = range.clone().map(|k| weight(k) * self.across[k]).sum();
        let pairs = range.clone().flat_map(|k| range.clone().map(move |l| (k, l)));
        let variance: f64 = pairs.map(|(k, l)| weight(k) * weight(l) * self.covariance(k, l)).sum();
        (variance > 0.0).then(|| sum * sum / variance)
    }
}

/// Unit vectors to the ecliptic east and north of a direction.
fn east_and_north(hat: Vec3) -> [Vec3; 2] {
    let east = if hat[0].hypot(hat[1]) > 0.0 { unit([-hat[1], hat[0], 0.0]) } else { [0.0, 1.0, 0.0] };
    [east, cross(hat, east)]
}

type Matrix = [[f64; 2]; 2];

fn add_outer(sum: &mut Matrix, factor: f64, [a, b]: [[f64; 2]; 2]) {
    for (row, a) in sum.iter_mut().zip(a) {
        row.iter_mut().zip(b).for_each(|(value, b)| *value += factor * a * b);
    }
}

fn inverse([[a, b], [c, d]]: Matrix) -> Matrix {
    let determinant = a * d - b * c;
    [[d / determinant, -b / determinant], [-c / determinant, a / determinant]]
}

fn product(a: Matrix, b: Matrix) -> Matrix {
    a.map(|row| [0, 1].map(|k| row[0] * b[0][k] + row[1] * b[1][k]))
}

/// Standard deviations along the axes of the ellipse of a covariance, the longer first, and the angle of that from north through east.
fn ellipse([[a, b], [c, d]]: Matrix) -> [f64; 3] {
    let b = 0.5 * (b + c);
    let (middle, half) = (0.5 * (a + d), (0.5 * (a - d)).hypot(b));
    let sigma = |variance: f64| variance.max(0.0).sqrt();
    let angle = 0.5 * (2.0 * b).atan2(d - a);
    [sigma(middle + half), sigma(middle - half), angle.rem_euclid(PI)]
}

/// The Sun or Jupiter, if one of the directions, known to some degrees, may be theirs at a time.
pub(super) fn name(search: BurstSearch, t_s: f64, located: &[Located]) -> Option<&'static str> {
    let bodies = [
        ("sun", sun_hat_by_date(search.epoch_tai_s, t_s), SUN_RAD),
        ("jupiter", jupiter_hat_by_date(search.epoch_tai_s, t_s), JUPITER_RAD),
    ];
    let is_at = |hat: Vec3, radius_rad: f64| {
        let within = |place: &Located| radius_rad + WITHIN.sqrt() * place.errors_rad[0];
        located.iter().any(|place| norm(sub(place.hat, hat)) < within(place))
    };
    let is_known = located.first().is_some_and(|place| place.errors_rad[0] < SIGMA_RAD_MAX);
    bodies
        .into_iter()
        .find(|(_, hat, radius_rad)| is_known && is_at(*hat, *radius_rad))
        .map(|(name, ..)| name)
}
