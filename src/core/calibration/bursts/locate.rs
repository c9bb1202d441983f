//! The position of a point source, by maximum likelihood over pairs.
//!
//! The model of a visibility is P_b exp(-2 pi i u . n), with a positive power for each bin of time, or 0 where the Moon hides n from a
//! daughter. The rest is noise: thermal, and of the steady sky. With the best powers, twice the logarithm of the likelihood over that of no
//! source is `sum over b of 2 C^2 / I`, C the real part of the sum of V exp(2 pi i u . n) over variances, I the sum of inverse variances.
//!
//! Baselines reach from some wavelengths to thousands, and daughters that follow each other lie nearly in a line: the cosine of the angle
//! from the line is known a thousand times better than the angle about it. The search goes over these two, first with the short
//! baselines on all the sky, then, about the best directions, with longer and longer ones, in steps that the baselines ask for.

use std::f64::consts::{PI, TAU};

use num_complex::Complex64;
use rayon::prelude::*;

use crate::array::hidden_by_moon;
use crate::response::pixel::PairGeometry;
use crate::units::vector::{Vec3, add, cross, dot, norm, scale, unit};

/// Least reach of the first grid, wavelengths.
const FIRST_WAVELENGTHS: f64 = 8.0;

/// Share of the baselines, the shortest, that the first grid uses.
const FIRST_SHARE: f64 = 0.2;

/// Factor by which the reach of baselines grows.
const GROWTH: f64 = 2.0;

/// Steps of a grid, as a part of a fringe.
const PART: f64 = 0.25;

/// Products of places and samples in the first grid, whose reach is halved until it has no more: those of 500 wavelengths in a line and 28 pairs are
/// 2e7. Positions are untrusted.
const FIRST_MAX: f64 = 1e9;

/// Most steps about the axis by which a grid is finer than the one before, in one of its steps.
const TURNS_MAX: f64 = 64.0;

/// Longest step about the axis, rad: the Moon may hide a part of the circle.
const TURN_MAX: f64 = TAU / 12.0;

/// Directions that each grid hands on.
const KEPT: usize = 96;

/// Directions that are refined to the peak of the likelihood.
const POLISHED: usize = 24;

/// Halvings of the steps of this refinement: to 1e-5 of a fringe.
const HALVINGS: usize = 15;

/// A visibility for the search.
#[derive(Clone, Copy, Debug)]
pub(in crate::calibration) struct Sample {
    pub(in crate::calibration) geometry: PairGeometry,
    pub(in crate::calibration) value_k_sr: Complex64,
    /// Inverse variance of the visibility, real and imaginary part together.
    pub(in crate::calibration) information: f64,
}

/// A direction in which a source may be.
#[derive(Clone, Copy, Debug)]
pub(in crate::calibration) struct Candidate {
    pub(in crate::calibration) hat: Vec3,
    /// Twice the logarithm of the likelihood over that of no source.
    pub(in crate::calibration) twice_log: f64,
    /// Power in the bin where it is most significant, K sr; 0 if no bin sees it.
    pub(in crate::calibration) power_k_sr: f64,
}

/// Samples of a bin with their baselines in wavelengths.
struct Search<'a> {
    bins: Vec<Vec<(&'a Sample, Vec3, f64)>>,
    moon_radius_m: f64,
    /// Unit vectors: along the line of the daughters, and two across it.
    axes: [Vec3; 3],
}

/// A direction by the cosine of its angle from the line of the daughters, and the angle about it.
#[derive(Clone, Copy, Debug)]
struct Place {
    cosine: f64,
    turn: f64,
    twice_log: f64,
}

/// Finds directions of a source, whose power may differ from bin to bin, the likeliest first. None without samples.
pub(in crate::calibration) fn locate(bins: &[Vec<Sample>], moon_radius_m: f64) -> Vec<Candidate> {
    let Some(search) = Search::new(bins, moon_radius_m) else { return Vec::new() };
    search.all_sky().iter().map(|place| search.candidate(place)).collect()
}

impl Sample {
    fn baseline(&self) -> Vec3 {
        self.geometry.baseline_wavelengths()
    }
}

