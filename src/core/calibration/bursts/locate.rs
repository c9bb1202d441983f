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

use crate::array::{hidden_by_moon, jupiter_hat_by_date, sun_hat_by_date};
use crate::response::pixel::PairGeometry;
use crate::units::vector::{Vec3, add, cross, dot, norm, scale, sub, unit};

/// Least reach of the first grid, wavelengths.
const FIRST_WAVELENGTHS: f64 = 8.0;

/// Share of the baselines, the shortest, that the first grid uses.
const FIRST_SHARE: f64 = 0.2;

/// Factor by which the reach of baselines grows.
const GROWTH: f64 = 2.0;

/// Steps of a grid, as a part of a fringe.
const PART: f64 = 0.25;

/// Longest step about the axis, rad: the Moon may hide a part of the circle.
const TURN_MAX: f64 = TAU / 12.0;

/// Directions that each grid hands on.
const KEPT: usize = 96;

/// Directions that are refined to the peak of the likelihood.
const POLISHED: usize = 8;

/// Halvings of the steps of this refinement: to 1e-5 of a fringe.
const HALVINGS: usize = 15;

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

/// A visibility for the search.
#[derive(Clone, Copy, Debug)]
pub(in crate::calibration) struct Sample {
    pub(in crate::calibration) geometry: PairGeometry,
    pub(in crate::calibration) value_k_sr: Complex64,
    /// Inverse variance of the visibility, real and imaginary part together.
    pub(in crate::calibration) information: f64,
}

/// A body that a source may be.
pub(in crate::calibration) struct KnownBody {
    pub(in crate::calibration) name: &'static str,
    /// Direction from the Moon.
    pub(in crate::calibration) hat: Vec3,
    /// How far from its centre bursts may be, rad.
    pub(in crate::calibration) radius_rad: f64,
}

impl KnownBody {
    /// The Sun and Jupiter some seconds after a mission's epoch.
    pub(in crate::calibration) fn all(epoch_tai_s: f64, t_s: f64) -> [Self; 2] {
        [
            Self { name: "sun", hat: sun_hat_by_date(epoch_tai_s, t_s), radius_rad: SUN_RAD },
            Self { name: "jupiter", hat: jupiter_hat_by_date(epoch_tai_s, t_s), radius_rad: JUPITER_RAD },
        ]
    }
}