impl<'a> Search<'a> {
    fn new(bins: &'a [Vec<Sample>], moon_radius_m: f64) -> Option<Self> {
        let with_baseline = |sample: &'a Sample| {
            let u = sample.baseline();
            (sample, u, norm(u))
        };
        let bins: Vec<Vec<_>> = bins.iter().map(|bin| bin.iter().map(with_baseline).collect()).collect();
        let (_, along, _) =
            bins.iter().flatten().max_by(|a, b| a.2.total_cmp(&b.2)).filter(|(.., u)| *u > 0.0)?;
        let along = unit(*along);
        let [a, b] = axes(along);
        Some(Self { bins, moon_radius_m, axes: [along, a, b] })
    }

    /// Lengths of the baselines, ascending, wavelengths.
    fn lengths(&self) -> Vec<f64> {
        let mut lengths: Vec<f64> = self.bins.iter().flatten().map(|(_, _, length)| *length).collect();
        lengths.sort_by(f64::total_cmp);
        lengths
    }

    /// Steps of the cosine and of the turn for baselines up to a length, wavelengths.
    fn steps(&self, reach: f64) -> [f64; 2] {
        let [_, a, b] = self.axes;
        let within = self.bins.iter().flatten().filter(|(_, _, length)| *length <= reach);
        let across = within.map(|(_, u, _)| dot(*u, a).hypot(dot(*u, b))).fold(0.0, f64::max);
        [PART / reach, (PART / across).min(PI)]
    }

    fn direction(&self, place: &Place) -> Vec3 {
        let [along, a, b] = self.axes;
        let cosine = place.cosine.clamp(-1.0, 1.0);
        let sine = (1.0 - cosine * cosine).max(0.0).sqrt();
        let (sin, cos) = place.turn.sin_cos();
        add(scale(cosine, along), add(scale(sine * cos, a), scale(sine * sin, b)))
    }

    fn candidate(&self, place: &Place) -> Candidate {
        let hat = self.direction(place);
        let power_k_sr = self.power(hat).unwrap_or(0.0);
        Candidate { hat, twice_log: place.twice_log, power_k_sr }
    }

    /// The best places of the sky, the likeliest first.
    fn all_sky(&self) -> Vec<Place> {
        let lengths = self.lengths();
        let longest = lengths[lengths.len() - 1];
        let mut reach = lengths[(FIRST_SHARE * lengths.len() as f64) as usize].max(FIRST_WAVELENGTHS);
        let everywhere = Place { cosine: 0.0, turn: 0.0, twice_log: 0.0 };
        let mut steps = self.steps(reach);
        while 8.0 * PI / (steps[0] * steps[1].min(TURN_MAX)) * lengths.len() as f64 > FIRST_MAX {
            reach *= 0.5;
            steps = self.steps(reach);
        }
        let mut best = self.best(about(&everywhere, [1.0, PI], steps), reach, steps);
        while reach < longest {
            reach *= GROWTH;
            let [step, turn] = self.steps(reach);
            let finer = [step, turn.max(steps[1] / TURNS_MAX)];
            let places = best.iter().flat_map(|place| about(place, steps, finer)).collect();
            best = self.best(places, reach, finer);
            steps = finer;
        }
        best.truncate(POLISHED);
        let mut polished: Vec<Place> = best.par_iter().map(|place| self.polished(*place, steps)).collect();
        polished.sort_by(|a, b| b.twice_log.total_cmp(&a.twice_log));
        polished
    }

    /// The best of some places, each a step of the grid from better ones.
    fn best(&self, places: Vec<Place>, reach: f64, steps: [f64; 2]) -> Vec<Place> {
        let judged =
            |place: Place| Place { twice_log: self.twice_log(self.direction(&place), reach), ..place };
        let mut all: Vec<Place> = places.into_par_iter().map(judged).collect();
        all.sort_by(|a, b| b.twice_log.total_cmp(&a.twice_log));
        let mut kept: Vec<Place> = Vec::new();
        for place in all {
            let is_apart = |other: &Place| {
                let turn = (place.turn - other.turn + PI).rem_euclid(TAU) - PI;
                let (x, y) = ((place.cosine - other.cosine) / steps[0], turn / steps[1]);
                x.hypot(y) > 1.5
            };
            if kept.len() < KEPT && kept.iter().all(is_apart) {
                kept.push(place);
            }
        }
        kept
    }

    /// The peak of the likelihood near a place, by shorter and shorter steps.
    fn polished(&self, place: Place, [mut dx, mut dy]: [f64; 2]) -> Place {
        let mut best = Place { twice_log: self.twice_log(self.direction(&place), f64::INFINITY), ..place };
        for _ in 0..HALVINGS {
            (dx, dy) = (0.5 * dx, 0.5 * dy);
            // Each length twice, as a ridge may be oblique.
            for _ in 0..2 {
                let middle = best;
                for (x, y) in [(-1, -1), (-1, 0), (-1, 1), (0, -1), (0, 1), (1, -1), (1, 0), (1, 1)] {
                    let cosine = (middle.cosine + dx * f64::from(x)).clamp(-1.0, 1.0);
                    let mut other = Place { cosine, turn: middle.turn + dy * f64::from(y), twice_log: 0.0 };
                    other.twice_log = self.twice_log(self.direction(&other), f64::INFINITY);
                    if other.twice_log > best.twice_log {
                        best = other;
                    }
                }
            }
        }
        best
    }

    /// Sums of a bin in a direction, over baselines of at most `reach` wavelengths whose daughters see it: C and I.
    fn sums(&self, bin: usize, n_hat: Vec3, reach: f64) -> [f64; 2] {
        let mut sums = [0.0; 2];
        for (sample, u, length) in &self.bins[bin] {
            let Sample { geometry, value_k_sr, information } = sample;
            let is_hidden = |r_m| hidden_by_moon(r_m, n_hat, self.moon_radius_m);
            if *length > reach || is_hidden(geometry.r_i_m) || is_hidden(geometry.r_j_m) {
                continue;
            }
            let turns = dot(*u, n_hat);
            let (sin, cos) = (TAU * (turns - turns.round())).sin_cos();
            sums[0] += information * (value_k_sr.re * cos - value_k_sr.im * sin);
            sums[1] += information;
        }
        sums
    }

    /// Twice the logarithm of the likelihood ratio.
    fn twice_log(&self, n_hat: Vec3, reach: f64) -> f64 {
        let of_bin = |bin| match self.sums(bin, n_hat, reach) {
            [c, i] if c > 0.0 && i > 0.0 => 2.0 * c * c / i,
            _ => 0.0,
        };
        (0..self.bins.len()).map(of_bin).sum()
    }

    /// Power in a direction, of the bin where it is most significant, K sr.
    fn power(&self, n_hat: Vec3) -> Option<f64> {
        let sums = (0..self.bins.len()).map(|bin| self.sums(bin, n_hat, f64::INFINITY));
        let seen = sums.filter(|[_, i]| *i > 0.0);
        let [c, i] = seen.max_by(|[c, i], [d, j]| (c * c / i).total_cmp(&(d * d / j)))?;
        Some(c / i)
    }
}

/// Two unit vectors across a direction and each other.
pub(super) fn axes(n_hat: Vec3) -> [Vec3; 2] {
    let across = if n_hat[2].abs() < 0.9 { [0.0, 0.0, 1.0] } else { [1.0, 0.0, 0.0] };
    let a = unit(cross(n_hat, across));
    [a, cross(n_hat, a)]
}

/// A grid about a place: to either side by `reach` of cosine and turn, in steps.
fn about(place: &Place, reach: [f64; 2], steps: [f64; 2]) -> Vec<Place> {
    let turn_step = steps[1].min(TURN_MAX);
    let [x, y] = [(reach[0] / steps[0]).ceil() as i32, (reach[1] / turn_step).ceil() as i32];
    let at = |x: i32, y: i32| Place {
        cosine: place.cosine + steps[0] * f64::from(x),
        turn: place.turn + turn_step * f64::from(y),
        twice_log: 0.0,
    };
    let all = (-x..=x).flat_map(|x| (-y..=y).map(move |y| (x, y)));
    all.map(|(x, y)| at(x, y)).filter(|place| place.cosine.abs() <= 1.0).collect()
}