/// A located source.
#[derive(Clone, Debug)]
pub(in crate::calibration) struct Located {
    /// The likeliest direction first.
    pub(in crate::calibration) directions: Vec<Vec3>,
    /// Standard deviation of the first direction along its worst axis, rad.
    pub(in crate::calibration) sigma_rad: f64,
    pub(in crate::calibration) significance: f64,
    /// Power in the bin where it is most significant, and its standard deviation, K sr.
    pub(in crate::calibration) power_k_sr: f64,
    pub(in crate::calibration) power_sigma_k_sr: f64,
    /// The body that may be at one of the directions.
    pub(in crate::calibration) name: Option<&'static str>,
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

/// Finds the direction of a source, whose power may differ from bin to bin. `None` without samples.
pub(in crate::calibration) fn locate(
    bins: &[Vec<Sample>],
    moon_radius_m: f64,
    bodies: &[KnownBody],
) -> Option<Located> {
    let search = Search::new(bins, moon_radius_m)?;
    let best = search.all_sky();
    let (largest, longest) = (best.first()?.twice_log, search.lengths().last().copied()?.max(1.0));
    let first = search.direction(best.first()?);
    let scatter = search.scatter(first);
    let sigma_rad = scatter * search.information(first, longest).sqrt().recip();
    let [power_k_sr, power_sigma_k_sr] = search.power(first)?;
    let mut directions: Vec<Vec3> = Vec::new();
    let apart = |a: Vec3, b: Vec3| norm(sub(a, b));
    for place in best.iter().filter(|place| largest - place.twice_log < WITHIN * scatter * scatter) {
        let hat = search.direction(place);
        let is_other = directions.iter().all(|other| apart(*other, hat) > 5.0 * sigma_rad + longest.recip());
        if is_other && directions.len() < REPORTED_MAX {
            directions.push(hat);
        }
    }
    let is_at = |body: &&KnownBody| {
        let within_rad = body.radius_rad + WITHIN.sqrt() * sigma_rad;
        directions.iter().any(|hat| apart(*hat, body.hat) < within_rad)
    };
    let name = bodies.iter().find(is_at).filter(|_| sigma_rad < SIGMA_RAD_MAX).map(|body| body.name);
    let significance = largest.max(0.0).sqrt();
    Some(Located { directions, sigma_rad, significance, power_k_sr, power_sigma_k_sr, name })
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

    /// The best places of the sky, the likeliest first.
    fn all_sky(&self) -> Vec<Place> {
        let lengths = self.lengths();
        let longest = lengths[lengths.len() - 1];
        let mut reach = lengths[(FIRST_SHARE * lengths.len() as f64) as usize].max(FIRST_WAVELENGTHS);
        let everywhere = Place { cosine: 0.0, turn: 0.0, twice_log: 0.0 };
        let mut steps = self.steps(reach);
        let mut best = self.best(about(&everywhere, [1.0, PI], steps), reach, steps);
        while reach < longest {
            reach *= GROWTH;
            let finer = self.steps(reach);
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

    /// Sums of a bin in a direction, over baselines of at most `reach` wavelengths whose daughters see the direction `sight`: C and I.
    fn sums(&self, bin: usize, [n_hat, sight]: [Vec3; 2], reach: f64) -> [f64; 2] {
        let mut sums = [0.0; 2];
        for (sample, u, length) in &self.bins[bin] {
            let Sample { geometry, value_k_sr, information } = sample;
            let is_hidden = |r_m| hidden_by_moon(r_m, sight, self.moon_radius_m);
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
        self.twice_log_of_sight([n_hat; 2], reach)
    }

    fn twice_log_of_sight(&self, hats: [Vec3; 2], reach: f64) -> f64 {
        let of_bin = |bin| match self.sums(bin, hats, reach) {
            [c, i] if c > 0.0 && i > 0.0 => 2.0 * c * c / i,
            _ => 0.0,
        };
        (0..self.bins.len()).map(of_bin).sum()
    }

    /// Power in a direction, of the bin where it is most significant, and its standard deviation, K sr.
    fn power(&self, n_hat: Vec3) -> Option<[f64; 2]> {
        let sums = (0..self.bins.len()).map(|bin| self.sums(bin, [n_hat; 2], f64::INFINITY));
        let seen = sums.filter(|[_, i]| *i > 0.0);
        let [c, i] = seen.max_by(|[c, i], [d, j]| (c * c / i).total_cmp(&(d * d / j)))?;
        Some([c / i, (2.0 * i).sqrt().recip()])
    }

    /// Scatter of the residuals of a source in a direction in units of their stated deviations, at least 1.
    fn scatter(&self, n_hat: Vec3) -> f64 {
        let (mut squares, mut numbers) = (0.0, -2.0);
        for (sample, ..) in self.bins.iter().flatten() {
            squares += 2.0 * sample.information * sample.value_k_sr.norm_sqr();
            numbers += 2.0;
        }
        numbers -= self.bins.len() as f64;
        ((squares - self.twice_log(n_hat, f64::INFINITY)) / numbers.max(1.0)).max(1.0).sqrt()
    }

    /// Least information on the direction along any axis across it, rad^-2: from the curvature of the likelihood, to which the Moon's limb, an
    /// edge, does not add.
    fn information(&self, n_hat: Vec3, longest: f64) -> f64 {
        let [a, b] = axes(n_hat);
        // A tenth of a radian of phase on the longest baseline.
        let h = 0.1 / (TAU * longest.max(1.0));
        let at = |x: f64, y: f64| {
            let hat = unit(add(n_hat, add(scale(x * h, a), scale(y * h, b))));
            0.5 * self.twice_log_of_sight([hat, n_hat], f64::INFINITY) / (h * h)
        };
        let middle = at(0.0, 0.0);
        let xx = 2.0 * middle - at(1.0, 0.0) - at(-1.0, 0.0);
        let yy = 2.0 * middle - at(0.0, 1.0) - at(0.0, -1.0);
        let xy = -0.25 * (at(1.0, 1.0) + at(-1.0, -1.0) - at(1.0, -1.0) - at(-1.0, 1.0));
        // The smaller eigenvalue. Rounding may make it negative where daughters lie in a line; then a radian is not resolved.
        (0.5 * (xx + yy) - (0.25 * (xx - yy).powi(2) + xy * xy).sqrt()).max(1.0)
    }
}

/// Two unit vectors across a direction and each other.
fn axes(n_hat: Vec3) -> [Vec3; 2] {
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
